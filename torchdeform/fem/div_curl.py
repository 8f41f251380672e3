"""A vector field from its divergence and curl, by least squares on Q1 elements."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError, require_choice
from torchdeform.fem.boundary import Boundary, constrain, fixed_unknowns, lift, normal_is_given, outward_flux
from torchdeform.fem.fast_transform import TransformSolver, solve_poisson, transform_is_exact
from torchdeform.fem.form import div_curl_form, gradient_form
from torchdeform.fem.operator import apply_form, assemble_load, form_diagonal
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Solution, Status
from torchdeform.solvers.cg import DEFAULT_RTOL, Operator, conjugate_gradient

SolverName = Literal["auto", "transform", "cg"]
PreconditionerName = Literal["transform", "jacobi", "none"]


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """How `solve_div_curl` solves, and what it returns beside v.

    Args:
        solver: ``transform`` (direct, where it is exact), ``cg`` (always), or ``auto``: the first where it may.
        preconditioner: of CG: ``transform`` (the direct solver with mean weights), ``jacobi`` (the diagonal), ``none``.
        rtol: solved when ‖load − K v‖ ≤ max(rtol ‖load‖, atol). None asks for 1e-5 in float32 and 1e-10 in float64, or
            for what rounding allows, 8 ε ‖diag(K) v‖ with the ε of the dtype, where that is more.
        atol: absolute tolerance on the residual.
        max_steps: steps of CG at most.
        theta: in 3D, also return θ of curl v + ∇θ = β, which is 0 where β is a curl.

    Raises:
        InputError: an unknown name, or a number out of range.
    """

    solver: SolverName = "auto"
    preconditioner: PreconditionerName = "transform"
    rtol: float | None = None
    atol: float = 0.0
    max_steps: int = 1000
    theta: bool = False

    def __post_init__(self) -> None:
        require_choice(self.solver, get_args(SolverName), "SolverSettings: solver")
        require_choice(self.preconditioner, get_args(PreconditionerName), "SolverSettings: preconditioner")
        if (self.rtol or 0) < 0 or self.atol < 0 or self.max_steps < 0:
            raise InputError("SolverSettings: rtol, atol and max_steps must not be negative")


@dataclass(frozen=True)
class DivCurlSolution(Solution):
    """A field from its divergence and curl.

    Attributes:
        value: v ``(B, D, *S)``.
        incompatibility: (∫ α − ∮ n·v)/|Ω| per item ``(B,)``, taken off α before solving; 0 where n·v is not given on
            all faces.
        theta: θ ``(B, 1, *S)`` with curl v + ∇θ = β and θ = 0 on the boundary, in units of v; None unless asked for.
    """

    incompatibility: Tensor
    theta: Tensor | None


_UNIT, _DEFAULT = Weights(), SolverSettings()


def solve_div_curl(
    div: Tensor | None,
    curl: Tensor | None,
    grid: Grid,
    boundary: Boundary = "slip",
    *,
    boundary_values: Tensor | None = None,
    weights: Weights = _UNIT,
    settings: SolverSettings = _DEFAULT,
) -> DivCurlSolution:
    """Return v that minimises ∫ w_div (div v − α)² + w_curl |curl v − β|² + w_zero |v|² over Q1 fields.

    Args:
        div: α ``(B, 1, *S)``, units of v per unit of spacing; None stands for 0.
        curl: β ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, components as in `stencil.curl`; None stands for 0.
        grid: the grid.
        boundary: ``slip`` (n·v given), ``no_slip_tangential`` (n×v given), ``dirichlet`` (all of v given) or ``free``,
            for all faces or face by face, see `resolve_boundary`.
        boundary_values: ``(B, D, *S)``, what is given where; only its boundary nodes matter; 0 by default.
        weights: w_div, w_curl, w_zero, constant or varying by element.
        settings: solver, preconditioner, tolerances.

    Returns:
        `DivCurlSolution`.

    Raises:
        InputError: shapes, types, an unknown boundary, weights out of range, nothing to solve for, θ in 2D, or
            ``transform`` asked for where it is not exact.

    Notes:
        Second order in L2. Where n·v is given on all faces ∫ α = ∮ n·v must hold; what is missing is taken off α and
        reported. Differentiable in div, curl, boundary_values and in weights that are tensors, to every degree.
        Liu, Liao & Xue 2007, eq. (3.1), (3.2) and (3.5).
    """
    problem, incompatibility = _problem(div, curl, grid, boundary, boundary_values, weights)
    if settings.theta and grid.dim != 3:
        raise InputError("solve_div_curl: theta belongs to the curl in 3D; leave settings.theta False in 2D")
    exact = transform_is_exact(grid, problem.weights, boundary)
    if settings.solver == "transform" and not exact:
        raise InputError("solve_div_curl: transform is not exact for these weights and faces; take auto or cg")
    load = problem.load()
    outcome = (_direct if exact and settings.solver != "cg" else _iterative)(problem, load, settings)
    status = _allow_rounding(problem, load, outcome) if settings.rtol is None else outcome.status
    theta = curl_potential(problem.curl, grid) if settings.theta else None
    return DivCurlSolution(
        problem.complete(outcome.value), status, outcome.steps, outcome.residual, incompatibility, theta
    )


def curl_potential(curl: Tensor, grid: Grid) -> Tensor:
    """Return θ with Δθ = div β in Ω and θ = 0 on its boundary: the part ∇θ of β that is no curl.

    Args:
        curl: β ``(B, D, *S)``.
        grid: the grid.

    Returns:
        ``(B, 1, *S)``, units of β times spacing.

    Raises:
        InputError: shape.

    Notes:
        The dummy variable of Liu, Liao & Xue 2007, eq. (3.2). As θ = 0 on the boundary, ∫ ∇θ·curl w = 0 for every Q1
        field w, so β and β − ∇θ have the same solution v.
    """
    grid.check_vector(curl, "curl_potential: curl")
    return solve_poisson(assemble_load(gradient_form(grid.dim), curl, grid), grid)


@dataclass(frozen=True)
class _Problem:
    """Checked input with one batch size and dtype: ``data`` holds α and, if given, β."""

    grid: Grid
    boundary: Boundary
    weights: Weights
    fixed: Tensor
    data: Tensor
    values: Tensor | None

    @property
    def curl(self) -> Tensor:
        """β, 0 where it was not given."""
        missing = len(CURL_PAIRS[self.grid.dim]) + 1 - self.data.shape[1]
        return F.pad(self.data[:, 1:], [0, 0] * self.grid.dim + [0, missing])

    def apply(self, v: Tensor, *tensors: Tensor) -> Tensor:
        """K v with nothing fixed, for the weights with ``tensors`` in their place."""
        return apply_form(div_curl_form(self.grid.dim, self.weights.with_tensors(tensors)), v, self.grid)

    def apply_free(self, v: Tensor, *tensors: Tensor) -> Tensor:
        """P K P v on the free unknowns."""
        return constrain(lambda w: self.apply(w, *tensors), self.fixed)(v)

    def load(self) -> Tensor:
        """The right-hand side on the free unknowns, the given values lifted into it."""
        rows = div_curl_form(self.grid.dim, self.weights)[: self.data.shape[1]]
        load = assemble_load(rows, self.data, self.grid)
        if self.values is None:
            return load.masked_fill(self.fixed, 0)
        return lift(lambda w: self.apply(w, *self.weights.tensors), load, self.values, self.fixed)

    def complete(self, v: Tensor) -> Tensor:
        """v with the given values in place. What a gradient says there goes to the values, not to the solve."""
        return v.masked_fill(self.fixed, 0) if self.values is None else torch.where(self.fixed, self.values, v)

    def transform(self) -> TransformSolver:
        """The direct solver, or the preconditioner nearest to it."""
        weights = self.weights if self.weights.constant else self.weights.mean()
        return TransformSolver(self.grid, weights, self.boundary, dtype=self.data.dtype, device=self.data.device)


def _problem(
    div: Tensor | None, curl: Tensor | None, grid: Grid, boundary: Boundary, values: Tensor | None, weights: Weights
) -> tuple[_Problem, Tensor]:
    """Check the input, give it one batch size, make it compatible; return by how much it was not."""
    weights.check(grid)
    channels = {"div": 1, "curl": len(CURL_PAIRS[grid.dim]), "boundary_values": grid.dim}
    given = {n: t for n, t in zip(channels, (div, curl, values), strict=True) if t is not None}
    for name, tensor in given.items():
        grid.check(tensor, f"solve_div_curl: {name}", components=channels[name])
    like = _common(given)
    weights = weights.to(like)
    batch = {t.shape[0] for t in (*given.values(), *weights.tensors) if t.dim() > 0} - {1} or {1}
    if len(batch) > 1:
        raise InputError(f"solve_div_curl: batch sizes must agree or be 1, got {sorted(batch)}")
    given = {n: t.expand(*batch, *t.shape[1:]) for n, t in given.items()}
    alpha, g = given.get("div", like.new_zeros(*batch, 1, *grid.shape)), given.get("boundary_values")
    incompatibility = _incompatibility(alpha, g, grid, boundary)
    alpha = alpha - incompatibility.view(-1, *[1] * (grid.dim + 1))
    data = torch.cat([alpha, given["curl"]], dim=1) if "curl" in given else alpha
    fixed = fixed_unknowns(boundary, grid, like.device)
    return _Problem(grid, boundary, weights, fixed, data, g), incompatibility


def _incompatibility(alpha: Tensor, values: Tensor | None, grid: Grid, boundary: Boundary) -> Tensor:
    """Return (∫ α − ∮ n·g)/|Ω| for each item where n·v = n·g on every face, else 0."""
    if not normal_is_given(boundary, grid.dim):
        return alpha.new_zeros(alpha.shape[0])
    weights = grid.quadrature(dtype=alpha.dtype, device=alpha.device)[0]
    total = torch.stack([(item * weights).sum() for item in alpha])
    return (total if values is None else total - outward_flux(values, grid)) / grid.volume


def _common(given: dict[str, Tensor]) -> Tensor:
    """Return a tensor of the dtype and device that all share."""
    if not given:
        raise InputError("solve_div_curl: nothing to solve for; give div, curl or boundary_values")
    kinds = {(t.dtype, t.device) for t in given.values()}
    if len(kinds) > 1 or next(iter(kinds))[0] not in DEFAULT_RTOL:
        found = ", ".join(f"{n} is {t.dtype} on {t.device}" for n, t in given.items())
        raise InputError(f"solve_div_curl: all must be float32, or all float64, on one device; {found}")
    return next(iter(given.values()))


def _direct(problem: _Problem, load: Tensor, settings: SolverSettings) -> Solution:
    """Solve by transforms, and measure the residual that is left."""
    value = problem.transform().solve(load)
    with torch.no_grad():
        norm, left = (
            t.flatten(1).norm(dim=1) for t in (load, load - problem.apply_free(value, *problem.weights.tensors))
        )
    rtol = DEFAULT_RTOL[load.dtype] if settings.rtol is None else settings.rtol
    met = left <= torch.clamp(rtol * norm, min=settings.atol)
    status = tuple(_judge(*flags) for flags in zip(met.tolist(), torch.isfinite(left).tolist(), strict=True))
    steps = torch.zeros(load.shape[0], dtype=torch.int64, device=load.device)
    return Solution(value, status, steps, torch.where(norm > 0, left / norm, 0))


def _judge(met: bool, finite: bool) -> Status:
    if not finite:
        return Status.NON_FINITE
    return Status.CONVERGED if met else Status.ROUNDING


def _iterative(problem: _Problem, load: Tensor, settings: SolverSettings) -> Solution:
    return conjugate_gradient(
        Operator(problem.apply_free, problem.weights.tensors),
        load,
        preconditioner=_preconditioner(problem, settings.preconditioner),
        rtol=settings.rtol,
        atol=settings.atol,
        max_steps=settings.max_steps,
    )


@torch.no_grad()
def _preconditioner(problem: _Problem, name: PreconditionerName) -> Callable[[Tensor], Tensor] | None:
    if name == "none":
        return None
    if name == "transform":
        return constrain(problem.transform().solve, problem.fixed)
    inverse = 1 / form_diagonal(div_curl_form(problem.grid.dim, problem.weights), problem.grid, problem.data)
    return lambda r: r * inverse


@torch.no_grad()
def _allow_rounding(problem: _Problem, load: Tensor, outcome: Solution) -> tuple[Status, ...]:
    """Call an item solved whose residual is what rounding v leaves, 8 ε ‖diag(K) v‖ (up to 5 ε is seen)."""
    if Status.ROUNDING not in outcome.status:
        return outcome.status
    diagonal = form_diagonal(div_curl_form(problem.grid.dim, problem.weights), problem.grid, load)
    floor = 8 * torch.finfo(load.dtype).eps * (diagonal * outcome.value).flatten(1).norm(dim=1)
    fine = (outcome.residual * load.flatten(1).norm(dim=1) <= floor).tolist()
    return tuple(
        Status.CONVERGED if s is Status.ROUNDING and f else s for s, f in zip(outcome.status, fine, strict=True)
    )
