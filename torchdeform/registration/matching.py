"""What searches over many displacements share: features that know no contrast, and neighbours that agree."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.intensities import require_finite
from torchdeform.core.resampling import hat_average, restrict
from torchdeform.errors import InputError
from torchdeform.metrics.mind import mind_ssc
from torchdeform.solvers.sine_cosine import inverse_transform, transform

# Entries of a temporary.
CHUNK = 2**22

# Costs are divided by their standard deviation, which counts as no smaller than this (features lie in [0, 1]).
SMALLEST_SCALE = 1e-2


def require_pair(fixed: Tensor, moving: Tensor, masks: dict[str, Tensor | None], grid: Grid, where: str) -> None:
    """Raise `InputError`, which names ``where``, unless images and masks ``(B or 1, 1, *S)`` go together."""
    grid.check(fixed, f"{where}: fixed")
    grid.check(moving, f"{where}: moving", components=fixed.shape[1])
    if (fixed.shape[0], fixed.dtype, fixed.device) != (moving.shape[0], moving.dtype, moving.device):
        raise InputError(f"{where}: fixed and moving must agree in batch size, dtype and device")
    require_finite(fixed, moving, where)
    for name, mask in masks.items():
        if mask is not None and (tuple(mask.shape[1:]) != (1, *grid.shape) or len(mask) not in (1, len(fixed))):
            wanted = (len(fixed), 1, *grid.shape)
            raise InputError(f"{where}: {name} must have shape {wanted}, got {tuple(mask.shape)}")


def items_of(mask: Tensor | None, images: Tensor) -> list[Tensor | None]:
    """Return the mask of each of the images ``(B, C, *S)``, ``(1, 1, *S)`` or None."""
    return [None] * len(images) if mask is None else [*mask.to(images).expand(len(images), *mask.shape[1:]).split(1)]


def features_of(image: Tensor, images: Grid, source: Grid, features: Grid) -> Tensor:
    """Return MIND-SSC of an image on the grid ``source``, averaged on ``features``: averages keep what is thin."""
    return hat_average(mind_ssc(restrict(image, images, source)), features)


def displacements(reach: tuple[int, ...], like: Tensor) -> Tensor:
    """Return all displacements of at most so many steps along each axis, ``(L, D)``."""
    return torch.cartesian_prod(*[torch.arange(-r, r + 1, dtype=like.dtype, device=like.device) for r in reach])


def couple(
    cost: Tensor, labels: Tensor, smoothed: Callable[[Tensor], Tensor], prices: tuple[float, ...], start: Tensor
) -> tuple[Tensor, Tensor]:
    """Return d and s of the minimum of Σ C(x, d) + α |d − s|², s being d smoothed, for rising α.

    Args:
        cost: C ``(L, N)``.
        labels: the displacements d ``(L, D)``.
        smoothed: makes s from d, both ``(D, N)``.
        prices: α in each round.
        start: s before the first round.
    """
    d = s = start
    for price in prices:
        d = labels[_cheapest(cost, labels, s, price)].T
        s = smoothed(d)
    return d, s


def _cheapest(cost: Tensor, labels: Tensor, s: Tensor, price: float) -> Tensor:
    """Return at each point the number of the label d that minimises C + α (|d|² − 2 d·s), ``(N,)``."""
    left = torch.cat([labels, labels.square().sum(1, keepdim=True)], dim=1)
    right = torch.cat([-2 * s, torch.ones_like(s[:1])])
    size = max(1, CHUNK // len(labels))
    parts = zip(cost.split(size, dim=1), right.split(size, dim=1), strict=True)
    return torch.cat([torch.addmm(c, left, r, alpha=price).argmin(0) for c, r in parts])


def gaussian(x: Tensor, sigma: float) -> Tensor:
    """Convolve with a Gaussian of ``sigma`` nodes, x being mirrored at the boundary: cosines are damped."""
    for axis in range(2, x.dim()):
        frequency = torch.arange(x.shape[axis], dtype=x.dtype, device=x.device) * (math.pi / (x.shape[axis] - 1))
        gain = torch.exp(-0.5 * (sigma * frequency) ** 2).view(-1, *([1] * (x.dim() - 1 - axis)))
        x = transform(inverse_transform(x, axis, "cosine") * gain, axis, "cosine")
    return x
