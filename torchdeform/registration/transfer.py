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
    def _ups(self) -> list[Tensor]:
        return [self._matrix(axis) for axis in range(self.fine.dim)]

    @cached_property
    def _downs(self) -> list[Tensor]:
        ratios = [h / wide for h, wide in zip(self.fine.spacing, self.coarse.spacing, strict=True)]
        return [(matrix.T * ratio).contiguous() for matrix, ratio in zip(self._ups, ratios, strict=True)]

    def _matrix(self, axis: int) -> Tensor:
        """Return the matrix of linear interpolation along an axis ``(fine, coarse)``."""
        hats = torch.eye(self.coarse.shape[axis], dtype=self.like.dtype, device=self.like.device).unsqueeze(0)
        return F.interpolate(hats, size=self.fine.shape[axis], mode="linear", align_corners=True)[0].T.contiguous()


def _products(field: Tensor, matrices: Sequence[Tensor]) -> Tensor:
    """Multiply along every axis."""
    for axis, matrix in enumerate(matrices, start=2):
        if matrix.shape[0] != matrix.shape[1]:
            product = _dense_product if max(matrix.shape) <= _DENSE_LIMIT else _band_product
            field = product(field, matrix, axis)
    return field


def _dense_product(field: Tensor, matrix: Tensor, axis: int) -> Tensor:
    if axis == field.dim() - 1:
        return field @ matrix.T
    shape = (*field.shape[:axis], matrix.shape[0], *field.shape[axis + 1 :])
    return (matrix @ field.flatten(axis + 1)).view(shape)


def _band_product(field: Tensor, matrix: Tensor, axis: int) -> Tensor:
    """Multiply by a matrix with few entries in each row: the same order of summation in every run."""
    width = int((matrix != 0).sum(1).amax())
    weights, nodes = matrix.topk(width, dim=1)
    rest = [1] * (field.dim() - 1 - axis)
    terms = (field.index_select(axis, nodes[:, k]) * weights[:, k].view(-1, *rest) for k in range(width))
    return sum(terms, start=field.new_zeros(()))
