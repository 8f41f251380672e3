"""The solve with weights that are tensors, as one operator with derivatives in them: a network may predict them."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function

from torchdeform.core.grid import Grid, common_batch
from torchdeform.core.tables import in_transformation
from torchdeform.errors import ComputationError
from torchdeform.fem.solver import solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weight, Weights
from torchdeform.solvers.base import Status


class _How(NamedTuple):
    """What is not a tensor, as an operator of torch takes it.

    Attributes:
        numbers: the weights, 0 for those that are tensors.
        places: which are.
        spacing: of the grid.
        boundary: the kind of all faces.
        solver: the name of a method.
        loaded: the data are a load already.
    """

    numbers: Sequence[float]
    places: Sequence[int]
    spacing: Sequence[float]
    boundary: str
    solver: str
    loaded: bool = False

    def system(self, like: Tensor, tensors: Sequence[Tensor]) -> DivCurlSystem:
        """Return the system with these weights on the grid of ``like``."""
        weights: list[Weight] = list(self.numbers)
        for place, tensor in zip(self.places, tensors, strict=True):
            weights[place] = tensor
        return DivCurlSystem(Grid(tuple(like.shape[2:]), tuple(self.spacing)), Weights(*weights), self.boundary)

    def load(self, data: Tensor, system: DivCurlSystem) -> Tensor:
        """Return A(θ) data."""
        return data if self.loaded else system.load(div=data[:, :1], curl=data[:, 1:])


def weighted_velocity(data: Tensor, system: DivCurlSystem, solver: str) -> Tensor:
    """Return v = K(θ)⁻¹ A(θ) data, θ being the weights that are tensors: see `DivCurlVelocity`.

    Args:
        data: divergence and curl ``(B, 1 + C, *S)``; B is 1 or that of the weights, or theirs is 1.
        system: K, with faces that are all of one kind.
        solver: the name of a method, see `SolverSettings`.

    Returns:
        ``(B, D, *S)``; what is not finite in an item of the data makes it NaN.

    Raises:
        InputError: weights out of range, batch sizes that differ, ``transform`` where it is not exact.
        ComputationError: the tolerance was not met.

    Notes:
        Differentiable in the data and in θ to every degree. A cotangent g of v is λ = K⁻¹ g for the load; that of data
        and θ is the derivative of λᵀ (A(θ) data − K(θ) v) at constant v.
    """
    weights = system.weights
    numbers = [0.0 if isinstance(w, Tensor) else float(w) for w in weights.values]
    places = [k for k, w in enumerate(weights.values) if isinstance(w, Tensor)]
    how = _How(numbers, places, list(system.grid.spacing), str(system.boundary), solver)
    return _velocity(data, list(weights.tensors), how)


def _velocity(data: Tensor, tensors: Sequence[Tensor], how: _How) -> Tensor:
    return _Solve.apply(data, how, *tensors) if in_transformation() else _operator(data, tensors, *how)


def _solve(data: Tensor, tensors: Sequence[Tensor], how: _How) -> Tensor:
    system = how.system(data, tensors)
    system.weights.check(system.grid)
    batch = common_batch("DivCurlVelocity", data, *tensors)
    load = how.load(data.expand(batch, *data.shape[1:]), system)
    found = solver_of(how.solver, system).init(system, load).solution(load)
    if failed := [s for s in found.status if s in (Status.MAX_STEPS, Status.BREAKDOWN)]:
        raise ComputationError(f"DivCurlVelocity: {failed[0].value}")
    return found.value


def _cotangents(ctx, slope: Tensor, wanted: Sequence[bool]) -> tuple[Tensor, list[Tensor | None]]:
    """Return what a cotangent of v is for the data, and for the ``wanted`` of the tensors."""
    data, v, *tensors = ctx.saved_tensors
    adjoint = _velocity(slope, tensors, ctx.how._replace(loaded=True))

    def residual(data: Tensor, *chosen: Tensor) -> Tensor:
        rest = iter(chosen)
        system = ctx.how.system(v, [next(rest) if w else t for w, t in zip(wanted, tensors, strict=True)])
        load = ctx.how.load(data, system)
        return load - system.apply(v) if chosen else load.expand_as(v)

    _, pull, *_ = torch.func.vjp(residual, data, *(t for w, t in zip(wanted, tensors, strict=True) if w))
    first, *others = pull(adjoint)
    found = iter(others)
    return first, [next(found) if w else None for w in wanted]


class _Solve(Function):
    """`weighted_velocity` for `torch.func`, which transforms no operators of torch."""

    @staticmethod
    def forward(data: Tensor, how: _How, *tensors: Tensor) -> Tensor:
        return _solve(data, tensors, how)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        data, ctx.how, *tensors = inputs
        ctx.save_for_backward(data, output, *tensors)

    @staticmethod
    def backward(ctx, *grads: Tensor):
        first, others = _cotangents(ctx, grads[0], ctx.needs_input_grad[2:])
        return first, None, *others

    @staticmethod
    def vmap(info, in_dims, data: Tensor, how: _How, *tensors: Tensor):
        """Solve for one after the other: a batch of conjugate gradients is no faster on small systems."""
        dims = [in_dims[0], *in_dims[2:]]
        several = [
            [t if dim is None else t.select(dim, k) for t, dim in zip((data, *tensors), dims, strict=True)]
            for k in range(info.batch_size)
        ]
        return torch.stack([_Solve.apply(first, how, *others) for first, *others in several]), 0


@torch.library.custom_op("torchdeform::weighted_velocity", mutates_args=())
def _operator(
    data: Tensor,
    tensors: Sequence[Tensor],
    numbers: Sequence[float],
    places: Sequence[int],
    spacing: Sequence[float],
    boundary: str,
    solver: str,
    loaded: bool,
) -> Tensor:
    return _solve(data, tensors, _How(numbers, places, spacing, boundary, solver, loaded))


@_operator.register_fake
def _(data: Tensor, tensors: Sequence[Tensor], *how) -> Tensor:
    batch = torch.broadcast_shapes(data.shape[:1], *(t.shape[:1] for t in tensors))
    return data.new_empty(*batch, data.dim() - 2, *data.shape[2:])


def _remember(ctx, inputs, output) -> None:
    data, tensors, *how = inputs
    ctx.how = _How(*how)
    ctx.save_for_backward(data, output, *tensors)


def _backward(ctx, slope: Tensor):
    first, others = _cotangents(ctx, slope, ctx.needs_input_grad[1])
    return first, others, *[None] * len(ctx.how)


_operator.register_autograd(_backward, setup_context=_remember)
