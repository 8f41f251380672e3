"""Matrices along the axes of a field, with few entries a row, near one another: interpolation, smoothing, windows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# Rows of a block: fewer entries of it are 0 the fewer rows it has, but small products do not pay. Two fields of 4096²
# on half as many nodes an axis: 0.1 s, against 1.3 s when entries are taken one by one and 0.4 s with blocks of 512.
_ROWS = {"cpu": 32, "cuda": 256}

# Standard deviations to which a Gaussian reaches.
_REACH = 3


@dataclass(frozen=True)
class Banded:
    """A matrix as dense blocks of some rows and the columns that those need.

    Attributes:
        count: number of rows.
        blocks: the first column and the entries ``(rows, columns)`` of each.
    """

    count: int
    blocks: tuple[tuple[int, Tensor], ...]

    def along(self, field: Tensor, axis: int) -> Tensor:
        """Return the product with every line of a field ``(B, C, *S)`` along an axis of the tensor.

        Notes:
            The same order of summation in every run. Differentiable; where a gradient is wanted, with one more copy.
        """
        lines = _lines(field.contiguous(), axis)
        factors = [
            (entries.expand(len(lines), -1, -1), lines.narrow(1, first, entries.shape[1]))
            for first, entries in self.blocks
        ]
        shape = (*field.shape[:axis], self.count, *field.shape[axis + 1 :])
        if torch.is_grad_enabled() and field.requires_grad:
            found = torch.cat([torch.bmm(*pair) for pair in factors], dim=1)
            return (found[0].T if axis == field.dim() - 1 else found).reshape(shape)
        found = field.new_empty(shape)
        parts = _lines(found, axis).split([len(entries) for _, entries in self.blocks], dim=1)
        for pair, part in zip(factors, parts, strict=True):
            torch.bmm(*pair, out=part)
        return found


def _lines(field: Tensor, axis: int) -> Tensor:
    """Return a view ``(n, size, m)`` of a field with ``size`` nodes along the axis."""
    size = field.shape[axis]
    if axis == field.dim() - 1:
        return field.view(-1, size).T.unsqueeze(0)
    return field.view(math.prod(field.shape[:axis]), size, -1)


def multiply(field: Tensor, factors: Sequence[Banded | None]) -> Tensor:
    """Return the products of a field ``(B, C, *S)`` with one matrix an axis; None leaves an axis as it is."""
    for axis, factor in enumerate(factors, start=2):
        field = field if factor is None else factor.along(field, axis)
    return field


def interpolation(coarse: int, fine: int, like: Tensor) -> Banded | None:
    """Return linear interpolation from nodes of an axis to more of them, both with one at each end; None for as many.

    Args:
        coarse: number of nodes that are given.
        fine: number of nodes wanted.
        like: a tensor with the dtype and device wanted.
    """
    return None if coarse == fine else banded(*_linear(coarse, fine), fine, like)


def gathering(fine: int, coarse: int, like: Tensor) -> Banded | None:
    """Return the transpose of `interpolation`, divided by the number of fine intervals to a coarse one."""
    rows, columns, values = _linear(coarse, fine)
    return None if coarse == fine else banded(columns, rows, values * ((coarse - 1) / (fine - 1)), coarse, like)


def restriction(fine: int, coarse: int, blur: float, like: Tensor) -> Banded | None:
    """Return smoothing by a Gaussian, continued by its values at the ends, and linear interpolation to fewer nodes.

    Args:
        fine: number of nodes that are given.
        coarse: number of nodes wanted.
        blur: standard deviation in voxels of the coarse axis.
        like: a tensor with the dtype and device wanted.
    """
    sigma = blur * (fine - 1) / (coarse - 1)
    radius = math.ceil(_REACH * sigma)
    offset = torch.arange(-radius, radius + 1)
    kernel = torch.softmax(-(offset.double() ** 2) / (2 * sigma**2), dim=0)
    rows, columns, values = (part.unsqueeze(1) for part in _linear(fine, coarse))
    columns, values = (columns + offset).clamp(0, fine - 1), values * kernel
    flat = rows.expand_as(columns).flatten(), columns.flatten(), values.flatten()
    return None if coarse == fine else banded(*flat, coarse, like)


def _linear(given: int, wanted: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows, columns and values of linear interpolation from so many nodes of an interval to others."""
    rows = torch.arange(wanted)
    place = rows.double() * ((given - 1) / (wanted - 1))
    left = place.long().clamp(max=given - 2)
    share = place - left
    return rows.repeat(2), torch.cat([left, left + 1]), torch.cat([1 - share, share])


def banded(rows: Tensor, columns: Tensor, values: Tensor, count: int, like: Tensor) -> Banded:
    """Return the matrix with the entries ``values`` in these rows and columns ``(n,)``, those of one place being added.

    Args:
        rows: whole numbers below ``count``.
        columns: whole numbers, near one another in rows that are.
        values: entries.
        count: number of rows.
        like: a tensor with the dtype and device wanted.
    """
    blocks, size = [], _ROWS.get(like.device.type, 256)
    for start in range(0, count, size):
        here = (rows >= start) & (rows < start + size)
        near = columns[here] if bool(here.any()) else columns.new_zeros(1)
        first = int(near.min())
        entries = values.new_zeros(min(size, count - start), int(near.max()) + 1 - first)
        entries.index_put_((rows[here] - start, columns[here] - first), values[here], accumulate=True)
        blocks.append((first, entries.to(like)))
    return Banded(count, tuple(blocks))
