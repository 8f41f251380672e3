"""Solves and certificates as operators of torch: one node each for torch.compile and torch.export, with derivatives.

Inside them is what a tracer cannot follow: tables that are made once and kept, loops that look at numbers.
"""

import math
import threading
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor
from torch.autograd import Function

from torchdeform.core.derivatives import CURL_PAIRS, curl, jacobian_determinant
from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.fold_free import largest_share
from torchdeform.core.grid import Grid, over_items, per_item
from torchdeform.core.tables import in_transformation
from torchdeform.fem.solver import solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Factor

# A map that must be scaled down is scaled to a multiple of one part in 2 to this power.
_HALVINGS = 7

_local = threading.local()


def _factor(like: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str) -> Factor:
    """Return the solver of this thread, since it has working memory; the last few are kept."""
    if not hasattr(_local, "make"):
        _local.make = lru_cache(maxsize=16)(_make_factor)
    grid = _grid_of(like, spacing)
    make = _make_factor if in_transformation() else _local.make
    return make(grid, tuple(weights), boundary, solver, like.dtype, like.device)


def _make_factor(
    grid: Grid, weights: tuple[float, float, float], boundary: str, solver: str, dtype: torch.dtype, device: str
) -> Factor:
    system = DivCurlSystem(grid, Weights(*weights), boundary)
    with torch.inference_mode(False):
        return solver_of(solver, system).init(system, torch.empty(0, dtype=dtype, device=device))


def _grid_of(field: Tensor, spacing: Sequence[float]) -> Grid:
    return Grid(tuple(field.shape[2:]), tuple(spacing))


def div_curl_velocity(
    data: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str = "auto"
) -> Tensor:
    """Return v = K⁻¹ A data: the velocity of divergence and curl ``data (B, 1 + C, *S)``, see `DivCurlVelocity`."""
    how = data, spacing, weights, boundary, solver
    return _velocity(*how) if in_transformation() else _velocity_operator(*how)


def _velocity(data: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str) -> Tensor:
    """Return the same by what `torch.func` can transform, which operators of torch cannot be."""
    factor = _factor(data, spacing, weights, boundary, solver)
    return factor(factor.system.load(div=data[:, :1], curl=data[:, 1:]))


@torch.library.custom_op("torchdeform::div_curl_velocity", mutates_args=())
def _velocity_operator(
    data: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str = "auto"
) -> Tensor:
    return _velocity(data, spacing, weights, boundary, solver)


@torch.library.custom_op("torchdeform::div_curl_adjoint", mutates_args=())
def div_curl_adjoint(
    slope: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str = "auto"
) -> Tensor:
    """Return Aᵀ K⁻¹ slope, ``(B, 1 + C, *S)``: the transpose of `div_curl_velocity`, since K is symmetric."""
    factor = _factor(slope, spacing, weights, boundary, solver)
    solved, found = factor(slope), []
    for name, channels in (("div", 1), ("curl", len(CURL_PAIRS[slope.dim() - 2]))):
        data = slope.new_zeros(slope.shape[0], channels, *slope.shape[2:]).requires_grad_()
        with torch.enable_grad():
            found += torch.autograd.grad(factor.system.load(**{name: data}), data, solved)
    return torch.cat(found, dim=1)


@_velocity_operator.register_fake
def _(data: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str = "auto") -> Tensor:
    return data.new_empty(data.shape[0], data.dim() - 2, *data.shape[2:])


@div_curl_adjoint.register_fake
def _(slope: Tensor, spacing: Sequence[float], weights: Sequence[float], boundary: str, solver: str = "auto") -> Tensor:
    return slope.new_empty(slope.shape[0], 1 + len(CURL_PAIRS[slope.dim() - 2]), *slope.shape[2:])


def _remember(ctx, inputs, output) -> None:
    ctx.settings = inputs[1:]


# Each is the derivative of the other, so derivatives of every degree are there.
_velocity_operator.register_autograd(
    lambda ctx, slope: (div_curl_adjoint(slope, *ctx.settings), None, None, None, None), setup_context=_remember
)
div_curl_adjoint.register_autograd(
    lambda ctx, slope: (_velocity_operator(slope, *ctx.settings), None, None, None, None), setup_context=_remember
)


def share_within_bounds(u: Tensor, spacing: Sequence[float], min_det: float, max_det: float, max_curl: float) -> Tensor:
    """Return for each item the share t ≤ 1 that leaves φ = id + t u within bounds, ``(B,)``.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        spacing: of the grid.
        min_det: smallest one-sided determinant allowed, below 1.
        max_det: largest determinant of central differences allowed, above 1.
        max_curl: no component of the curl may be beyond ± this.

    Returns:
        1 where all of u will do, else a multiple of 1/128 found by bisection; 0 where none was found.

    Notes:
        Costs one look at the determinants, and eight more for the items that must be scaled down. Not differentiable:
        layers take t for a constant. NaN is never within bounds.
    """
    how = u, spacing, min_det, max_det, max_curl
    return _Share.apply(*how) if in_transformation() else _share_operator(*how)


class _Share(Function):
    """`share_within_bounds` for `torch.func`."""

    @staticmethod
    def forward(u: Tensor, spacing: Sequence[float], min_det: float, max_det: float, max_curl: float) -> Tensor:
        return _share(u, spacing, min_det, max_det, max_curl)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.mark_non_differentiable(output)

    @staticmethod
    def vmap(info, in_dims, u: Tensor, *bounds):
        return over_items(lambda items: _Share.apply(items, *bounds), u, in_dims[0]), 0


@torch.library.custom_op("torchdeform::share_within_bounds", mutates_args=())
def _share_operator(u: Tensor, spacing: Sequence[float], min_det: float, max_det: float, max_curl: float) -> Tensor:
    return _share(u, spacing, min_det, max_det, max_curl)


def _share(u: Tensor, spacing: Sequence[float], min_det: float, max_det: float, max_curl: float) -> Tensor:
    grid = _grid_of(u, spacing)

    def within(w: Tensor) -> Tensor:
        good = smallest_determinant(w, grid) >= min_det
        if max_det < math.inf:
            good = good & (jacobian_determinant(w, grid).flatten(1).amax(1) <= max_det)
        if max_curl < math.inf:
            good = good & (curl(w, grid).abs().flatten(1).amax(1) <= max_curl)
        return good

    share, beyond = u.new_ones(u.shape[0]), ~within(u)
    if bool(beyond.any()):
        part = u[beyond]
        accept = lambda t: within(per_item(t, part) * part)  # noqa: E731
        share[beyond] = largest_share(accept, share[beyond], halvings=_HALVINGS, refine=True)
    return share


@_share_operator.register_fake
def _(u: Tensor, spacing: Sequence[float], min_det: float, max_det: float, max_curl: float) -> Tensor:
    return u.new_empty(u.shape[0])
