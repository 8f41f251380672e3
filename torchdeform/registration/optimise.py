"""The loop of every registration: forces of the images give velocities by least squares, whose flows move the maps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.flow import flow
from torchdeform.core.fold_free import largest_share, repair_folds, smooth_elastically, where_items
from torchdeform.core.grid import Grid, limit_threads, per_item
from torchdeform.core.resampling import Transfer, box_sum, coarsened, prolong, pyramid_grids
from torchdeform.core.warp import compose
from torchdeform.deformation.rigid import RigidHold
from torchdeform.errors import InputError
from torchdeform.metrics.correlation import window_mean
from torchdeform.registration.landmarks import ForwardLandmarks
from torchdeform.registration.objective import MakeObjective, Objective, forward_objective
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.result import Callback, LevelRecord, Progress
from torchdeform.registration.settings import MetricSettings, RegistrationSettings
from torchdeform.registration.tissue import Tissue
from torchdeform.registration.velocity import (
    LAST_STEP,
    VelocityMetric,
    evened,
    fold_barrier,
    image_force,
    limited_step,
    normalise_step,
    step_size,
)

# Steps over which a level must have gained, see `OptimiserSettings.tolerance`.
_PATIENCE = 5

# Finest levels whose images have more nodes than this carry the map on the coarser grid of
# `OptimiserSettings.map_spacing`. Mouse brains (10^6 nodes) gain 0.003 Dice and half of the time by it; slices and
# hippocampi (7·10^4) would lose 0.01.
_LARGE = 2**17

# A step that made the images less similar makes all that follow so many times as long.
_SHORTER = 0.85

# ``elasticity: auto`` is this where noise is not known, else so much without noise, more with its share, and at most
# so much.
_ELASTICITY, _CALM, _PER_NOISE, _MOST_ELASTIC = 0.2, 0.1, 3.0, 0.4

# A step that would fold is shortened around the folds first: so often, by this share, within so many nodes.
_LOCAL_TRIES, _CUT, _WITHIN = 4, 0.7, 4

# Price of points that were found, for a mean distance of a voxel of the level.
_ANCHOR = 0.1

# A similarity that is higher by a smaller share of itself is not higher: its last bits depend on the sums.
_ROUNDING = 1e-6

# How often a step that would fold is halved before it is left out.
_HALVINGS = 6


@dataclass(frozen=True)
class Level:
    """What stays the same during the steps of one level.

    Attributes:
        objective: what is maximised.
        metric: of the velocities, on the grid of the map.
        settings: the settings.
        steps: steps at most.
        index: its number, 0 is the coarsest.
        levels: how many there are.
        elasticity: smoothing of each map in a step, a number or one for each ``(B,)``.
        transfer: between the grid of the images and that of the map, None where they are one.
        keep_best: end at the best map that was met, and stop where nothing is gained; otherwise make all steps.
        held: axes along which nothing is moved, from 0.
        tissue: what the fixed image is made of, on the grid of the map.
        hold: makes maps rigid again where the tissue is.
        voxel: smallest spacing of the images at full detail.
    """

    objective: Objective
    metric: VelocityMetric
    settings: RegistrationSettings
    steps: int
    index: int = 0
    levels: int = 1
    elasticity: float | Tensor = _ELASTICITY
    transfer: Transfer | None = None
    keep_best: bool = True
    held: tuple[int, ...] = ()
    tissue: Tissue | None = None
    hold: RigidHold | None = None
    voxel: float = 1.0

    @property
    def grid(self) -> Grid:
        """The grid of the level's map."""
        return self.metric.grid

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid of the level's images."""
        return self.objective.similarity.grid.shape

    def force(self, slope: Tensor, warped: Tensor) -> Tensor:
        """Return the `image_force` on the grid of the map."""
        force = partial(image_force, slope, warped, self.objective.similarity.grid, self.settings.stencil)
        return force() if self.transfer is None else self.transfer.gather(force)

    @property
    def zero(self) -> Tensor:
        """Maps that are the identity, ``(B, D, *S)``."""
        images = self.objective.similarity.images
        return images.new_zeros(len(images), self.grid.dim, *self.grid.shape)


@dataclass(frozen=True)
class State:
    """Where the maps of a level are.

    Attributes:
        u: displacements ``(B, D, *S)`` in units of spacing.
        lowest: their smallest one-sided determinant at each node ``(B, 1, *S)``.
        direction: of the last step, ``(B, D, *S)``.
        active: which maps still move ``(B,)``.
        best: the best maps met, ``(B, D, *S)``.
        values: similarity of each map after each step ``(B,)``.
        best_values: what was maximised at its best so far, after each step.
        shortened: steps that were shortened because they would have folded, summed over the batch.
        ascent: of the last step, as the solver left it, where tissue varies.
        pace: share of its length that a step of each map still has ``(B,)``.
    """

    u: Tensor
    lowest: Tensor
    direction: Tensor
    active: Tensor
    best: Tensor
    values: tuple[Tensor, ...] = ()
    best_values: tuple[Tensor, ...] = ()
    shortened: int = 0
    ascent: Tensor | None = None
    pace: float | Tensor = 1.0


def optimise_levels(
    problem: RegistrationProblem,
    settings: RegistrationSettings,
    start: Tensor | None,
    callback: Callback | None,
    objective: MakeObjective = forward_objective,
) -> tuple[Tensor, tuple[LevelRecord, ...]]:
    """Return the maps that make the images of the problem most similar, and how each level went.

    Args:
        problem: images on their scale.
        settings: how.
        start: maps to begin with ``(B, D, *S)`` in units of spacing, on any grid of the box; zero when None.
        callback: is shown every step.
        objective: makes what is maximised on the grid of a level.
    """
    grids = pyramid_grids(problem.grid, len(settings.optimiser.steps))
    u, records = start, []
    for index, grid in enumerate(grids):
        began = perf_counter()
        level = make_level(problem.on(grid), settings, objective, index, len(grids))
        level = replace(level, voxel=min(problem.grid.spacing))
        u = level.zero if u is None else repair_folds(prolong(u, level.grid), level.grid)
        with limit_threads(len(u), grid):
            state = optimise_level(level, u, callback)
            checked = level.objective.similarity.masks is not None  # all voxels count in all maps without
            u = best_map(level.objective, settings, state.best, u, level=level)[0] if checked else state.best
        records.append(LevelRecord(level.shape, state.values, state.shortened, perf_counter() - began))
    if u is None:
        raise InputError("register: optimiser.steps must hold one number per level")
    return repair_folds(prolong(u, problem.grid), problem.grid), tuple(records)


def make_level(
    problem: RegistrationProblem,
    settings: RegistrationSettings,
    objective: MakeObjective,
    index: int,
    levels: int,
) -> Level:
    """Return level ``index`` of so many, from the problem on its grid."""
    below = levels - 1 - index
    grid = _map_grid(problem.grid, settings, below)
    tissue = problem.tissue and problem.tissue.on(problem.grid, grid)
    goal = _anchored(objective(problem, grid, settings), problem, grid, below / max(levels - 1, 1))
    return Level(
        objective=goal,
        metric=VelocityMetric.of(grid, settings.metric, settings.solver, problem.fixed, below, tissue),
        settings=settings,
        steps=settings.optimiser.steps[index - levels],
        index=index,
        levels=levels,
        elasticity=elasticity_of(settings.metric, len(goal.similarity.images), problem.noise),
        transfer=Transfer(problem.grid, grid, problem.fixed) if grid != problem.grid else None,
        held=problem.held,
        tissue=tissue,
        hold=None if tissue is None else tissue.hold(grid),
    )


def _anchored(goal: Objective, problem: RegistrationProblem, grid: Grid, share: float) -> Objective:
    """Return the goal with points that were found, a share of their weight: 1 on the coarsest level, 0 on the finest.

    What such a level shows blurred, or not at all, would else be moved away from where the points led it.
    """
    if problem.anchors is None or goal.landmarks is not None or share == 0:
        return goal
    weight = share * _ANCHOR / min(problem.grid.spacing) ** 2
    return replace(
        goal, landmarks=ForwardLandmarks(*problem.anchors[:2], grid, problem.anchors[2]), points_weight=weight
    )


def _map_grid(grid: Grid, settings: RegistrationSettings, below: int) -> Grid:
    """Return the grid that carries the map of images on ``grid``, with so many finer levels below."""
    large = below == 0 and math.prod(grid.shape) > _LARGE
    return coarsened(grid, settings.optimiser.map_spacing) if large else grid


def elasticity_of(settings: MetricSettings, maps: int, noise: Tensor | None = None) -> float | Tensor:
    """Return the elasticity of all maps, or of each of so many ``(maps,)`` by the noise of its images."""
    if not isinstance(settings.elasticity, str):
        return settings.elasticity
    if noise is None:
        return _ELASTICITY
    return (_CALM + _PER_NOISE * noise.repeat(maps // len(noise))).clamp(max=_MOST_ELASTIC)


def optimise_level(
    level: Level, u: Tensor, callback: Callback | None = None, run: Callable[..., Any] | None = None
) -> State:
    """Return where the maps end, from maps u without folds.

    Args:
        level: what stays the same.
        u: displacements ``(B, D, *S)`` on the grid of the level's map, in units of spacing.
        callback: is shown every step.
        run: calls a function with its arguments; anything that does that, such as torch's ``checkpoint``.
    """
    active = torch.ones(len(u), dtype=torch.bool, device=u.device)
    state = State(u, one_sided_determinant(u, level.grid), torch.zeros_like(u), active, u, pace=u.new_ones(len(u)))
    for step in range(level.steps + level.keep_best):
        state, finished = run(_step, level, state, step) if run else _step(level, state, step)
        if callback:
            callback(Progress(level.index, level.levels, step, level.steps, state.values[-1], level.shape))
        if finished:
            break
    return state


def best_map(
    objective: Objective, settings: RegistrationSettings, *maps: Tensor, level: Level | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return for each item the map with the highest goal over the same voxels, its similarity, and that of the last.

    A map that moves what does not fit out of the image, or out of the mask, would else seem better than it is.

    Args:
        objective: what counts.
        settings: the settings.
        maps: displacements ``(B, D, *S)``; of equal ones the last is returned.
        level: whose maps they are; None for maps on the grid of the images.
    """
    values = objective.on_common_voxels(maps, level and level.transfer)
    goals = values
    if objective.landmarks:
        distances = [objective.landmarks.evaluate(u).distance for u in maps]
        goals = [v - objective.points_weight * d for v, d in zip(values, distances, strict=True)]
    *others, (best, top, found) = zip(maps, goals, values, strict=True)
    for u, goal, value in reversed(others):
        better = goal > top + _ROUNDING * goal.abs()
        best, top, found = (where_items(better, *pair) for pair in ((u, best), (goal, top), (value, found)))
    return best, found, values[-1]


def _step(level: Level, state: State, step: int) -> tuple[State, bool]:
    """Return the state after one step, and whether it was the last."""
    settings, objective, grid = level.settings, level.objective, level.grid
    # 1. Evaluate: warp the images, compare them, and see how far the landmarks are apart.
    more = [addition.evaluate(state.u, settings.stencil) for addition in objective.more]
    warped, value, slope = objective.similarity.evaluate(state.u, level.transfer)
    value = sum((added for added, _ in more), start=value)
    points = objective.landmarks.evaluate(state.u) if objective.landmarks else None
    state = _judged(level, state, value, None if points is None else points.distance)
    if level.keep_best and (step == level.steps or not bool(state.active.any())):
        return state, True
    # 2. Force: steepest ascent of the similarity asks for N ∂S/∂warped ∇warped, the landmarks pull at their points.
    force, channels = level.force(slope, warped), warped.shape[1]
    del warped, slope  # before the next are made
    force = sum((channels * added for _, added in more), start=force)  # N counts the channels of the images
    even, limit = settings.optimiser.evenness, settings.optimiser.limit
    whole = level.tissue is not None  # what is rigid turns as a whole
    force = force if even is None or whole else evened(force, even)
    scale = objective.points_weight * math.prod(grid.shape) * channels  # to the unit of N ∂S/∂warped
    load = None if points is None else points.load(grid) * scale
    # 3. Least squares: div and curl of the velocity are paid for, nearly folded places ask for divergence.
    barrier = level.voxel * fold_barrier(state.lowest, settings.folds.soft_determinant)
    force, load = held_still(force, level.held), None if load is None else held_still(load, level.held)
    coupling = objective.coupling
    ascent = level.metric.ascent(force, barrier, load, coupling.together, state.ascent)
    v = held_still(ascent, level.held)
    v = normalise_step(coupling.velocity(v), grid, coupling.together)
    direction = v + settings.optimiser.momentum * state.direction
    if limit is None or whole:
        v = normalise_step(direction, grid, coupling.together)
    else:
        v = limited_step(direction, grid, limit, coupling.together)
    # 4. and 5. Flow and guard: φ ← φ ∘ flow(v), no farther than where a determinant becomes too small.
    voxel = min(objective.similarity.grid.spacing) / min(grid.spacing)
    size = v.new_full((len(v),), voxel * step_size(settings.optimiser, step, level.steps)) * state.pace
    if points is not None and settings.points_weight > 0:
        size = points.line_search(v, grid).clamp(min=LAST_STEP * size, max=size)
    moved, u, lowest = fold_free_step(level, state, v * per_item(size * state.active, v))
    shortened = state.shortened + int((moved < 1).sum())
    active = state.active & (moved > 0)
    state = replace(state, u=u, lowest=lowest, direction=direction, active=active, shortened=shortened)
    return replace(state, ascent=None if level.tissue is None else ascent), False


def held_still(field: Tensor, axes: Sequence[int]) -> Tensor:
    """Return a vector field ``(B, D, *S)`` without its components along some axes.

    The velocity of a force that has been through this, taken through it again, still leads uphill: P K⁻¹ P ≥ 0.
    """
    return field.index_fill(1, torch.tensor(axes, device=field.device), 0.0) if axes else field


def fold_free_step(level: Level, state: State, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return which share of the step every map made, u ∘ flow(share v) smoothed elastically, and its determinants.

    No one-sided determinant falls below ``min_determinant``, or below the smallest one there was if that was less. The
    step is shortened around the nodes where one would, so that a few of them do not hold back all others; where that is
    not enough it is halved as a whole, and as the trial then tends to u, a bold step ends as a short one. The
    extrapolated determinants on the faces of the box are left to `repair_folds`, after the last step: they take as long
    as all the others and hardly ever fold alone.
    """
    coupling = level.objective.coupling
    floor = state.lowest.flatten(1).amin(1).clamp(max=level.settings.folds.min_determinant)
    u, lowest = state.u, state.lowest

    def accept(share: Tensor) -> Tensor:
        nonlocal u, lowest
        u, lowest = _moved(level, state, around * per_item(share, v) * v, share, floor)
        return coupling.all(lowest.flatten(1).amin(1) >= floor)

    around, whole = torch.ones_like(v[:, :1]), torch.ones_like(floor)
    for _ in range(_LOCAL_TRIES if level.tissue is None else 0):
        u, lowest = _moved(level, state, around * v, whole, floor)
        folded = ~coupling.all(lowest >= per_item(floor, lowest))
        if not bool(folded.any()):
            return around.flatten(1).amin(1), u, lowest
        around = around * (1 - _CUT * _near(folded.to(v)))
    share = largest_share(accept, floor, halvings=_HALVINGS)
    good = share > 0
    return share * around.flatten(1).amin(1), where_items(good, u, state.u), where_items(good, lowest, state.lowest)


def _near(nodes: Tensor) -> Tensor:
    """Return 1 near nodes that are 1 and not 0 ``(B, 1, *S)``, falling to 0 over so many nodes again."""
    width = 2 * _WITHIN + 1
    return window_mean((box_sum(nodes, width) > 0.5).to(nodes), width)


def _moved(level: Level, state: State, v: Tensor, share: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
    """Return u ∘ flow(v), smoothed elastically by a share ``(B,)`` and held, and its one-sided determinants."""
    grid, coupling = level.grid, level.objective.coupling
    u = compose(state.u, flow(v, grid, level.settings.flow), grid)
    if level.settings.metric.elasticity != 0:
        smoothing = per_item(level.elasticity * share * state.active, u)
        u = smooth_elastically(u, smoothing if level.tissue is None else smoothing * level.tissue.free, grid)
    u = coupling.extended(u)
    u = u if level.hold is None else level.hold(u, floor)
    return u, coupling.counted(one_sided_determinant(u, grid))


def _judged(level: Level, state: State, value: Tensor, distance: Tensor | None) -> State:
    """Return the state with the best maps so far, and without the maps that gain no more."""
    if not level.keep_best:
        return replace(state, values=(*state.values, value.detach()))
    goal = value if distance is None else value - level.objective.points_weight * distance
    top = state.best_values[-1] if state.best_values else torch.full_like(goal, -torch.inf)
    better = goal > top
    best, top = where_items(better, state.u, state.best), where_items(better, goal, top)
    best_values = (*state.best_values, top)
    active = state.active & ~_stalled(best_values, level.settings.optimiser.tolerance)
    pace = torch.where(better, state.pace, _SHORTER * state.pace)
    return replace(state, best=best, values=(*state.values, value), best_values=best_values, active=active, pace=pace)


def _stalled(best_values: tuple[Tensor, ...], tolerance: float) -> Tensor:
    """True for the maps whose last steps raised the best value by too small a share of the whole rise."""
    if len(best_values) <= _PATIENCE:
        return torch.zeros_like(best_values[0], dtype=torch.bool)
    return best_values[-1] - best_values[-1 - _PATIENCE] <= tolerance * (best_values[-1] - best_values[0])
