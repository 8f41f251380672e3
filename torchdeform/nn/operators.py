"""Solves and certificates as operators of torch: one node each for torch.compile and torch.export, with derivatives.

Inside them is what a tracer cannot follow: tables that are made once and kept, loops that look at numbers.
"""

import math
import threading
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from torchdeform.core.derivatives import curl, jacobian_determinant
from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.grid import Grid, per_item
from torchdeform.fem.fast_transform import TransformSolver
from torchdeform.fem.form import Form, div_curl_form
from torchdeform.fem.operator import assemble_load
from torchdeform.fem.weights import Weights

# A map that must be drawn back is drawn back to a multiple of one part in 2 to this power.
_HALVINGS = 7

_local = threading.local()


def _solver(
    grid: Grid, weights: tuple[float, float, float], boundary: str, dtype: torch.dtype, device: torch.device
) -> TransformSolver:
    """Return the solver of this thread, since it has working memory; the last few are kept."""
    if not hasattr(_local, "make"):
        _local.make = lru_cache(maxsize=16)(_make_solver)
    return _local.make(grid, weights, boundary, dtype, device)


def _make_solver(
    grid: Grid, weights: tuple[float, float, float], boundary: str, dtype: torch.dtype, device: torch.device
) -> TransformSolver:
    with torch.inference_mode(False):
        return TransformSolver(grid, Weights(*weights), boundary, dtype=dtype, device=device)


def _grid_of(field: Tensor, spacing: Sequence[float]) -> Grid:
    return Grid(tuple(field.shape[2:]), tuple(spacing))


@torch.library.custom_op("torchdeform::div_curl_velocity", mutates_args=())
def div_curl_velocity(data: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str) -> Tensor:
    """Return v = K⁻¹ A data: the velocity of divergence and curl ``data (B, 1 + C, *S)``, see `DivCurlVelocity`."""
    grid, weights = _grid_of(data, spacing), _triple(weights)
    load = assemble_load(_rows(grid.dim, weights), data, grid)
    return _solver(grid, weights, boundary, data.dtype, data.device).solve(load)


@torch.library.custom_op("torchdeform::div_curl_adjoint", mutates_args=())
def div_curl_adjoint(slope: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str) -> Tensor:
    """Return Aᵀ K⁻¹ slope, ``(B, 1 + C, *S)``: the transpose of `div_curl_velocity`, since K is symmetric."""
    grid, weights = _grid_of(slope, spacing), _triple(weights)
    form = _rows(grid.dim, weights)
    solved = _solver(grid, weights, boundary, slope.dtype, slope.device).solve(slope)
    with torch.enable_grad():
        data = slope.new_zeros(slope.shape[0], len(form), *grid.shape).requires_grad_()
        return torch.autograd.grad(assemble_load(form, data, grid), data, solved)[0]


def _triple(weights: Sequence[float]) -> tuple[float, float, float]:
    div, turn, zero = weights
    return div, turn, zero


def _rows(dim: int, weights: tuple[float, float, float]) -> Form:
    """The rows of the form for the divergence and the curl, without those for the values of v."""
    return div_curl_form(dim, Weights(weights[0], weights[1]))


@div_curl_velocity.register_fake
def _(data: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str) -> Tensor:
    return data.new_empty(data.shape[0], data.dim() - 2, *data.shape[2:])


@div_curl_adjoint.register_fake
def _(slope: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str) -> Tensor:
    dim = slope.dim() - 2
    return slope.new_empty(slope.shape[0], 1 + dim * (dim - 1) // 2, *slope.shape[2:])


def _remember(ctx, inputs, output) -> None:
    ctx.settings = inputs[1:]


# Each is the derivative of the other, so derivatives of every degree are there.
div_curl_velocity.register_autograd(
    lambda ctx, slope: (div_curl_adjoint(slope, *ctx.settings), None, None, None), setup_context=_remember
)
div_curl_adjoint.register_autograd(
    lambda ctx, slope: (div_curl_velocity(slope, *ctx.settings), None, None, None), setup_context=_remember
)


@torch.library.custom_op("torchdeform::open_share", mutates_args=())
def open_share(
    start: Tensor, move: Tensor, least: Tensor, spacing: Sequence[float], most: float, turn: float
) -> Tensor:
    """Return for each item the share t ≤ 1 of a move that leaves φ = id + start + t · move within bounds, ``(B,)``.

    Args:
        start: displacement ``(B, D, *S)`` in units of spacing, within the bounds itself.
        move: what is added, the same shape.
        least: smallest one-sided determinant allowed ``(B,)``.
        spacing: of the grid.
        most: largest determinant of central differences allowed.
        turn: no component of the curl may be beyond ± this.

    Returns:
        1 where all of the move will do, else a multiple of 1/128 found by bisection; 0 where none was found.

    Notes:
        Costs one look at the determinants, and seven more for the items that must be drawn back. Not differentiable:
        layers take t for a constant. NaN is never within bounds.
    """
    grid = _grid_of(start, spacing)
    share = torch.ones_like(start[:, 0].flatten(1)[:, 0])
    index = (~_within(start + move, grid, least, most, turn)).nonzero().flatten()
    start, move, least = start[index], move[index], least[index]
    low = torch.zeros_like(least)
    for k in range(1, _HALVINGS + 1 if len(index) else 0):
        trial = low + 0.5**k
        low = torch.where(_within(start + per_item(trial, move) * move, grid, least, most, turn), trial, low)
    share[index] = low
    return share


def _within(u: Tensor, grid: Grid, least: Tensor, most: float, turn: float) -> Tensor:
    """Return for each item whether the map keeps the bounds, ``(B,)``."""
    good = smallest_determinant(u, grid) >= least
    if most < math.inf:
        good = good & (jacobian_determinant(u, grid).flatten(1).amax(1) <= most)
    if turn < math.inf:
        good = good & (curl(u, grid).abs().flatten(1).amax(1) <= turn)
    return good


@open_share.register_fake
def _(start: Tensor, move: Tensor, least: Tensor, spacing: Sequence[float], most: float, turn: float) -> Tensor:
    return start.new_empty(start.shape[0])
