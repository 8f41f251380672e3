"""The three versions of the deformation method: grids with a given cell size, as flows of one and the same equation.

Let ρ = (1 − s) ρ0 + s ρ1 be a density with ∫ ρ0 = ∫ ρ1, and v a velocity with div v = ρ0 − ρ1 and n·v = 0. Then along
dφ/ds = v(φ)/ρ(φ, s) the product J(φ) ρ(φ, s) does not change, so φ at s = 1 has J(φ) ρ1(φ) = ρ0. It is

    Version 1, J(φ)(ξ) = f(ξ):           with ρ0 = f,   ρ1 = 1;
    Version 2, g(ξ) J(φ)(ξ) = f(φ(ξ)):   with ρ0 = 1/g, ρ1 = 1/f;
    Version 3, J(φ)(ξ, t) = f(φ, t):     with ρ0 = 1/f(t), ρ1 = 1/f(t + dt) from one time to the next.

Liu, Liao & Xue 2007, sections 2.1 to 2.3, where the denominator of Version 2 has a minus sign; their proof (2.17) and
the equation above need the plus.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import torch
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.flow import OdeSolver, integrate_points, require_times
from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid, common_batch, per_item
from torchdeform.core.warp import max_voxels, sample
from torchdeform.deformation.corrections import correct_determinant
from torchdeform.deformation.monitors import mean_value, normalise_monitor, require_positive
from torchdeform.deformation.velocity import VelocityName, find_velocity
from torchdeform.errors import ComputationError, InputError, require_ranges
from torchdeform.fem.boundary import fixed_unknowns

# A monitor in time: t -> f (B, 1, *S), or its values at the times asked for, (T, B, 1, *S).
MovingMonitor = Callable[[float], Tensor] | Tensor | Sequence[Tensor]


@dataclass(frozen=True, kw_only=True)
class DeformationSettings:
    """How the ODE of the deformation method is solved, and what is done to the map at the end.

    Args:
        solver: how points are moved; 20 steps of ``rk4`` by default.
        corrections: steps of `correct_determinant`; 0 leaves the determinants as the flow gives them.
        remove_folds: whether to take out what folds between the nodes where the monitor varies too much for the grid;
            if not, `diagnose` tells.

    Raises:
        InputError: a negative number of corrections.
    """

    solver: OdeSolver = field(default_factory=lambda: OdeSolver(steps=20))
    corrections: int = 3
    remove_folds: bool = True

    def __post_init__(self) -> None:
        count = (lambda x: isinstance(x, int) and x >= 0, "be 0 or more")
        require_ranges(self, "DeformationSettings: ", corrections=count)


_STILL = DeformationSettings()
_MOVING = DeformationSettings(solver=OdeSolver(steps=4))

# A misfit of Version 3 is told if it is this large, and so much larger than at the first time.
_LARGE_MISFIT, _GROWTH = 0.01, 3.0


def grid_from_initial_monitor(
    f: Tensor,
    grid: Grid,
    velocity: VelocityName = "div_curl",
    *,
    curl: Tensor | None = None,
    settings: DeformationSettings = _STILL,
) -> Tensor:
    """Return the displacement u of a map φ = id + u of Ω onto itself with J(φ)(ξ) = f(ξ): Version 1.

    Args:
        f: cell size wanted of each node, ``(B, 1, *S)``, positive; divided by its mean over Ω.
        grid: the grid.
        velocity: way to the velocity: ``direct``, ``poisson`` or ``div_curl``, see `find_velocity`.
        curl: curl of the velocity v, ``(B or 1, 1, *S)`` in 2D, ``(B or 1, 3, *S)`` in 3D, for ``div_curl``; 0 by
            default.
        settings: ODE solver, corrections.

    Returns:
        ``(B, D, *S)`` in units of spacing. Boundary nodes stay on their faces exactly, and φ has no folds by the full
        certificate (`diagnose`).

    Raises:
        InputError: shapes, types, fewer than 3 nodes along an axis, an unknown velocity, a monitor that is not positive
            or not finite.
        ComputationError: the system was not solved, the flow is not finite, or its folds could not be removed.

    Notes:
        div v = f − 1, dφ/dt = v(φ)/(t + (1 − t) f(φ)), Liu, Liao & Xue 2007, eq. (2.2) and (2.3). The error of J falls
        with the square of the spacing. Where f varies too much for the grid to follow without a fold, J is something
        between; `jacobian_determinant` tells. Differentiable in f and curl; the choice of time steps in the ODE, which
        follows the range of f, counts as constant.
    """
    require_positive(f, grid, "grid_from_initial_monitor: f")
    start = normalise_monitor(f, grid)
    return _from_identity(start, torch.ones_like(start), grid, velocity, curl, settings)


def grid_from_target_monitor(
    f: Tensor,
    grid: Grid,
    g: Tensor | None = None,
    velocity: VelocityName = "div_curl",
    *,
    curl: Tensor | None = None,
    settings: DeformationSettings = _STILL,
) -> Tensor:
    """Return the displacement u of a map φ = id + u of Ω onto itself with g(ξ) J(φ)(ξ) = f(φ(ξ)): Version 2.

    Args:
        f: cell size wanted at each place, ``(B, 1, *S)``, positive; multiplied by a number so that ∫ 1/f = ∫ 1/g.
        grid: the grid.
        g: second monitor, at the old places of the nodes, ``(B or 1, 1, *S)``, positive; 1 by default.
        velocity: way to the velocity: ``direct``, ``poisson`` or ``div_curl``, see `find_velocity`.
        curl: curl of the velocity v, as in `grid_from_initial_monitor`.
        settings: ODE solver, corrections.

    Returns:
        ``(B, D, *S)`` in units of spacing. Boundary nodes stay on their faces exactly, and φ has no folds by the full
        certificate (`diagnose`).

    Raises:
        InputError: shapes, types, fewer than 3 nodes along an axis, an unknown velocity, a monitor that is not positive
            or not finite.
        ComputationError: the system was not solved, the flow is not finite, or its folds could not be removed.

    Notes:
        div v = 1/g − 1/f, dφ/dt = v(φ)/(t/f(φ) + (1 − t)/g(φ)), Liu, Liao & Xue 2007, eq. (2.16) and (2.17) with
        the sign that (2.17) needs. Otherwise as `grid_from_initial_monitor`; differentiable in f, g and curl.
    """
    require_positive(f, grid, "grid_from_target_monitor: f")
    end = 1 / normalise_monitor(f, grid, "reciprocal_mean")
    if g is None:
        return _from_identity(torch.ones_like(end), end, grid, velocity, curl, settings)
    require_positive(g, grid, "grid_from_target_monitor: g")
    common_batch("deformation", f, g)
    start = 1 / g
    return _from_identity(start, end * mean_value(start, grid), grid, velocity, curl, settings)


def track_moving_monitor(
    f_of_t: MovingMonitor,
    grid: Grid,
    times: Sequence[float],
    velocity: VelocityName = "div_curl",
    *,
    curl: Tensor | None = None,
    start: Tensor | None = None,
    settings: DeformationSettings = _MOVING,
) -> Tensor:
    """Return the displacements u(t) of maps φ = id + u with J(φ)(ξ, t) = f(φ(ξ, t), t) at all times: Version 3.

    Args:
        f_of_t: the monitor in time: a callable that takes t and returns ``(B, 1, *S)``, or its values at ``times``,
            ``(T, B, 1, *S)``. Positive; multiplied at each time by a number so that ∫ 1/f = |Ω|.
        grid: the grid.
        times: the times asked for, two or more, increasing or decreasing.
        velocity: way to the velocity: ``direct``, ``poisson`` or ``div_curl``, see `find_velocity`.
        curl: curl of v, the same at all times, as in `grid_from_initial_monitor` but per unit of time; not for the
            first displacement.
        start: displacement at the first time ``(B or 1, D, *S)``, n·u = 0 on the boundary, which should have
            J = f(φ); by default what Version 2 gives, which is the identity where f = 1.
        settings: ODE solver, its steps being those from each time to the next; corrections, made at each time. By
            default 4 steps of ``rk4``.

    Returns:
        ``(T, B, D, *S)`` in units of spacing, one displacement for each time, the first included. As for the other
        versions, boundary nodes stay on their faces and no map folds.

    Raises:
        InputError: shapes, types, times, fewer than 3 nodes along an axis, an unknown velocity, a monitor that is not
            positive or not finite at a time (named).
        ComputationError: the system was not solved, the flow is not finite, or its folds could not be removed.

    Notes:
        div v = −∂t(1/f), dφ/dt = f(φ, t) v(φ, t), Liu, Liao & Xue 2007, section 2.3. 1/f is taken linear in time: from
        step to step for a callable, which is called once a step, and from time to time for a stack. For such f the
        equation above is exact, so J = f(φ, t) holds at the end of each step however long; the path of the nodes
        between is of second order in the length. Where motion goes on and on the nodes shear, and the grid holds the
        map less and less well: a `RuntimeWarning` says so once J misses f by 1 % on average, three times as at first;
        `monitor_misfit` returns by how much, for each time.
        One velocity a step for a callable, one an interval for a stack. Differentiable in the monitors, curl and start.
    """
    times, solver = _checked_times(f_of_t, times), settings.solver
    parts, solver = (solver.steps, replace(solver, steps=1)) if callable(f_of_t) else (1, solver)
    now = _density_at(f_of_t, grid, times, times[0])
    u = _first_displacement(start, now, grid, velocity, settings)
    shots, first = [u], _misfit(u.detach(), now.detach(), grid)
    for begin, end in pairwise(times):
        moments = [begin + (end - begin) * part / parts for part in range(parts)]
        for earlier, later in pairwise([*moments, end]):
            then = _density_at(f_of_t, grid, times, later)
            common_batch("deformation", now, then)
            v = find_velocity(now - then, grid, velocity, curl=None if curl is None else curl * (later - earlier))
            u, now = _follow(u, now, then, v, grid, solver), then
        u = _finish(u, torch.ones_like(now), now, grid, settings)
        shots.append(u)
        _warn_of_loss(_misfit(u.detach(), now.detach(), grid), first, end)
    return torch.stack(torch.broadcast_tensors(*shots))


def monitor_misfit(u: Tensor, f: Tensor, grid: Grid) -> Tensor:
    """Return how far a map φ = id + u is from J(φ)(ξ) = f(φ(ξ)), which Versions 2 and 3 ask for.

    Args:
        u: displacement in units of spacing, ``(B or 1, D, *S)``; of Version 3 that at one time.
        f: the monitor, at that time, ``(B or 1, 1, *S)``, positive; multiplied by a number so that ∫ 1/f = |Ω|.
        grid: the grid.

    Returns:
        The mean of |J(φ)/f(φ) − 1| over the nodes of each item, ``(B,)``: 0.01 is 1 % of the cell size.

    Raises:
        InputError: shapes, types, or a monitor that is not positive or not finite.
    """
    grid.check_vector(u, "monitor_misfit: u")
    require_positive(f, grid, "monitor_misfit: f")
    common_batch("monitor_misfit", u, f)
    return _misfit(u, 1 / normalise_monitor(f, grid, "reciprocal_mean"), grid)


def _misfit(u: Tensor, density: Tensor, grid: Grid) -> Tensor:
    """Return the misfit of each item, 1/f being the density."""
    batch = common_batch("monitor_misfit", u, density)
    nodes = grid.points(dtype=u.dtype, device=u.device)
    there = sample(density.expand(batch, -1, *grid.shape), (nodes + u).expand(batch, -1, *grid.shape), grid)
    return (jacobian_determinant(u, grid) * there - 1).abs().flatten(1).mean(1)


@torch.no_grad()
def _warn_of_loss(misfits: Tensor, firsts: Tensor, time: float) -> None:
    """Say so where a map has come to be too distorted for its grid to hold what is asked for."""
    misfit, first = float(misfits.amax()), float(firsts.amax())
    if misfit > max(_LARGE_MISFIT, _GROWTH * first):
        text = (
            f"track_moving_monitor: J misses f by {misfit:.2g} on average at time {time:g}, by {first:.2g} at first: "
            "the map is too distorted for the grid; take more nodes, or begin anew, without start, before that time"
        )
        warnings.warn(text, RuntimeWarning, stacklevel=3)


def _from_identity(
    start: Tensor, end: Tensor, grid: Grid, velocity: VelocityName, curl: Tensor | None, settings: DeformationSettings
) -> Tensor:
    """Return u with J(φ) ρ1(φ) = ρ0 from the densities ρ0 = ``start`` and ρ1 = ``end``, ``(B or 1, 1, *S)``."""
    v = find_velocity(start - end, grid, velocity, curl=curl)
    u = _follow(torch.zeros_like(v), start, end, v, grid, settings.solver)
    return _finish(u, start, end, grid, settings)


def _finish(u: Tensor, start: Tensor, end: Tensor, grid: Grid, settings: DeformationSettings) -> Tensor:
    """Return u without folds and with its determinants corrected, as far as the settings ask for it."""
    if not bool(u.isfinite().all()):
        raise ComputationError("the flow is not finite: the monitor spans too many orders of magnitude; raise f_min")
    if settings.remove_folds:
        u = repair_folds(u, grid)
    for _ in range(settings.corrections):
        u = correct_determinant(u, start, end, grid)
    return u


def _follow(u: Tensor, start: Tensor, end: Tensor, v: Tensor, grid: Grid, solver: OdeSolver) -> Tensor:
    """Return u after dφ/ds = v(φ)/((1 − s) ρ0(φ) + s ρ1(φ)) from s = 0 to 1; boundary nodes stay on their faces."""
    batch, dim = common_batch("deformation", u, v, start, end), grid.dim
    fields = torch.cat([part.expand(batch, -1, *grid.shape) for part in (v, start, end)], dim=1)
    on_face, clock = fixed_unknowns("slip", grid, v.device), _clock(start, end)

    def rate(t: Tensor, points: Tensor) -> Tensor:
        s, pace = clock(t)
        values = sample(fields, points, grid)
        density = torch.lerp(values[:, dim : dim + 1], values[:, dim + 1 :], s)
        return (values[:, :dim] * (pace / density)).masked_fill(on_face, 0)

    nodes = grid.points(dtype=v.dtype, device=v.device)
    moved = integrate_points(rate, (nodes + u).expand(batch, -1, *grid.shape), (0.0, 1.0), grid, solver, (fields,))
    return (moved[-1] - nodes).masked_fill(on_face, 0)


@torch.no_grad()
def _clock(start: Tensor, end: Tensor) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """Return t -> (s, ds/dt) for each item, the pace at which to go through ρ = (1 − s) ρ0 + s ρ1.

    Cells shrink as 1/(1 + (q − 1) s) with q = ρ1/ρ0, in a wink where q is large (at the start) or small (at the end).
    With the largest q = M and the smallest q = m, (1 + (M − 1) s)/(1 + (m − 1) s) = (M/m)^t spreads this over t: there
    the logarithms of the two extreme cell sizes differ by an amount proportional to t.
    """
    ratio = (end / start).flatten(1)
    most, least = per_item(ratio.amax(1).clamp(min=1.01), start), per_item(ratio.amin(1).clamp(max=0.99), start)
    rate = torch.log(most / least)

    def clock(t: Tensor) -> tuple[Tensor, Tensor]:
        growth = torch.exp(rate * t)
        divisor = (most - 1) + (1 - least) * growth
        return torch.expm1(rate * t) / divisor, rate * growth * (most - least) / divisor**2

    return clock


def _checked_times(f_of_t: MovingMonitor, times: Sequence[float]) -> list[float]:
    times = [float(t) for t in times]
    require_times(times, "track_moving_monitor")
    if not callable(f_of_t) and len(f_of_t) != len(times):
        raise InputError(f"track_moving_monitor: f_of_t has {len(f_of_t)} monitors for {len(times)} times")
    return times


def _density_at(f_of_t: MovingMonitor, grid: Grid, times: list[float], t: float) -> Tensor:
    """Return 1/f at time t with mean 1; a stack is asked at its own times only."""
    f = f_of_t(t) if callable(f_of_t) else f_of_t[times.index(t)]
    require_positive(f, grid, f"track_moving_monitor: f at time {t:g}")
    return 1 / normalise_monitor(f, grid, "reciprocal_mean")


def _first_displacement(
    start: Tensor | None, density: Tensor, grid: Grid, velocity: VelocityName, settings: DeformationSettings
) -> Tensor:
    """Return ``start`` once it is checked, else what Version 2 gives, in no fewer steps than it takes by itself."""
    if start is None:
        solver = replace(settings.solver, steps=max(settings.solver.steps, _STILL.solver.steps))
        still = replace(settings, solver=solver)
        return _from_identity(torch.ones_like(density), density, grid, velocity, None, still)
    grid.check_vector(start, "track_moving_monitor: start")
    across = max_voxels(start * fixed_unknowns("slip", grid, start.device), grid)
    if not bool((across < 1e-3).all()):
        raise InputError("track_moving_monitor: start must leave boundary nodes on their faces, n·u = 0")
    return start
