"""Sums over the windows around the nodes, all of them or every second or third, and the transpose."""

from functools import lru_cache

import torch
from torch import Tensor

from torchdeform.registration.banded import Banded, banded


def box_sum(x: Tensor, window: int, stride: int = 1) -> Tensor:
    """Return Σ x over the window around each node, cut off at the boundary, or around the nodes of `centres` only.

    Args:
        x: ``(B, C, *S)``.
        window: width in nodes, odd.
        stride: nodes from one window to the next along every axis.

    Returns:
        ``(B, C, *W)``, W = ⌈S / stride⌉.

    Notes:
        Linear, with stride 1 self-adjoint. No running total, so nothing cancels in float32.
    """
    for axis in range(2, x.dim()):
        x = _windows(x.shape[axis], window, stride, x.dtype, x.device)[0].along(x, axis)
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
        y = _windows(size, window, stride, y.dtype, y.device)[1].along(y, axis)
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


@lru_cache(maxsize=64)
def _windows(size: int, window: int, stride: int, dtype: torch.dtype, device: torch.device) -> tuple[Banded, Banded]:
    """Return the matrix of ones where the window of a row holds the node of a column, and its transpose."""
    with torch.inference_mode(False), torch.no_grad():
        like = torch.empty(0, dtype=dtype, device=device)
        middle = _at_centres(torch.arange(size), 0, stride).unsqueeze(1)
        nodes = middle + torch.arange(window) - window // 2
        inside = (nodes >= 0) & (nodes < size)
        rows, columns = torch.arange(len(middle)).unsqueeze(1).expand_as(nodes)[inside], nodes[inside]
        ones, count = torch.ones(len(rows)), len(middle)
        return banded(rows, columns, ones, (count, size), like), banded(columns, rows, ones, (size, count), like)
