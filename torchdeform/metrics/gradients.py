"""Normalised gradient fields: edges that point along the same line, whatever the contrast across them."""

import torch
from torch import Tensor

from torchdeform.core.derivatives import add_adjoint_derivative, derivative
from torchdeform.core.grid import Grid
from torchdeform.metrics.base import (
    IntensityRange,
    Similarity,
    at_least_float32,
    mean,
    on_unit_scale,
    relative_weight,
    weighted,
)

# The smallest edge, in grey levels a voxel of images scaled to [0, 1].
_SMALLEST_EDGE = 1e-3


class GradientFields(Similarity):
    """S = mean (∇f · ∇w)² / ((|∇f|² + η²)(|∇w|² + η²)).

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        grid: its grid.
        edge: η in units of the mean of |∇f|; shorter gradients count as noise. From 1 on, steeper is more similar.

    Raises:
        InputError: fewer than 3 nodes on an axis.

    Notes:
        Lies in [0, 1]. With p = ∇f/√(|∇f|² + η²), c = p · ∇w and r = |∇w|² + η², the derivative is
        Σ_a D_aᵀ [2 c/r (p_a − c/r ∂_a w)], D_a being the difference kernel along axis a. The weight of a voxel is the
        smallest in the mask among those that its differences use.
    """

    def __init__(self, fixed: Tensor, grid: Grid, *, edge: float = 0.1) -> None:
        self.grid = grid
        gradient = _gradient(at_least_float32(fixed), grid)
        self.square = _squared_edge(gradient, grid, edge)
        length = (_squares(gradient) + self.square).sqrt_()
        self.direction = [part.div_(length) for part in gradient]

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        warped = at_least_float32(warped)
        weight = relative_weight(_smallest_in_stencil(mask), warped)
        gradient = _gradient(warped, self.grid)
        along = _dot(self.direction, gradient)
        ratio = along / (_squares(gradient) + self.square)
        value = mean(along.mul_(ratio), weight)
        factor, total = weighted(2 * ratio, weight), torch.zeros_like(warped)
        for axis, (p, g) in enumerate(zip(self.direction, gradient, strict=True)):
            add_adjoint_derivative(total, torch.addcmul(p, ratio, g, value=-1).mul_(factor), self.grid, axis)
        return value, total


def ngf(
    fixed: Tensor,
    warped: Tensor,
    *,
    mask: Tensor | None = None,
    grid: Grid | None = None,
    edge: float = 0.1,
    intensity_range: IntensityRange = None,
) -> Tensor:
    """Return S = mean (∇f · ∇w)² / ((|∇f|² + η²)(|∇w|² + η²)), for images of different contrast.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None. A voxel counts with the smallest weight
            among those that its differences use.
        grid: their grid; spacing 1 when None.
        edge: η in units of the mean of |∇f|; shorter gradients count as noise. From 1 on, steeper is more similar.
        intensity_range: intensities taken for 0 and 1, so that one η suits both images; None: the smallest and the
            largest of each image where the mask is positive.

    Returns:
        ``(B,)`` between 0 and 1. Flat regions give 0.

    Raises:
        InputError: shapes, fewer than 3 nodes on an axis.

    Notes:
        Differentiable, η being a constant. `GradientFields` has the derivative in closed form. Haber & Modersitzki,
        "Intensity gradient based registration and fusion of multi-modal images", 2007.
    """
    fixed, warped = on_unit_scale(fixed, warped, mask, intensity_range)
    if len(fixed) == 0:
        return mean(warped)
    grid = grid or Grid(tuple(fixed.shape[2:]))
    weight = relative_weight(_smallest_in_stencil(mask), warped)
    f, w = _gradient(fixed, grid), _gradient(warped, grid)
    square = _squared_edge(f, grid, edge)
    return mean(_dot(f, w).square() / ((_squares(f) + square) * (_squares(w) + square)), weight)


def _gradient(image: Tensor, grid: Grid) -> list[Tensor]:
    return [derivative(image, grid, axis) for axis in range(grid.dim)]


def _dot(a: list[Tensor], b: list[Tensor]) -> Tensor:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = torch.addcmul(total, x, y)
    return total


def _squares(gradient: list[Tensor]) -> Tensor:
    return _dot(gradient, gradient)


@torch.no_grad()
def _squared_edge(gradient: list[Tensor], grid: Grid, edge: float) -> Tensor:
    """Return η² of each item and channel ``(B, C, 1, ..)``."""
    length = _squares(gradient).sqrt_().mean(dim=grid.axes, keepdim=True)
    return (edge * length).clamp_(min=_SMALLEST_EDGE / min(grid.spacing)).square_()


def _smallest_in_stencil(mask: Tensor | None) -> Tensor | None:
    """Return at each voxel the smallest weight among those that its differences use: 3 along each axis."""
    if mask is None:
        return None
    smallest = mask
    for axis in range(2, mask.dim()):
        count = mask.shape[axis] - 2
        first, middle, last = (mask.narrow(axis, start, count) for start in range(3))
        inner = torch.minimum(torch.minimum(first, middle), last)
        ends = inner.narrow(axis, 0, 1), inner.narrow(axis, count - 1, 1)
        smallest = torch.minimum(smallest, torch.cat([ends[0], inner, ends[1]], dim=axis))
    return smallest
