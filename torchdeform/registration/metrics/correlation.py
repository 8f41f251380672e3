"""Normalised cross-correlation, of whole images and of the windows around each voxel."""

from functools import cached_property

import torch
from torch import Tensor

from torchdeform.registration.metrics.base import (
    Similarity,
    Span,
    at_least_float32,
    channel_mean,
    mean,
    on_unit_scale,
    relative_weight,
    times,
)
from torchdeform.registration.metrics.boxes import box_sum

# Added to both variances of LNCC, for images scaled to [0, 1]: windows flatter than a grey level of 0.3 % are flat.
LNCC_FLOOR = 1e-5

# Added to both variances of NCC: images flatter than a grey level of 0.01 % are flat.
NCC_FLOOR = 1e-8

# A window with less weight than this is empty. Its square root is far from float32's smallest number.
_EMPTY = 1e-20


class CrossCorrelation(Similarity):
    """S = mean over channels of c / √((v_f + ε)(v_w + ε)), covariance and variances over the whole image.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].

    Notes:
        Lies in [−1, 1]; a reversed contrast gives −1. With f̂ and ŵ less their means, the derivative by warped is
        f̂ / √((v_f + ε)(v_w + ε)) − S ŵ / (v_w + ε).
    """

    def __init__(self, fixed: Tensor) -> None:
        self.fixed = at_least_float32(fixed)

    @cached_property
    def _whole(self) -> tuple[Tensor, Tensor]:
        return _centred(self.fixed, None)

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        warped = at_least_float32(warped)
        weight = relative_weight(mask, warped)
        fixed, fixed_variance = self._whole if weight is None else _centred(self.fixed, weight)
        warped, variance = _centred(warped, weight)
        scale = (fixed_variance * variance).rsqrt()
        value = channel_mean(fixed * warped, weight) * scale
        return value.flatten(1).mean(1), times(scale * fixed - (value / variance) * warped, weight)


def ncc(fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None, span: Span = None) -> Tensor:
    """Return S = c / √((v_f + ε)(v_w + ε)), the correlation of two images, 1 at best and −1 for reversed contrast.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.
        span: intensities taken for 0 and 1, which gives ε = 1e-8 its meaning; None: the smallest and the largest of
            each image where the mask is positive.

    Returns:
        ``(B,)``, the mean over channels. Flat images give 0.

    Raises:
        InputError: shapes.

    Notes:
        Differentiable. `CrossCorrelation` has the derivative in closed form.
    """
    fixed, warped = on_unit_scale(fixed, warped, mask, span)
    weight = relative_weight(mask, warped)
    (fixed, fixed_variance), (warped, variance) = _centred(fixed, weight), _centred(warped, weight)
    return (channel_mean(fixed * warped, weight) * (fixed_variance * variance).rsqrt()).flatten(1).mean(1)


def _centred(image: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the image less its mean, and its variance + ε ``(B, C, 1, ..)``."""
    image = image - channel_mean(image, weight)
    return image, channel_mean(image * image, weight) + NCC_FLOOR


class LocalCrossCorrelation(Similarity):
    """S = mean over x of c² / ((v_f + ε)(v_w + ε)), covariance and variances in the window around x.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        window: width in voxels, odd. At the boundary the part of the window inside the image counts.

    Notes:
        Lies in [0, 1]. With a = 2c/((v_f + ε)(v_w + ε)), b = a c/(v_w + ε) and E the mean over a window, the
        derivative by warped(y) is Σ [a (fixed(y) − E fixed) − b (warped(y) − E warped)] over the windows that hold y,
        each divided by its number of voxels. ε = 1e-5 keeps flat regions finite: they count as not correlated.
        A mask weights the voxels of a window and the windows: E becomes the weighted mean.
        Two sets of box sums a call, of 3 and of 4 fields (6 and 4 with a mask); no window is visited voxel by voxel.
    """

    def __init__(self, fixed: Tensor, window: int = 9) -> None:
        self.fixed, self.window = at_least_float32(fixed), window

    @cached_property
    def _whole(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._around(None)

    def _around(self, weight: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return 1 / weight of the window, mean and variance + ε of the fixed image in it."""
        share = _share(self.fixed, weight, self.window)
        return share, *_moments(self.fixed, weight, share, self.window)

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        warped = at_least_float32(warped)
        weight = relative_weight(mask, warped)
        share, fixed_mean, fixed_variance = self._whole if weight is None else self._around(weight)
        weighted = times(warped, weight)
        sums = box_sum(torch.cat([weighted, weighted * warped, weighted * self.fixed], dim=1), self.window)
        warped_mean, square, product = sums.mul_(share).chunk(3, dim=1)
        covariance = product.sub_(warped_mean * fixed_mean)
        variance = square.sub_(warped_mean * warped_mean).clamp_(min=0).add_(LNCC_FLOOR)
        correlation = covariance / (variance * fixed_variance)
        value = mean(correlation * covariance, weight)
        a = times(correlation, weight).mul_(2 * share)
        b = a * covariance / variance
        back = box_sum(torch.cat([a, a * fixed_mean, b, b * warped_mean], dim=1), self.window)
        a, a_mean, b, b_mean = back.chunk(4, dim=1)
        return value, times(self.fixed * a - a_mean - warped * b + b_mean, weight)


def lncc(fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None, window: int = 9, span: Span = None) -> Tensor:
    """Return S = mean over x of c² / ((v_f + ε)(v_w + ε)), covariance and variances in the window around x.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1, in the windows and of the windows; all ones when None.
        window: width in voxels, odd. At the boundary the part of the window inside the image counts.
        span: intensities taken for 0 and 1, which gives ε = 1e-5 its meaning; None: the smallest and the largest of
            each image where the mask is positive.

    Returns:
        ``(B,)`` between 0 and 1. Flat windows give 0.

    Raises:
        InputError: shapes.

    Notes:
        Differentiable. `LocalCrossCorrelation` has the derivative in closed form.
    """
    fixed, warped = on_unit_scale(fixed, warped, mask, span)
    weight = relative_weight(mask, warped)
    share = _share(fixed, weight, window)
    fixed_mean, fixed_variance = _moments(fixed, weight, share, window)
    warped_mean, variance = _moments(warped, weight, share, window)
    covariance = box_sum(times(fixed * warped, weight), window) * share - fixed_mean * warped_mean
    return mean(covariance.square() / (fixed_variance * variance), weight)


def _share(image: Tensor, weight: Tensor | None, window: int) -> Tensor:
    weight = image.new_ones(1, 1, *image.shape[2:]) if weight is None else weight
    return 1 / box_sum(weight, window).clamp(min=_EMPTY)


def _moments(image: Tensor, weight: Tensor | None, share: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Return mean and variance + ε in the window around each voxel."""
    weighted = times(image, weight)
    first, square = (box_sum(torch.cat([weighted, weighted * image], dim=1), window) * share).chunk(2, dim=1)
    return first, (square - first * first).clamp(min=0) + LNCC_FLOOR
