"""Sums over the window around each node."""

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

# Up to this many nodes an axis one product with the dense band matrix is the fastest box sum (3×128³ float32, window
# 9: 24 ms an axis against 72 ms for sums of shifted views); its cost per node grows with the axis.
_DENSE_LIMIT = 512


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
