"""Regions of a grid: the box around a mask, distances to it, and what is said of its nodes alone."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import MAX_POOL
from torchdeform.errors import InputError

# This share of the nodes of a label is looked at where a few do not count.
_COUNTED = 0.999


@dataclass(frozen=True)
class Crop:
    """A box of nodes of a grid.

    Args:
        whole: the grid.
        low: first node along each axis.
        high: one past the last.
    """

    whole: Grid
    low: tuple[int, ...]
    high: tuple[int, ...]

    @staticmethod
    def around(mask: Tensor, grid: Grid, margin: int) -> "Crop":
        """Return the box of the nodes ``mask (*S)`` that has one, and so many nodes around it; at least 3 a side."""
        low, high = [], []
        for axis, n in enumerate(grid.shape):
            found = mask.movedim(axis, 0).flatten(1).any(1).nonzero().flatten()
            first, last = int(found[0]) - margin, int(found[-1]) + margin + 1
            low.append(max(0, min(first, n - 3)))
            high.append(min(n, max(last, low[-1] + 3)))
        return Crop(grid, tuple(low), tuple(high))

    @property
    def grid(self) -> Grid:
        """The grid of its nodes."""
        return Grid(tuple(h - b for b, h in zip(self.low, self.high, strict=True)), self.whole.spacing)

    def of(self, field: Tensor) -> Tensor:
        """Return what a field ``(.., *S)`` of the whole grid says here, as a view."""
        return field[(..., *map(slice, self.low, self.high))]

    def cut(self, axis: int, side: int) -> bool:
        """Tell whether the grid goes on beyond this face."""
        return self.low[axis] > 0 if side == 0 else self.high[axis] < self.whole.shape[axis]

    def without_rim(self, part: Tensor) -> Tensor:
        """Return ``part (B, C, *crop)`` without the layer of nodes at each face that is cut, as a view."""
        for axis, (n, dim) in enumerate(zip(self.grid.shape, self.whole.axes, strict=True)):
            low, high = (int(self.cut(axis, side)) for side in (0, 1))
            part = part.narrow(dim, low, n - low - high)
        return part

    def replaced(self, field: Tensor, part: Tensor) -> Tensor:
        """Return the field of the whole grid with ``part`` here."""
        whole = field.clone()
        self.of(whole).copy_(part)
        return whole


def require_labels(labels: Tensor, grid: Grid, name: str) -> None:
    """Raise `InputError`, which names ``name``, unless labels are a bool tensor ``(B, L, *S)`` on the grid."""
    if labels.dtype != torch.bool or labels.dim() != grid.dim + 2 or tuple(labels.shape[2:]) != grid.shape:
        want = ", ".join(["B", "L", *map(str, grid.shape)])
        raise InputError(f"{name} must be bool of shape ({want}), got {labels.dtype} of {tuple(labels.shape)}")


def all_but_few(values: Tensor) -> Tensor:
    """Return the largest of ``(N,)`` but for one in a thousand."""
    return values.kthvalue(math.ceil(_COUNTED * len(values))).values


def grown(mask: Tensor, steps: int = 1) -> Tensor:
    """Return the mask ``(B, C, *S)`` of bool with all neighbours of its nodes, over corners too, so many times."""
    return MAX_POOL[mask.dim() - 2](mask.float(), 2 * steps + 1, stride=1, padding=steps) > 0


def nearest(mask: Tensor, reach: int) -> tuple[Tensor, Tensor]:
    """Return how far the nearest node of a mask is, squared and in voxels, and which it is.

    Args:
        mask: ``(B, C, *S)`` of bool.
        reach: what is farther along an axis is not looked at.

    Returns:
        ``(B, C, *S)`` float32, infinite where that is farther than reach; and ``(B, C, *S)``, the node's number on the
        grid, its own where there is none.

    Notes:
        Exact, one axis after the other: the least over k of what was found so far k nodes from here, and k².
    """
    squares = torch.zeros(mask.shape, dtype=torch.float32, device=mask.device).masked_fill_(~mask, math.inf)
    number = torch.arange(math.prod(mask.shape[2:]), device=mask.device).view(mask.shape[2:]).expand(mask.shape)
    for axis in range(2, mask.dim()):
        n, before, was, squares, number = mask.shape[axis], squares, number, squares.clone(), number.clone()
        for k in range(1, min(reach, n - 1) + 1):
            for to, start in ((k, 0), (0, k)):
                target, place = (field.narrow(axis, to, n - k) for field in (squares, number))
                other = before.narrow(axis, start, n - k) + k * k
                nearer = other < target
                place.copy_(torch.where(nearer, was.narrow(axis, start, n - k), place))
                torch.minimum(target, other, out=target)
    return squares.masked_fill_(squares > reach * reach, math.inf), number
