"""How much of an image is noise: what of it no neighbour shares."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.core.resampling import box_sum, centres
from torchdeform.metrics.base import weighted
from torchdeform.metrics.correlation import LNCC_FLOOR, contrast

# Windows in which noise is compared with contrast, and the way from one to the next.
_WINDOW, _STRIDE = 9, 3


@dataclass(frozen=True)
class Noise:
    """The noise of images on one scale.

    Attributes:
        variance: of the noise in each channel ``(B, C)``, in squared units of intensity.
        share: of the variance in a window that is noise ``(B,)``, on average; 1 for white noise alone.
    """

    variance: Tensor
    share: Tensor

    def larger(self, other: "Noise") -> "Noise":
        """Return the larger noise of both, item by item."""
        return Noise(torch.maximum(self.variance, other.variance), torch.maximum(self.share, other.share))


@torch.no_grad()
def noise_of(image: Tensor, mask: Tensor | None = None) -> Noise:
    """Return σ² = mean of (Δ_1 .. Δ_D image)² / 2^D, Δ_k being differences of neighbours along axis k.

    Args:
        image: ``(B, C, *S)``, scaled to about [0, 1].
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.

    Returns:
        `Noise`. Windows count as much as they have contrast.

    Notes:
        Exact on average for white noise on what is smooth across a diagonal; structures of a voxel's size count as
        noise. The diagonal details of a Haar transform are what Donoho and Johnstone, "Ideal spatial adaptation by
        wavelet shrinkage", 1994, estimate noise from.
    """
    detail = image
    for axis in range(2, image.dim()):
        first = detail.narrow(axis, 0, 1)  # as many nodes as before: the first difference is 0
        detail = detail.diff(dim=axis, prepend=first) / 2**0.5
    count = box_sum(torch.ones_like(image[:1, :1]) if mask is None else mask, _WINDOW, _STRIDE).clamp(min=1e-6)
    fields = torch.cat([image, image * image, detail * detail], dim=1)
    mean, square, noise = (box_sum(weighted(fields, mask), _WINDOW, _STRIDE) / count).chunk(3, dim=1)
    variance = (square - mean * mean).clamp(min=0)
    seen = weighted(contrast(variance), None if mask is None else centres(mask, _STRIDE))
    total = seen.flatten(2).sum(2).clamp(min=1e-6)
    share = (seen * noise / (variance + LNCC_FLOOR)).flatten(2).sum(2) / total
    return Noise((seen * noise).flatten(2).sum(2) / total, share.mean(1))
