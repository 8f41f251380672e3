"""Between the grid of the images and a coarser one that carries the map: linear interpolation and its transpose."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.grid import Grid

# Up to this many nodes an axis the product with the dense matrix is the fastest interpolation (3×128×112×80 float32:
# 11 ms against 35 ms of `torch.nn.functional.interpolate`); longer axes take its few entries one by one.
_DENSE_LIMIT = 512


@dataclass(frozen=True)
class Transfer:
    """Fields on two grids of one box.

    Args:
        fine: grid of the images.
        coarse: grid of the map, no finer along any axis.
        like: a tensor with the dtype and device wanted.
    """

    fine: Grid
    coarse: Grid
    like: Tensor

    def up(self, field: Tensor) -> Tensor:
        """Return a field ``(B, C, *coarse)`` at the nodes of the fine grid, by linear interpolation."""
        return _products(field, self._ups)

    def gather(self, force: Tensor) -> Tensor:
        """Return the force density on the coarse grid that does the same work as one ``(B, C, *fine)``.

        The transpose of `up`, divided by the number of fine nodes to a coarse one.
        """
        return _products(force, self._downs)

    @cached_property
    def _ups(self) -> list["_Along | None"]:
        return [_along(matrix) for matrix in self._matrices()]

    @cached_property
    def _downs(self) -> list["_Along | None"]:
        ratios = [h / wide for h, wide in zip(self.fine.spacing, self.coarse.spacing, strict=True)]
        return [_along(matrix.T * ratio) for matrix, ratio in zip(self._matrices(), ratios, strict=True)]

    def _matrices(self) -> list[Tensor]:
        """Return the matrix of linear interpolation along each axis ``(fine, coarse)``."""
        matrices = []
        for size, nodes in zip(self.fine.shape, self.coarse.shape, strict=True):
            hats = torch.eye(nodes, dtype=self.like.dtype, device=self.like.device).unsqueeze(0)
            matrices.append(F.interpolate(hats, size=size, mode="linear", align_corners=True)[0].T)
        return matrices


@dataclass(frozen=True)
class _Band:
    """The entries of a matrix that has few in each row: their values and columns ``(rows, width)``."""

    values: Tensor
    columns: Tensor


_Along = Tensor | _Band


def _along(matrix: Tensor) -> _Along | None:
    """Return a matrix as it is multiplied along an axis; None where both grids have the same nodes."""
    if matrix.shape[0] == matrix.shape[1]:
        return None
    if max(matrix.shape) <= _DENSE_LIMIT:
        return matrix.contiguous()
    return _Band(*matrix.topk(int((matrix != 0).sum(1).amax()), dim=1))


def _products(field: Tensor, factors: Sequence[_Along | None]) -> Tensor:
    """Multiply along every axis."""
    for axis, factor in enumerate(factors, start=2):
        if isinstance(factor, _Band):
            field = _band_product(field, factor, axis)
        elif factor is not None:
            field = _dense_product(field, factor, axis)
    return field


def _dense_product(field: Tensor, matrix: Tensor, axis: int) -> Tensor:
    if axis == field.dim() - 1:
        return field @ matrix.T
    shape = (*field.shape[:axis], matrix.shape[0], *field.shape[axis + 1 :])
    return (matrix @ field.flatten(axis + 1)).view(shape)


def _band_product(field: Tensor, band: _Band, axis: int) -> Tensor:
    """Take the entries of each row one by one: the same order of summation in every run."""
    rest = [1] * (field.dim() - 1 - axis)
    entries = zip(band.values.unbind(1), band.columns.unbind(1), strict=True)
    terms = (field.index_select(axis, columns) * values.view(-1, *rest) for values, columns in entries)
    return sum(terms, start=field.new_zeros(()))
