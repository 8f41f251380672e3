"""Matrices along the axes of a field, with few entries a row, near one another: interpolation, smoothing, windows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

# Rows of a block: fewer entries of it are 0 the fewer rows it has, but small products do not pay. Two fields of 4096²
# on half as many nodes an axis: 0.1 s, against 1.4 s when entries are taken one by one.
_ROWS = {"cpu": 32, "cuda": 256}

# Matrices of no more entries than this are one block: a call costs more than the products with their zeros.
_SMALL = 2**13

# Standard deviations to which a Gaussian reaches.
_REACH = 3


@dataclass(frozen=True)
class Banded:
    """A matrix as dense blocks of some rows and the columns that those need.

    Attributes:
        shape: rows and columns.
        blocks: the first column and the entries ``(rows, columns)`` of each.
    """

    shape: tuple[int, int]
    blocks: tuple[tuple[int, Tensor], ...]

    def along(self, field: Tensor, axis: int) -> Tensor:
        """Return the product with every line of a field ``(B, C, *S)`` along an axis of the tensor.

        Notes:
            The same order of summation in every run. Differentiable; where a gradient is wanted by the dense matrix,
            whose derivative is one product as well.
        """
        shape = (*field.shape[:axis], self.shape[0], *field.shape[axis + 1 :])
        if torch.is_grad_enabled() and field.requires_grad:
            last = axis == field.dim() - 1
            return field @ self._dense.T if last else (self._dense @ field.flatten(axis + 1)).view(shape)
        lines = _lines(field.contiguous(), axis)
        if len(self.blocks) == 1:
            return self._whole(lines, axis == field.dim() - 1).view(shape)
        factors = [
            (entries.expand(len(lines), -1, -1), lines.narrow(1, first, entries.shape[1]))
            for first, entries in self.blocks
        ]
        found = field.new_empty(shape)
        parts = _lines(found, axis).split([len(entries) for _, entries in self.blocks], dim=1)
        for pair, part in zip(factors, parts, strict=True):
            torch.bmm(*pair, out=part)
        return found

    def _whole(self, lines: Tensor, last: bool) -> Tensor:
        """Return the product of the only block with lines as `_lines` gives them, in the order of a field's memory."""
        first, entries = self.blocks[0]
        lines = lines.narrow(1, first, entries.shape[1])
        return lines[0].T @ entries.T if last else entries @ lines

    @cached_property
    def _dense(self) -> Tensor:
        with torch.inference_mode(False), torch.no_grad():
            columns = self.shape[1]
            rows = [F.pad(entries, (k, columns - k - entries.shape[1])) for k, entries in self.blocks]
            return torch.cat(rows)


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
    return None if coarse == fine else banded(*_linear(coarse, fine), (fine, coarse), like)


def gathering(fine: int, coarse: int, like: Tensor) -> Banded | None:
    """Return the transpose of `interpolation`, divided by the number of fine intervals to a coarse one."""
    rows, columns, values = _linear(coarse, fine)
    return None if coarse == fine else banded(columns, rows, values * ((coarse - 1) / (fine - 1)), (coarse, fine), like)


def restriction(fine: int, coarse: int, blur: float, like: Tensor) -> Banded | None:
    """Return smoothing by a Gaussian, continued by its values at the ends, and linear interpolation to fewer nodes.

    Args:
        fine: number of nodes that are given.
        coarse: number of nodes wanted.
        blur: standard deviation in voxels of the coarse axis.
        like: a tensor with the dtype and device wanted.
    """
    if coarse == fine:
        return None
    sigma = blur * (fine - 1) / (coarse - 1)
    radius = math.ceil(_REACH * sigma)
    offset = torch.arange(-radius, radius + 1)
    kernel = torch.softmax(-(offset.double() ** 2) / (2 * sigma**2), dim=0)
    rows, columns, values = (part.unsqueeze(1) for part in _linear(fine, coarse))
    columns, values = (columns + offset).clamp(0, fine - 1), values * kernel
    flat = rows.expand_as(columns).flatten(), columns.flatten(), values.flatten()
    return banded(*flat, (coarse, fine), like)


def _linear(given: int, wanted: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows, columns and values of linear interpolation from so many nodes of an interval to others."""
    rows = torch.arange(wanted)
    place = rows.double() * ((given - 1) / (wanted - 1))
    left = place.long().clamp(max=given - 2)
    share = place - left
    return rows.repeat(2), torch.cat([left, left + 1]), torch.cat([1 - share, share])


def banded(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int], like: Tensor) -> Banded:
    """Return the matrix with the entries ``values`` in these rows and columns ``(n,)``, those of one place being added.

    Args:
        rows: whole numbers.
        columns: whole numbers, near one another in rows that are.
        values: entries.
        shape: rows and columns of the matrix.
        like: a tensor with the dtype and device wanted.
    """
    blocks, size = [], shape[0] if math.prod(shape) <= _SMALL else _ROWS.get(like.device.type, 256)
    for start in range(0, shape[0], size):
        here = (rows >= start) & (rows < start + size)
        near = columns[here] if bool(here.any()) else columns.new_zeros(1)
        first = int(near.min())
        entries = values.new_zeros(min(size, shape[0] - start), int(near.max()) + 1 - first)
        entries.index_put_((rows[here] - start, columns[here] - first), values[here], accumulate=True)
        blocks.append((first, entries.to(like)))
    return Banded(shape, tuple(blocks))
