"""Flows of velocity fields by ODE solvers. The only file that imports torchdiffeq."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import keep_inside, warp
from torchdeform.errors import ComputationError, InputError, require_choice

# What moves the state: (time, state) -> its rate of change; time is a scalar tensor.
Rate = Callable[[Tensor, Tensor], Tensor]

FIXED_STEP = ("euler", "midpoint", "rk4")
ADAPTIVE = ("dopri5",)


@dataclass(frozen=True, kw_only=True)
class OdeSolver:
    """How an ODE is integrated, and how the result is differentiated.

    Args:
        method: ``euler``, ``midpoint`` or ``rk4`` (the 3/8 rule) with steps of equal length, orders 1, 2 and 4; or
            ``dopri5``, which chooses its steps.
        steps: steps between two times that are asked for; for ``dopri5`` the first step that it tries is that long.
        atol: error allowed in one step of ``dopri5``, in voxels, at the worst node of the batch.
        adjoint: take gradients from the adjoint equation, solved backwards in time with as many steps (by ``rk4`` if
            the method is ``dopri5``): memory does not grow with the steps, the gradient has the error of the method.
            Otherwise all steps are kept and differentiated.

    Raises:
        InputError: a value out of range.
    """

    method: str = "rk4"
    steps: int = 8
    atol: float = 1e-4
    adjoint: bool = False

    def __post_init__(self) -> None:
        require_choice(self.method, (*FIXED_STEP, *ADAPTIVE), "integrate: method")
        if not isinstance(self.steps, int) or self.steps < 1:
            raise InputError(f"integrate: steps must be a whole number, at least 1, got {self.steps!r}")
        if not (math.isfinite(self.atol) and self.atol > 0):
            raise InputError(f"integrate: atol must be a positive number of voxels, got {self.atol!r}")


def integrate(
    v: Tensor,
    grid: Grid,
    steps: int = 8,
    method: str = "rk4",
    *,
    time: float = 1.0,
    atol: float = 1e-4,
    adjoint: bool = False,
) -> Tensor:
    """Return the displacement u = φ − id of the flow of a stationary velocity: dφ/dt = v(φ), φ = id at t = 0.

    Args:
        v: velocity ``(B, D, *S)`` in units of spacing per unit of time.
        grid: its grid.
        steps: as `OdeSolver`, likewise ``method``, ``atol`` and ``adjoint``.
        method: ``euler``, ``midpoint``, ``rk4`` or ``dopri5``.
        time: how long v is followed; a negative time goes backwards, which gives the inverse map.
        atol: error allowed in one step of ``dopri5``, in voxels.
        adjoint: take gradients from the adjoint equation, so that memory does not grow with the steps.

    Returns:
        u ``(B, D, *S)`` in units of spacing at t = ``time``.

    Raises:
        InputError: shape, method, steps, time, atol.
        ComputationError: ``dopri5`` found no step that meets atol.

    Notes:
        The order is that of the method until the linear interpolation of v, of second order in the spacing, dominates.
        Costs one sampling of v per stage except the first, where the points are the nodes. A point that leaves Ω moves
        with the velocity of the nearest boundary point and is put back on the boundary at the end, so φ maps Ω into Ω.
        Differentiable in v.
    """
    grid.check_vector(v, "integrate: v")
    if not math.isfinite(time):
        raise InputError(f"integrate: time must be finite, got {time!r}")
    solver = OdeSolver(method=method, steps=steps, atol=atol, adjoint=adjoint)
    velocity, nodes = (v if time > 0 else -v), torch.zeros_like(v)
    if time == 0:
        return nodes

    def rate(_: Tensor, u: Tensor) -> Tensor:
        return velocity if u is nodes else warp(velocity, u, grid)

    u = _solve(rate, nodes, (0.0, abs(time)), grid, solver, (velocity,))[-1]
    return keep_inside(u, grid)


def integrate_points(
    rate: Rate,
    points: Tensor,
    times: Sequence[float],
    grid: Grid,
    solver: OdeSolver | None = None,
    parameters: Sequence[Tensor] = (),
) -> Tensor:
    """Return the points p(t) at the times asked for, where dp/dt = rate(t, p).

    Args:
        rate: gives the velocity ``(B, D, *T)`` at time t and points p; `sample` clamps points to Ω.
        points: where they are at the first time, ``(B, D, *T)`` in units of spacing, array-axis order.
        times: increasing or decreasing, the first one included.
        grid: the box Ω the points live in.
        solver: how to integrate; `OdeSolver` with its defaults when None.
        parameters: the tensors in ``rate`` that want a gradient; needed for ``adjoint`` only.

    Returns:
        ``(len(times), B, D, *T)``, clamped to Ω.

    Raises:
        InputError: times, shape of the points.
        ComputationError: ``dopri5`` found no step that meets atol.

    Notes:
        Order and cost are those of the method. Differentiable in the points and in whatever ``rate`` uses.
    """
    if points.dim() < 3 or points.shape[1] != grid.dim:
        raise InputError(f"integrate_points: points must have shape (B, {grid.dim}, *T), got {tuple(points.shape)}")
    steps = [b - a for a, b in pairwise(times)]
    if not steps or not (all(step > 0 for step in steps) or all(step < 0 for step in steps)):
        raise InputError(f"integrate_points: times must be two or more, increasing or decreasing, got {list(times)}")
    trajectory = _solve(rate, points, times, grid, solver or OdeSolver(), parameters)
    farthest = grid.along(grid.extent, points).view(-1, *([1] * (points.dim() - 2)))
    return trajectory.clamp(min=0.0).clamp(max=farthest)


def _solve(
    rate: Rate, start: Tensor, times: Sequence[float], grid: Grid, solver: OdeSolver, parameters: Sequence[Tensor]
) -> Tensor:
    """Return the states at the times, ``(len(times), *start.shape)``."""
    from torchdiffeq import odeint, odeint_adjoint

    t = torch.tensor(times, dtype=start.dtype, device=start.device)
    fixed = {"method": solver.method, "options": {"grid_constructor": _equal_steps(solver.steps)}}
    settings = fixed if solver.method in FIXED_STEP else _adaptive(start, times, grid, solver)
    backward = {} if settings is fixed else {"adjoint_method": "rk4", "adjoint_options": fixed["options"]}
    try:
        if solver.adjoint:
            states: Any = odeint_adjoint(rate, start, t, **settings, **backward, adjoint_params=tuple(parameters))
        else:
            states = odeint(rate, start, t, **settings)
    except AssertionError as error:  # how torchdiffeq says that a step became too small or a state infinite
        raise ComputationError(
            f"integrate: {solver.method} found no step with an error below atol = {solver.atol} voxels ({error}); "
            "check the velocity for NaN and infinity, or raise atol"
        ) from error
    return states


def _equal_steps(steps: int) -> Callable[[Rate, Tensor, Tensor], Tensor]:
    """Return torchdiffeq's way to ask for ``steps`` equal steps between any two times."""

    def grid_constructor(_: Rate, __: Tensor, t: Tensor) -> Tensor:
        parts = [torch.linspace(a, b, steps + 1, dtype=t.dtype, device=t.device)[1:] for a, b in pairwise(t.tolist())]
        return torch.cat([t[:1], *parts])

    return grid_constructor


def _adaptive(start: Tensor, times: Sequence[float], grid: Grid, solver: OdeSolver) -> dict[str, Any]:
    """Return the settings of an adaptive method: the error of a step is its largest component, in voxels."""
    spacing = grid.along(grid.spacing, start).view(-1, *([1] * (start.dim() - 2)))

    def norm(x: Tensor) -> Tensor:
        return (x / spacing).abs().amax()

    first_step = abs(times[1] - times[0]) / solver.steps
    options = {"norm": norm, "first_step": first_step}
    return {"method": solver.method, "rtol": 0.0, "atol": solver.atol, "options": options}
