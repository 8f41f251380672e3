"""A vector field from its divergence and curl, by least squares on Q1 elements."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid, common_batch, magnitude, per_item
from torchdeform.errors import InputError
from torchdeform.fem.boundary import Boundary, normal_is_given, outward_flux
from torchdeform.fem.fast_transform import solve_poisson
from torchdeform.fem.form import gradient_form
from torchdeform.fem.operator import assemble_load
from torchdeform.fem.solver import SolverSettings, solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Solution, Status, listed
from torchdeform.solvers.cg import DEFAULT_RTOL


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


_UNIT = Weights()


def solve_div_curl(
    div: Tensor | None,
    curl: Tensor | None,
    grid: Grid,
    boundary: Boundary = "slip",
    *,
    boundary_values: Tensor | None = None,
    weights: Weights = _UNIT,
    solver: SolverSettings | str = "auto",
    theta: bool = False,
) -> DivCurlSolution:
    """Return v that minimises ∫ w_div (div v − α)² + w_curl |curl v − β|² + w_zero |v|² over Q1 fields.

    Args:
        div: α ``(B, 1, *S)``, units of v per unit of spacing; None stands for 0.
        curl: β ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, components as in `derivatives.curl`; None stands for 0.
        grid: the grid.
        boundary: ``slip`` (n·v given), ``no_slip_tangential`` (n×v given), ``dirichlet`` (all of v given) or ``free``,
            for all faces or face by face, see `resolve_boundary`.
        boundary_values: ``(B, D, *S)``, what is given where; only its boundary nodes matter; 0 by default.
        weights: w_div, w_curl, w_zero, constant or varying by element; and w_strain, see `Weights`.
        solver: ``auto``, ``transform``, ``stress``, ``cg`` or ``assembled``, or `SolverSettings`.
        theta: in 3D, also return θ of curl v + ∇θ = β, which is 0 where β is a curl.

    Returns:
        `DivCurlSolution`.

    Raises:
        InputError: shapes, types, an unknown boundary, weights out of range, nothing to solve for, θ in 2D,
            ``transform`` asked for where it is not exact, or ``assembled`` with weights that vary over the batch.

    Notes:
        Second order in L2. Where n·v is given on all faces ∫ α = ∮ n·v must hold; what is missing is taken off α and
        reported. Without ``rtol`` an item counts as solved at the residual that rounding v leaves, 8 ε ‖diag(K) v‖
        with the ε of the dtype. Differentiable in div, curl, boundary_values and in weights that are tensors, to every
        degree. Liu, Liao & Xue 2007, eq. (3.1), (3.2) and (3.5).
    """
    if theta and grid.dim != 3:
        raise InputError("solve_div_curl: theta belongs to the curl in 3D; leave theta False in 2D")
    how = solver if isinstance(solver, SolverSettings) else SolverSettings(method=solver)
    given = _given(grid, div, curl, boundary_values, weights)
    like = next(iter(given.values()))
    alpha, beta, values = (given.get(name) for name in ("div", "curl", "boundary_values"))
    alpha = like.new_zeros(len(like), 1, *grid.shape) if alpha is None else alpha
    incompatibility = _incompatibility(alpha, values, grid, boundary)
    alpha = alpha - per_item(incompatibility, alpha)
    system = DivCurlSystem(grid, weights.to(like), boundary)
    load = system.load(div=alpha, curl=beta, values=values)
    found = solver_of(how, system).init(system, like).solution(load)
    if how.rtol is None:
        found = replace(found, status=_allow_rounding(system, load, found))
    v, fixed = found.value, system.fixed(like.device)
    # The given values in place. What a gradient says there goes to the values, not to the solve.
    v = v.masked_fill(fixed, 0) if values is None else torch.where(fixed, values, v)
    potential = None
    if theta:
        potential = curl_potential(v.new_zeros(len(v), 3, *grid.shape) if beta is None else beta, grid)
    return DivCurlSolution(v, found.status, found.steps, found.residual, incompatibility, potential)


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


def _given(
    grid: Grid, div: Tensor | None, curl: Tensor | None, values: Tensor | None, weights: Weights
) -> dict[str, Tensor]:
    """Return the data that are given, checked and with one batch size."""
    weights.check(grid)
    channels = {"div": 1, "curl": len(CURL_PAIRS[grid.dim]), "boundary_values": grid.dim}
    given = {n: t for n, t in zip(channels, (div, curl, values), strict=True) if t is not None}
    for name, tensor in given.items():
        grid.check(tensor, f"solve_div_curl: {name}", components=channels[name])
    _require_one_kind(given)
    batch = common_batch("solve_div_curl", *given.values(), *weights.tensors)
    return {n: t.expand(batch, *t.shape[1:]) for n, t in given.items()}


def _require_one_kind(given: dict[str, Tensor]) -> None:
    """Raise `InputError` unless all share a dtype and device that can be solved in."""
    if not given:
        raise InputError("solve_div_curl: nothing to solve for; give div, curl or boundary_values")
    kinds = {(t.dtype, t.device) for t in given.values()}
    if len(kinds) > 1 or next(iter(kinds))[0] not in DEFAULT_RTOL:
        found = ", ".join(f"{n} is {t.dtype} on {t.device}" for n, t in given.items())
        raise InputError(f"solve_div_curl: all must be float32, or all float64, on one device; {found}")


def _incompatibility(alpha: Tensor, values: Tensor | None, grid: Grid, boundary: Boundary) -> Tensor:
    """Return (∫ α − ∮ n·g)/|Ω| for each item where n·v = n·g on every face, else 0."""
    if not normal_is_given(boundary, grid.dim):
        return alpha.new_zeros(alpha.shape[0])
    weights = grid.quadrature(dtype=alpha.dtype, device=alpha.device)[0]
    total = torch.stack([(item * weights).sum() for item in alpha])
    return (total if values is None else total - outward_flux(values, grid)) / grid.volume


@torch.no_grad()
def _allow_rounding(system: DivCurlSystem, load: Tensor, found: Solution) -> tuple[Status, ...]:
    """Call an item solved whose residual is what rounding v leaves, 8 ε ‖diag(K) v‖ (up to 5 ε is seen)."""
    if Status.ROUNDING not in found.status:
        return found.status
    free = system.free(load)
    scale = magnitude(free)
    floor = 8 * torch.finfo(load.dtype).eps * (system.diagonal(load) * (found.value / scale)).flatten(1).norm(dim=1)
    left = listed((found.residual * (free / scale).flatten(1).norm(dim=1) > floor).long())
    return tuple(
        Status.CONVERGED if s is Status.ROUNDING and not f else s for s, f in zip(found.status, left, strict=True)
    )
