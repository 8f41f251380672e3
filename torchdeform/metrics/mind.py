"""MIND-SSC: how much the patches around a voxel differ from each other, which does not depend on the contrast."""

from itertools import combinations, product

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.grid import magnitude
from torchdeform.core.resampling import box_sum
from torchdeform.errors import InputError
from torchdeform.metrics.base import DIMENSIONS, at_least_float32

# V is kept within these shares of its mean over the image.
_VARIANCE_RANGE = (1e-3, 1e3)

# Differences below this many units in the last place of the largest value are noise.
_ROUNDING = 256.0


def mind_ssc(image: Tensor, *, radius: int = 1, dilation: int = 1) -> Tensor:
    """Return exp(−(D_k − min D)/V), D_k(x) = mean over the patch at x of (I(· + p_k) − I(· + q_k))².

    Args:
        image: ``(B, C, *S)``, any unit, 2 or 3 axes in S.
        radius: of the patch in voxels: it is 2·radius + 1 wide, and cut off at the boundary.
        dilation: distance from x to its neighbours p_k, q_k in voxels.

    Returns:
        ``(B, C·K, *S)`` between 0 and 1, the K of one channel together. K = 12 pairs of face neighbours at distance
        √2·dilation in 3D, 4 in 2D. Float32, or float64 if the image is.

    Raises:
        InputError: shape, radius or dilation.

    Notes:
        Unchanged under I ↦ a I + b, a ≠ 0. V is the mean of D_k − min D over k, kept between 0.001 and 1000 times its
        mean over the image, and above rounding; all entries of a flat image are 1. The image is continued by its
        boundary values. Differentiable. Heinrich et al., "Towards Realtime Multimodal Fusion for Image-Guided
        Interventions Using Self-Similarities", MICCAI 2013.
    """
    if image.dim() not in DIMENSIONS or not image.is_floating_point():
        raise InputError(
            f"mind_ssc: image must be floating-point (B, C, *S), got {tuple(image.shape)} of {image.dtype}"
        )
    if radius < 0 or dilation < 1:
        raise InputError(f"mind_ssc: radius must be at least 0 and dilation at least 1, got {radius} and {dilation}")
    image = at_least_float32(image)
    image = image / magnitude(image)  # whose squares are finite
    distance = _patch_distances(image, radius, dilation)
    distance = distance - distance.amin(dim=2, keepdim=True)
    return torch.exp(-distance / _variance(distance, image)).flatten(1, 2)


def neighbour_pairs(dim: int) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
    """Return the pairs of face neighbours at distance √2: 4 in 2D, 12 in 3D."""
    steps = [tuple(sign * (a == axis) for a in range(dim)) for axis, sign in product(range(dim), (-1, 1))]
    return tuple((p, q) for p, q in combinations(steps, 2) if any(a + b for a, b in zip(p, q, strict=True)))


def _patch_distances(image: Tensor, radius: int, dilation: int) -> Tensor:
    """Return D ``(B, C, K, *S)``."""
    dim, width = image.dim() - 2, 2 * radius + 1
    padded = F.pad(image, (dilation, dilation) * dim, mode="replicate")
    squares = torch.stack(
        [(_moved(padded, p, dilation) - _moved(padded, q, dilation)).square() for p, q in neighbour_pairs(dim)], dim=2
    )
    share = 1 / box_sum(torch.ones_like(image[:1, :1]), width)
    return (box_sum(squares.flatten(1, 2), width) * share).view(squares.shape)


def _moved(padded: Tensor, step: tuple[int, ...], dilation: int) -> Tensor:
    """Return I(x + dilation · step) at the nodes of the image that was padded by ``dilation``."""
    for axis, s in enumerate(step, start=2):
        padded = padded.narrow(axis, dilation * (1 + s), padded.shape[axis] - 2 * dilation)
    return padded


def _variance(distance: Tensor, image: Tensor) -> Tensor:
    """Return V ``(B, C, 1, *S)``, positive."""
    variance, axes = distance.mean(dim=2, keepdim=True), tuple(range(3, distance.dim()))
    mean = variance.mean(dim=axes, keepdim=True)
    largest = image.detach().abs().unsqueeze(2).amax(dim=axes, keepdim=True)
    rounding = (_ROUNDING * torch.finfo(image.dtype).eps * torch.where(largest > 0, largest, 1.0)).square()
    low, high = _VARIANCE_RANGE
    low, high = (torch.maximum(share * mean, rounding) for share in (low, high))
    return variance.clamp(min=low, max=high)
