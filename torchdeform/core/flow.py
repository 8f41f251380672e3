"""Flows of velocity fields by ODE solvers. The only file that imports torchdiffeq.

torchdiffeq integrates every flow of the package. Its solvers cannot be traced, so while torch.compile, torch.export or
torch.func looks on, the methods of fixed steps are run from their tableaux here; a test says that both give the same
numbers.
"""

import math
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdeform.core.grid import Grid, require_float
from torchdeform.core.tables import in_transformation
from torchdeform.core.warp import compose, keep_inside, warp
from torchdeform.errors import ComputationError, InputError, require_choice, require_ranges

# What moves the state: (time, state) -> its rate of change; time is a scalar tensor, or a number while tracing.
Rate = Callable[[Any, Tensor], Tensor]


class Tableau(NamedTuple):
    """An explicit Runge-Kutta method: k_i = rate(t + c_i h, y + h Σ_j a_ij k_j), y ← y + h Σ_i b_i k_i.

    Attributes:
        stages: the rows a_i, whose sums are c_i, each as long as there are stages before it.
        weights: b.
    """

    stages: tuple[tuple[float, ...], ...]
    weights: tuple[float, ...]


# The methods of fixed steps, as torchdiffeq has them; its rk4 is Kutta's 3/8 rule.
TABLEAUX = {
    "euler": Tableau(((),), (1.0,)),
    "midpoint": Tableau(((), (1 / 2,)), (0.0, 1.0)),
    "rk4": Tableau(((), (1 / 3,), (-1 / 3, 1.0), (1.0, -1.0, 1.0)), (1 / 8, 3 / 8, 3 / 8, 1 / 8)),
}
FIXED_STEP = tuple(TABLEAUX)
ADAPTIVE = ("dopri5",)
METHODS = (*FIXED_STEP, *ADAPTIVE, "squaring")

# Steps of an adaptive method between two times. A flow over 100 voxels takes 120 where it is smooth, 1000 where the
# velocity is noise.
MOST_STEPS = 2000


@dataclass(frozen=True, kw_only=True)
class OdeSolver:
    """How an ODE is integrated, and how the result is differentiated.

    Args:
        method: ``euler``, ``midpoint`` or ``rk4`` (the 3/8 rule) with steps of equal length, orders 1, 2 and 4;
            ``dopri5``, which chooses its steps; or, for a stationary velocity, ``squaring`` (v/2ⁿ composed with itself
            n times).
        steps: steps between two times that are asked for; for ``dopri5`` the first step that it tries is that long;
            n for ``squaring``.
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
        require_choice(self.method, METHODS, "integrate: method")
        voxels = (lambda x: 0 < x < math.inf, "be a positive number of voxels")
        require_ranges(self, "integrate: ", steps="whole", atol=voxels)
        if self.adjoint and self.method == "squaring":
            raise InputError("integrate: squaring has no adjoint equation; take method='rk4'")


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
        method: ``euler``, ``midpoint``, ``rk4``, ``dopri5`` or ``squaring``.
        time: how long v is followed; a negative time goes backwards, which gives the inverse map.
        atol: error allowed in one step of ``dopri5``, in voxels.
        adjoint: take gradients from the adjoint equation, so that memory does not grow with the steps.

    Returns:
        u ``(B, D, *S)`` in units of spacing at t = ``time``.

    Raises:
        InputError: shape, method, steps, time, atol.
        ComputationError: ``dopri5`` found no step that meets atol, or is not there after 2000 steps.

    Notes:
        The order is that of the method until the linear interpolation of v, of second order in the spacing, dominates.
        Costs one sampling of v per stage except the first, where the points are the nodes; ``squaring`` one per
        squaring, with error O(2⁻ⁿ) and that of n interpolations. A point that leaves Ω moves with the velocity of the
        nearest boundary point and is put back on the boundary at the end, so φ maps Ω into Ω. Differentiable in v.
    """
    grid.check_vector(v, "integrate: v")
    if not math.isfinite(time):
        raise InputError(f"integrate: time must be finite, got {time!r}")
    return flow(v, grid, OdeSolver(method=method, steps=steps, atol=atol, adjoint=adjoint), time=time)


def flow(v: Tensor, grid: Grid, solver: OdeSolver, *, time: float = 1.0) -> Tensor:
    """Return what `integrate` does with the options of ``solver``; arguments as there."""
    if time == 0:
        return torch.zeros_like(v)
    if solver.method == "squaring":
        return _square(v * (time / 2**solver.steps), grid, solver.steps)
    velocity, nodes = (v if time > 0 else -v), v.new_zeros(()).expand_as(v)  # zeros that take no memory

    def rate(_: Any, u: Tensor) -> Tensor:
        return velocity if u is nodes else warp(velocity, u, grid)

    return keep_inside(integrate_rate(rate, nodes, (0.0, abs(time)), grid, solver, (velocity,))[-1], grid)


def _square(u: Tensor, grid: Grid, times: int) -> Tensor:
    """Compose id + u with itself, ``times`` times over."""
    for _ in range(times):
        u = compose(u, u, grid)
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
        ComputationError: as `integrate`.

    Notes:
        Order and cost are those of the method. Differentiable in the points and in whatever ``rate`` uses.
    """
    require_float(points, "integrate_points: points")
    if points.dim() < 3 or points.shape[1] != grid.dim:
        raise InputError(f"integrate_points: points must have shape (B, {grid.dim}, *T), got {tuple(points.shape)}")
    require_times(times, "integrate_points")
    trajectory = integrate_rate(rate, points, times, grid, solver or OdeSolver(), parameters)
    return trajectory.clamp(min=0.0).clamp(max=grid.along(grid.extent, points))


def require_times(times: Sequence[float], where: str) -> None:
    """Raise `InputError`, which names ``where``, unless the times are two or more, increasing or decreasing."""
    steps = [b - a for a, b in pairwise(times)]
    if not steps or not (all(step > 0 for step in steps) or all(step < 0 for step in steps)):
        raise InputError(f"{where}: times must be two or more, increasing or decreasing, got {list(times)}")


def integrate_rate(
    rate: Rate,
    start: Tensor,
    times: Sequence[float],
    grid: Grid,
    solver: OdeSolver,
    parameters: Sequence[Tensor] = (),
) -> Tensor:
    """Return the states y(t) at the times, ``(len(times), *start.shape)``, where dy/dt = rate(t, y), unclamped.

    Arguments and errors are those of `integrate_points`, but the state may be anything ``(B, D, *T)``.
    """
    if solver.method == "squaring":
        raise InputError("integrate: squaring follows a stationary velocity only; take method='rk4'")
    untraceable = torch.compiler.is_compiling() or in_transformation()
    if untraceable and solver.method in TABLEAUX and not solver.adjoint:
        return runge_kutta(rate, start, times, TABLEAUX[solver.method], solver.steps)
    torchdiffeq = _torchdiffeq()
    t = torch.tensor(times, dtype=start.dtype, device=start.device)
    options = {"grid_constructor": _equal_steps(solver.steps)} if solver.steps > 1 else {}
    fixed = {"method": solver.method, "options": options}
    settings = fixed if solver.method in FIXED_STEP else _adaptive(start, times, grid, solver)
    backward = {} if settings is fixed else {"adjoint_method": "rk4", "adjoint_options": options}
    try:
        if solver.adjoint:
            states: Any = torchdiffeq.odeint_adjoint(
                rate, start, t, **settings, **backward, adjoint_params=tuple(parameters)
            )
        else:
            states = torchdiffeq.odeint(rate, start, t, **settings)
    except AssertionError as error:  # how torchdiffeq says that it gives up
        raise ComputationError(_why(str(error), solver)) from error
    return states


def _why(reason: str, solver: OdeSolver) -> str:
    """Return what to tell the caller when an adaptive method gives up."""
    if "max_num_steps" in reason:
        return (
            f"integrate: {solver.method} is not there after {MOST_STEPS} steps: the velocity is too large or too rough "
            f"for an error of {solver.atol} voxels a step; check its unit, raise atol, or take method='rk4'"
        )
    return (
        f"integrate: {solver.method} found no step with an error below atol = {solver.atol} voxels "
        f"({reason.partition(':')[0]}); check the velocity for NaN and infinity, or raise atol"
    )


def runge_kutta(rate: Rate, start: Tensor, times: Sequence[float], tableau: Tableau, steps: int) -> Tensor:
    """Return the states at the times, ``(len(times), *start.shape)``, with ``steps`` equal steps between any two."""
    states = [start]
    for begin, end in pairwise(times):
        state, h = states[-1], (end - begin) / steps
        for step in range(steps):
            slopes: list[Tensor] = []
            for row in tableau.stages:
                time = begin + (step + sum(row)) * h
                slopes.append(rate(time, _moved(state, slopes, row, h)))
            state = _moved(state, slopes, tableau.weights, h)
        states.append(state)
    return torch.stack(states)


def _moved(state: Tensor, slopes: Sequence[Tensor], weights: Sequence[float], h: float) -> Tensor:
    """Return state + h Σ weight · slope; the state itself where there are none."""
    for slope, weight in zip(slopes, weights, strict=True):
        if weight:
            state = state + slope * (weight * h)
    return state


def _torchdiffeq() -> Any:
    """Import torchdiffeq, but not scipy.integrate with it: half a second, for one solver that is not used here.

    While torchdiffeq is imported a stand-in takes the place of that module. It gives out a `solve_ivp` that imports
    the real one when it is called, so that torchdiffeq's ``scipy_solver`` works for everybody else.
    """
    if "torchdiffeq" in sys.modules:
        return import_module("torchdiffeq")
    if _UNUSED not in sys.modules:
        sys.modules[_UNUSED] = _StandIn(_UNUSED)
    try:
        # In a thread of its own: under a fake mode or a default device, which a thread does not hand on, the tables
        # that torchdiffeq makes when it is imported would be fake, or on that device, for good.
        with ThreadPoolExecutor(1) as thread:
            return thread.submit(import_module, "torchdiffeq").result()
    finally:
        if isinstance(sys.modules.get(_UNUSED), _StandIn):
            del sys.modules[_UNUSED]


_UNUSED = "scipy.integrate"


class _StandIn(ModuleType):
    """A module that is imported when something else than `solve_ivp` is asked of it, as another thread may do."""

    @staticmethod
    def solve_ivp(*arguments: Any, **options: Any) -> Any:
        """Call the function of the real module."""
        return import_module(_UNUSED).solve_ivp(*arguments, **options)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        sys.modules.pop(_UNUSED, None)
        return getattr(import_module(_UNUSED), name)


def _equal_steps(steps: int) -> Callable[[Rate, Tensor, Tensor], Tensor]:
    """Return torchdiffeq's way to ask for ``steps`` equal steps between any two times."""

    def grid_constructor(_: Rate, __: Tensor, t: Tensor) -> Tensor:
        parts = [torch.linspace(a, b, steps + 1, dtype=t.dtype, device=t.device)[1:] for a, b in pairwise(t.tolist())]
        return torch.cat([t[:1], *parts])

    return grid_constructor


def _adaptive(start: Tensor, times: Sequence[float], grid: Grid, solver: OdeSolver) -> dict[str, Any]:
    """Return the settings of an adaptive method: the error of a step is its largest component, in voxels."""
    spacing = grid.along(grid.spacing, start)

    def norm(x: Tensor) -> Tensor:
        return (x / spacing).abs().amax()

    first_step = abs(times[1] - times[0]) / solver.steps
    options = {"norm": norm, "first_step": first_step, "max_num_steps": MOST_STEPS}
    return {"method": solver.method, "rtol": 0.0, "atol": solver.atol, "options": options}
