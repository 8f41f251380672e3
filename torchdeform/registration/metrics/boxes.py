"""Sums over the windows around the nodes, all of them or every second or third, and the transpose."""

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.registration.products import DENSE_LIMIT, dense_product


def box_sum(x: Tensor, window: int, stride: int = 1) -> Tensor:
    """Return Σ x over the window around each node, cut off at the boundary, or around the nodes of `centres` only.

    Args:
        x: ``(B, C, *S)``.
        window: width in nodes, odd.
        stride: nodes from one window to the next along every axis.

    Returns:
        ``(B, C, *W)``, W = ⌈S / stride⌉.

    Notes:
        Linear, with stride 1 self-adjoint. No running total, so nothing cancels in float32. With a stride most of the
        work is along the first axis, where a product with the matrix is cheapest.
    """
    for axis in range(2, x.dim()):
        small = x.shape[axis] <= DENSE_LIMIT
        x = dense_product(x, _band(x.shape[axis], window, stride, x), axis) if small else _far(x, axis, window, stride)
    return x


def box_spread(y: Tensor, window: int, stride: int, shape: tuple[int, ...]) -> Tensor:
    """Return at each node Σ y over the windows that hold it: the transpose of `box_sum` on ``shape``.

    Args:
        y: ``(B, C, *W)``, one number for each window.
        window: width in nodes, odd.
        stride: nodes from one window to the next along every axis.
        shape: S.

    Returns:
        ``(B, C, *S)``.
    """
    for axis, size in reversed(list(enumerate(shape, start=2))):
        if size <= DENSE_LIMIT:
            y = dense_product(y, _band(size, window, stride, y).T, axis)
        else:
            apart = y.new_zeros(*y.shape[:axis], size, *y.shape[axis + 1 :])
            _at_centres(apart, axis, stride).copy_(y)
            y = _far(apart, axis, window, 1)
    return y


def centres(x: Tensor, stride: int) -> Tensor:
    """Return the entries of ``(B, C, *S)`` at the nodes around which `box_sum` takes its windows."""
    for axis in range(2, x.dim()):
        x = _at_centres(x, axis, stride)
    return x


def _at_centres(x: Tensor, axis: int, stride: int) -> Tensor:
    """Return every ``stride``-th entry, what is left over shared out between both ends."""
    first = (x.shape[axis] - 1) % stride // 2
    return x[(slice(None),) * axis + (slice(first, None, stride),)]


def _band(size: int, window: int, stride: int, like: Tensor) -> Tensor:
    return _made_band(size, window, stride, like.dtype, like.device)


@lru_cache(maxsize=64)
def _made_band(size: int, window: int, stride: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the matrix of ones where the window of a row holds the node of a column."""
    with torch.inference_mode(False):
        node = torch.arange(size, device=device)
        middle = _at_centres(node, 0, stride)
        return ((middle[:, None] - node).abs() <= window // 2).to(dtype)


def _far(x: Tensor, axis: int, window: int, stride: int) -> Tensor:
    """Return the sums along a long axis, by shifted views."""
    padding = [0, 0] * (x.dim() - 1 - axis) + [window // 2] * 2
    return _at_centres(_windows(F.pad(x, padding), axis, window), axis, stride)


def _windows(x: Tensor, axis: int, window: int) -> Tensor:
    """Sums of ``window`` neighbours where all exist: two sums of half the window, and one entry if it is odd."""
    if window == 1:
        return x
    half, count = window // 2, x.shape[axis] - window + 1
    sums = _windows(x, axis, half)
    total = sums.narrow(axis, 0, count) + sums.narrow(axis, half, count)
    return total.add_(x.narrow(axis, window - 1, count)) if window % 2 else total
