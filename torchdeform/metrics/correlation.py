"""Normalised cross-correlation, of whole images and of the windows around each voxel."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchdeform.core.grid import over_slabs, per_item
from torchdeform.core.resampling import box_sum, box_sum_by_rows, box_sum_transpose, centres, least_rows
from torchdeform.metrics.base import (
    IntensityRange,
    Similarity,
    at_least_float32,
    channel_mean,
    mean,
    on_unit_scale,
    relative_weight,
    weighted,
)

# Added to the covariance and to both variances of LNCC, as if both images had one more texture in common, for images
# scaled to [0, 1]: windows flatter than a grey level of 0.3 % agree.
LNCC_FLOOR = 1e-5

# Windows of the fixed image with this standard deviation have weight 1/2 in LNCC; its intensities are scaled to [0, 1].
LNCC_CONTRAST = 0.01

# Added to both variances of NCC: images flatter than a grey level of 0.01 % are flat.
NCC_FLOOR = 1e-8

# An image whose windows weigh less than this on average is flat: its variances are rounding.
_FLAT = 1e-5

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
        return value.flatten(1).mean(1), weighted(scale * fixed - (value / variance) * warped, weight)


def ncc(fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None, intensity_range: IntensityRange = None) -> Tensor:
    """Return S = c / √((v_f + ε)(v_w + ε)), the correlation of two images, 1 at best and −1 for reversed contrast.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.
        intensity_range: intensities taken for 0 and 1, which gives ε = 1e-8 its meaning; None: the smallest and the
            largest of each image where the mask is positive.

    Returns:
        ``(B,)``, the mean over channels. Flat images give 0.

    Raises:
        InputError: shapes.

    Notes:
        Differentiable. `CrossCorrelation` has the derivative in closed form.
    """
    fixed, warped = on_unit_scale(fixed, warped, mask, intensity_range)
    weight = relative_weight(mask, warped)
    (fixed, fixed_variance), (warped, variance) = _centred(fixed, weight), _centred(warped, weight)
    return (channel_mean(fixed * warped, weight) * (fixed_variance * variance).rsqrt()).flatten(1).mean(1)


def _centred(image: Tensor, weight: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the image less its mean, and its variance + ε ``(B, C, 1, ..)``."""
    image = image - channel_mean(image, weight)
    return image, channel_mean(image * image, weight) + NCC_FLOOR


@dataclass(frozen=True)
class _Windows:
    """What is known of the windows before anything is warped, one number for each window ``(B, C or 1, *W)``.

    Attributes:
        weight: of the voxels ``(B or 1, 1, *S)``, 1 on average; None for 1 everywhere.
        window_weight: of a window: its `contrast` in the fixed image, times the weight of the voxel in its middle; 1 on
            average.
        inverse_count: 1 / weight of its voxels.
        mean: of the fixed image in it.
        variance: of the fixed image in it, + ε.
    """

    weight: Tensor | None
    window_weight: Tensor
    inverse_count: Tensor
    mean: Tensor
    variance: Tensor


class LocalCrossCorrelation(Similarity):
    """S = mean over x of t (|c| + ε)² / ((v_f + ε)(v_w + ε)), covariance and variances in the window around x.

    The weight t = v_f² / (v_f² + τ⁴), 1 on average, leaves out what has no contrast in the fixed image.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        window: width in voxels, odd. At the boundary the part of the window inside the image counts.
        stride: voxels from one x to the next along every axis.

    Notes:
        Lies in [0, 1], and is 1 for equal images, where the derivative is 0: with ε in the variances alone, noise in
        flat regions would be enlarged for ever. With k = c + ε sgn c, a = 2 t k/((v_f + ε)(v_w + ε)), b = a k/(v_w + ε)
        and E the mean over a window, the derivative by warped(y) is the sum over the windows that hold y of
        a (fixed(y) − E fixed) − b (warped(y) − E warped), divided by their numbers of voxels. ε = 1e-5, τ = 0.01.
        A mask weights the voxels of a window and the windows: E becomes the weighted mean.
        Box sums of 3 fields and the transpose of 3 a call; 3 more for a mask that is not the one of the call before.
        With stride 3, as in `register` with windows of 9, there are 27 times fewer windows in 3D, and maps are as good.
        Not differentiable, see `lncc`.
    """

    def __init__(self, fixed: Tensor, window: int = 9, stride: int = 1) -> None:
        self.fixed, self.window, self.stride = at_least_float32(fixed), window, stride
        self._last: tuple[Tensor | None, int, _Windows] | None = None

    def _windows(self, mask: Tensor | None, warped: Tensor) -> _Windows:
        """Return what depends on the mask only; kept for the next call, in which it is often the same."""
        version = 0 if mask is None or mask.is_inference() else mask._version
        if self._last is None or self._last[0] is not mask or self._last[1] != version:
            windows = _windows(self.fixed, relative_weight(mask, warped), self.window, self.stride)
            self._last = mask, version, windows
        return self._last[2]

    @torch.no_grad()
    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        warped = at_least_float32(warped)
        windows = self._windows(mask, warped)
        shape = tuple(warped.shape[2:])

        def products(rows: slice) -> Tensor:
            weight = None if windows.weight is None else windows.weight[:, :, rows]
            return _products(warped[:, :, rows], self.fixed[:, :, rows], weight)

        sums = box_sum_by_rows(products, shape, warped, self.window, self.stride).mul_(windows.inverse_count)
        warped_mean, square, product = sums.chunk(3, dim=1)
        covariance = _raised(product.addcmul_(warped_mean, windows.mean, value=-1))
        variance = square.addcmul_(warped_mean, warped_mean, value=-1).clamp_(min=0).add_(LNCC_FLOOR)
        correlation = (covariance / (variance * windows.variance)).mul_(windows.window_weight)
        value = mean(correlation * covariance)
        a = correlation.mul_(windows.inverse_count * (2 * warped[0, 0].numel() / correlation[0, 0].numel()))
        b = a * covariance / variance
        back = torch.cat([a, b, b * warped_mean - a * windows.mean], dim=1)
        backs = box_sum_transpose(back, self.window, self.stride, shape)

        def slope(rows: slice) -> Tensor:
            a, b, rest = backs(rows).chunk(3, dim=1)
            part = rest.addcmul(self.fixed[:, :, rows], a).addcmul_(warped[:, :, rows], b, value=-1)
            return part if windows.weight is None else part.mul_(windows.weight[:, :, rows])

        return value, over_slabs(slope, shape, warped.device, least=least_rows(shape))


def lncc(
    fixed: Tensor,
    warped: Tensor,
    *,
    mask: Tensor | None = None,
    window: int = 9,
    intensity_range: IntensityRange = None,
    stride: int = 1,
) -> Tensor:
    """Return S = mean over x of t (|c| + ε)² / ((v_f + ε)(v_w + ε)), covariance and variances in the window around x.

    The weight t = v_f² / (v_f² + τ⁴), 1 on average, leaves out what has no contrast in the fixed image.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1, in the windows and of the windows; all ones when None.
        window: width in voxels, odd. At the boundary the part of the window inside the image counts.
        intensity_range: intensities taken for 0 and 1, which gives ε = 1e-5 and τ = 0.01 their meaning; None: the
            smallest and the largest of each image where the mask is positive.
        stride: voxels from one x to the next along every axis.

    Returns:
        ``(B,)`` between 0 and 1: 1 for equal images, about 1 / (voxels of a window − 1) for white noise.

    Raises:
        InputError: shapes.

    Notes:
        Differentiable. `LocalCrossCorrelation` has the derivative in closed form.
    """
    fixed, warped = on_unit_scale(fixed, warped, mask, intensity_range)
    windows = _windows(fixed, relative_weight(mask, warped), window, stride)
    warped_mean, variance = moments(warped, windows.weight, windows.inverse_count, window, stride)
    product = box_sum(weighted(fixed * warped, windows.weight), window, stride) * windows.inverse_count
    covariance = _raised(product - windows.mean * warped_mean)
    return mean(covariance.square() / (windows.variance * (variance + LNCC_FLOOR)), windows.window_weight)


def _windows(fixed: Tensor, weight: Tensor | None, window: int, stride: int) -> _Windows:
    ones = fixed.new_ones(1, 1, *fixed.shape[2:]) if weight is None else weight
    inverse_count = 1 / box_sum(ones, window, stride).clamp(min=_EMPTY)
    middle, variance = moments(fixed, weight, inverse_count, window, stride)
    counted = contrast(variance)
    counted = counted if weight is None else counted * centres(weight, stride)
    counted = counted / per_item(counted.flatten(1).mean(1).clamp(min=_FLAT), counted)
    return _Windows(weight, counted, inverse_count, middle, variance + LNCC_FLOOR)


def _raised(covariance: Tensor) -> Tensor:
    """Return c + ε sgn c: reversed contrast is as good."""
    return covariance + torch.full_like(covariance, LNCC_FLOOR).copysign(covariance)


def contrast(variance: Tensor, deviation: float = LNCC_CONTRAST) -> Tensor:
    """Return the weight v² / (v² + τ⁴) of windows with variance v in an image scaled to about [0, 1], τ a deviation."""
    square = variance.square()
    return square / (square + deviation**4)


def moments(
    image: Tensor, weight: Tensor | None, inverse_count: Tensor, window: int, stride: int
) -> tuple[Tensor, Tensor]:
    """Return mean and variance in the window around each voxel, of weighted voxels; 1 / weight of a window is given."""

    def powers(rows: slice) -> Tensor:
        part = image[:, :, rows]
        first = weighted(part, None if weight is None else weight[:, :, rows])
        return torch.cat([first, first * part], dim=1)

    sums = box_sum_by_rows(powers, image.shape[2:], image, window, stride)
    first, square = (sums * inverse_count).chunk(2, dim=1)
    return first, (square - first * first).clamp(min=0)


def _products(warped: Tensor, fixed: Tensor, weight: Tensor | None) -> Tensor:
    """Return weight · warped, weight · warped² and weight · warped · fixed side by side; no memory but theirs."""
    items, channels, *shape = warped.shape
    fields = warped.new_empty(items, 3 * channels, *shape)
    first, square, product = fields.chunk(3, dim=1)
    first.copy_(warped)
    if weight is not None:
        first.mul_(weight)
    torch.mul(first, warped, out=square)
    torch.mul(first, fixed, out=product)
    return fields


def local_contrast(image: Tensor, window: int, deviation: float = LNCC_CONTRAST) -> Tensor:
    """Return the largest `contrast` of all channels in the windows around each voxel, ``(B, 1, *S)``."""
    return contrast(window_moments(image, window)[1].amax(1, keepdim=True), deviation)


def window_moments(image: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Return mean and variance of the part of the window around each voxel that is inside, both ``(B, C, *S)``."""
    return moments(image, None, 1 / box_sum(torch.ones_like(image[:1, :1]), window), window, 1)


def window_mean(image: Tensor, window: int) -> Tensor:
    """Return the mean of the part of the window around each voxel that is inside, ``(B, C, *S)``."""
    return box_sum(image, window) / box_sum(torch.ones_like(image[:1, :1]), window)


# Images are multiplied by this in `ForegroundLNCC`, so that ε is small against τ² and hardly a window is flat.
_GAIN = 10.0


class ForegroundLNCC(Similarity):
    """LNCC whose voxels, not only its windows, are weighted by t = v² / (v² + τ⁴), v being the variance around them.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        window: width in voxels, odd.

    Notes:
        The background counts neither as a window nor in one. The map of blobs of 10 voxels on an empty background was
        up to 5 voxels off when flat windows counted as not correlated, since a map that enlarges the moving image until
        it covers the background then raises S; it is less than 0.1 off with this.
    """

    def __init__(self, fixed: Tensor, window: int) -> None:
        self.lncc, self.foreground = LocalCrossCorrelation(fixed * _GAIN, window), local_contrast(fixed, window)

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        weight = self.foreground.expand(len(warped), *self.foreground.shape[1:])
        value, derivative = self.lncc.evaluate(warped * _GAIN, weight if mask is None else mask * weight)
        return value, derivative * _GAIN
