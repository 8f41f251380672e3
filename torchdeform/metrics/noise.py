"""How much of an image is noise: what of it no neighbour shares."""

import torch
from torch import Tensor

from torchdeform.core.resampling import box_sum, centres
from torchdeform.metrics.base import weighted
from torchdeform.metrics.correlation import LNCC_FLOOR, contrast, moments

# Windows in which noise is compared with contrast, and the way from one to the next.
_WINDOW, _STRIDE = 9, 3


@torch.no_grad()
def noise_share(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean of σ² / (v + ε) over windows of variance v, σ² being the mean of (Δ_1 .. Δ_D image)² / 2^D there.

    Δ_k is the difference of neighbours along axis k.

    Args:
        image: ``(B, C, *S)``, scaled to about [0, 1].
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.

    Returns:
        ``(B,)``, the mean over channels: 1 for white noise alone, 0 for what is smooth. Windows count as much as they
        have contrast.

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
    variance = moments(image, mask, 1 / count, _WINDOW, _STRIDE)[1]
    noise = box_sum(weighted(detail * detail, mask), _WINDOW, _STRIDE) / count
    seen = weighted(contrast(variance), None if mask is None else centres(mask, _STRIDE))
    share = (seen * noise / (variance + LNCC_FLOOR)).flatten(2).sum(2) / seen.flatten(2).sum(2).clamp(min=1e-6)
    return share.mean(1)
