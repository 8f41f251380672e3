"""Similarities of two images, each with its derivative in closed form: no tape is kept in the inner loop."""

from abc import ABC, abstractmethod
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.errors import InputError

# Added to both variances of LNCC, for images scaled to [0, 1]: windows flatter than a grey level of 0.3 % are flat.
LNCC_FLOOR = 1e-5

# Up to this many nodes an axis one product with the dense band matrix is the fastest box sum (3×128³ float32, window
# 9: 24 ms an axis against 72 ms for sums of shifted views); its cost per node grows with the axis.
_DENSE_LIMIT = 512


class Similarity(ABC):
    """A similarity S(fixed, warped) to be maximised, with everything that depends on the fixed image computed once."""

    @abstractmethod
    def evaluate(self, warped: Tensor) -> tuple[Tensor, Tensor]:
        """Return S and its derivative.

        Args:
            warped: ``(B, C, *S)``, on the intensity scale of the fixed image.

        Returns:
            S per item ``(B,)``, a mean over voxels and channels; and N ∂S/∂warped ``(B, C, *S)``, N being the number of
            these, so that the derivative does not depend on the size of the image.
        """


class MeanSquaredDifference(Similarity):
    """S = −mean (warped − fixed)².

    Args:
        fixed: ``(B, C, *S)``.
    """

    def __init__(self, fixed: Tensor) -> None:
        self.fixed = fixed

    def evaluate(self, warped: Tensor) -> tuple[Tensor, Tensor]:
        difference = self.fixed - warped
        return -difference.square().flatten(1).mean(1), 2 * difference


class LocalCrossCorrelation(Similarity):
    """S = mean over x of c² / ((v_f + ε)(v_w + ε)), covariance and variances in the window around x.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        window: width in voxels, odd. At the boundary the part of the window inside the image counts.

    Notes:
        Lies in [0, 1]. With a = 2c/((v_f + ε)(v_w + ε)), b = a c/(v_w + ε) and E the mean over a window, the
        derivative by warped(y) is Σ [a (fixed(y) − E fixed) − b (warped(y) − E warped)] over the windows that hold y,
        each divided by its number of voxels. ε = 1e-5 keeps flat regions finite: they count as not correlated.
        Two sets of box sums a call, of 3 and of 4 fields; no window is visited voxel by voxel.
    """

    def __init__(self, fixed: Tensor, window: int) -> None:
        self.fixed, self.window = fixed, window
        self.share = 1 / box_sum(torch.ones_like(fixed[:1, :1]), window)
        self.mean = box_sum(fixed, window) * self.share
        self.variance = (box_sum(fixed * fixed, window) * self.share - self.mean**2).clamp_(min=0).add_(LNCC_FLOOR)

    def evaluate(self, warped: Tensor) -> tuple[Tensor, Tensor]:
        sums = box_sum(torch.cat([warped, warped * warped, warped * self.fixed], dim=1), self.window)
        mean, square, product = sums.mul_(self.share).chunk(3, dim=1)
        covariance = product.sub_(mean * self.mean)
        variance = square.sub_(mean * mean).clamp_(min=0).add_(LNCC_FLOOR)
        correlation = covariance / (variance * self.variance)
        value = (correlation * covariance).flatten(1).mean(1)
        a = correlation.mul_(2 * self.share)
        b = a * covariance / variance
        back = box_sum(torch.cat([a, a * self.mean, b, b * mean], dim=1), self.window)
        a, a_mean, b, b_mean = back.chunk(4, dim=1)
        return value, self.fixed * a - a_mean - warped * b + b_mean


def make_similarity(name: str, fixed: Tensor, window: int) -> Similarity:
    """Return the similarity of that name to ``fixed``.

    Args:
        name: ``lncc`` or ``ssd``.
        fixed: ``(B, C, *S)``.
        window: width of the LNCC window in voxels.
    """
    return LocalCrossCorrelation(fixed, window) if name == "lncc" else MeanSquaredDifference(fixed)


def scale_intensities(fixed: Tensor, moving: Tensor, *, jointly: bool) -> tuple[Tensor, Tensor]:
    """Return both images with their 0.5 and 99.5 percentiles taken to 0 and 1, item by item.

    Args:
        fixed: ``(B, C, *S)``.
        moving: the same shape.
        jointly: one scale for both images, as a squared difference needs; otherwise each has its own.

    Raises:
        InputError: an image has no contrast.
    """
    if jointly:
        both = _to_unit_range(torch.cat([fixed, moving], dim=1), "fixed and moving")
        return both[:, : fixed.shape[1]].contiguous(), both[:, fixed.shape[1] :].contiguous()
    return _to_unit_range(fixed, "fixed"), _to_unit_range(moving, "moving")


def _to_unit_range(image: Tensor, name: str) -> Tensor:
    values = image.flatten(1)
    values = values[:, :: max(1, values.shape[1] // 2**20)].sort(dim=1).values  # quantile() stops at 2^24 values
    last = values.shape[1] - 1
    low, high = values[:, round(0.005 * last)], values[:, round(0.995 * last)]
    flat = high <= low
    low, high = torch.where(flat, values[:, 0], low), torch.where(flat, values[:, -1], high)
    if not bool((high > low).all()):
        raise InputError(f"register: {name} is constant, so there is nothing to align")
    column = (-1, *([1] * (image.dim() - 1)))
    return (image - low.view(column)) / (high - low).view(column)


def box_sum(x: Tensor, window: int) -> Tensor:
    """Return Σ x over the window around each node, cut off at the boundary.

    Args:
        x: ``(B, C, *S)``.
        window: width in voxels, odd.

    Returns:
        ``(B, C, *S)``.

    Notes:
        Self-adjoint and linear. No running total, so nothing cancels in float32.
    """
    for axis in range(2, x.dim()):
        small = x.shape[axis] <= _DENSE_LIMIT
        x = _band_product(x, axis, window) if small else _sum_of_shifts(x, axis, window)
    return x


def _band_product(x: Tensor, axis: int, window: int) -> Tensor:
    band = _band(x.shape[axis], window, x.dtype, x.device)
    if axis == x.dim() - 1:
        return x @ band
    return (band @ x.flatten(axis + 1)).view(x.shape) if axis + 1 < x.dim() else x


@lru_cache(maxsize=64)
def _band(size: int, window: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):
        node = torch.arange(size, device=device)
        return ((node[:, None] - node).abs() <= window // 2).to(dtype)


def _sum_of_shifts(x: Tensor, axis: int, window: int) -> Tensor:
    padding = [0, 0] * (x.dim() - 1 - axis) + [window // 2] * 2
    return _windows(F.pad(x, padding), axis, window)


def _windows(x: Tensor, axis: int, window: int) -> Tensor:
    """Sums of ``window`` neighbours where all exist: two sums of half the window, and one entry if it is odd."""
    if window == 1:
        return x
    half, count = window // 2, x.shape[axis] - window + 1
    sums = _windows(x, axis, half)
    total = sums.narrow(axis, 0, count) + sums.narrow(axis, half, count)
    return total.add_(x.narrow(axis, window - 1, count)) if window % 2 else total
