"""The loop of every registration: forces of the images give velocities by least squares, whose flows move the maps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.flow import flow
from torchdeform.core.fold_free import largest_share, repair_folds, smooth_elastically, where_items
from torchdeform.core.grid import Grid, limit_threads, per_item
from torchdeform.core.resampling import Transfer, coarsened, prolong, pyramid_grids
from torchdeform.core.warp import compose, warp
from torchdeform.deformation.rigid import RigidHold
from torchdeform.errors import InputError
from torchdeform.metrics.base import Similarity, weighted
from torchdeform.metrics.similarity import features, make_similarity
from torchdeform.registration.landmarks import ForwardLandmarks, Landmarks
from torchdeform.registration.problem import Channels, RegistrationProblem
from torchdeform.registration.result import Callback, LevelRecord, Progress
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.tissue import Tissue
from torchdeform.registration.velocity import (
    LAST_STEP,
    VelocityMetric,
    fold_barrier,
    image_force,
    normalise_step,
    step_size,
)

# Steps over which a level must have gained, see `OptimiserSettings.tolerance`.
_PATIENCE = 5

# Levels whose images have more nodes than this carry the map on the coarser grid of `OptimiserSettings.map_spacing`.
# Mouse brains (10^6 nodes) gain 0.003 Dice and half of the time by it; slices and hippocampi (7·10^4) would lose 0.01.
_LARGE = 2**17

# A similarity that is higher by a smaller share of itself is not higher: its last bits depend on the sums.
_ROUNDING = 1e-6

# How often a step that would fold is halved before it is left out.
_HALVINGS = 6


class Coupling:
    """Which maps of a batch move together; here each by itself."""

    def velocity(self, v: Tensor) -> Tensor:
        """Return the velocities ``(B, D, *S)`` that the maps may move by."""
        return v

    def all(self, flags: Tensor) -> Tensor:
        """Return for each map whether all that move together are flagged, ``(B,)``."""
        return flags

    def extended(self, u: Tensor) -> Tensor:
        """Return the displacements ``(B, D, *S)`` after what a step leaves to be done where they do not count."""
        return u

    def counted(self, lowest: Tensor) -> Tensor:
        """Return the determinants ``(B, 1, *S)`` with 1 where folds do not count."""
        return lowest

    def together(self, sizes: Tensor) -> Tensor:
        """Return for each map the largest size ``(B,)`` of those that are scaled together."""
        return sizes


_FREE = Coupling()


@dataclass(frozen=True)
class SimilarityTerm:
    """Images on one grid, ready to be compared again and again.

    Attributes:
        grid: their grid.
        images: what the maps warp ``(B, C, *S)``.
        similarity: of the warped images.
        masks: masks that are warped with them ``(B, 1, *S)``, or None.
        fixed_mask: a mask that is not warped, or None.
    """

    grid: Grid
    images: Tensor
    similarity: Similarity
    masks: Tensor | None = None
    fixed_mask: Tensor | None = None

    def evaluate(self, u: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the images warped by u ``(B, D, *S)``, as they are when None, S of each, and N ∂S/∂warped."""
        warped = self._masked if u is None else warp(self._masked, u, self.grid)
        del u  # where a coarser grid carries the map, nobody else holds it
        if self.masks is None:
            return warped, *self.similarity.evaluate(warped, self.fixed_mask)
        warped, mask = warped.tensor_split([-1], dim=1)
        return warped, *self.similarity.evaluate(warped.contiguous(), weighted(mask, self.fixed_mask))

    def on_common_voxels(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Return S of the images warped by each of the maps ``(B, D, *S)``, over the voxels that all of them see."""
        mask = common_mask(self.fixed_mask, self.masks, maps, self.grid)
        return [self.similarity.evaluate(warp(self.images, u, self.grid), mask)[0] for u in maps]

    @cached_property
    def _masked(self) -> Tensor:
        """The images and their masks, side by side: one sampling costs less than two."""
        return self.images if self.masks is None else torch.cat([self.images, self.masks], dim=1)


def common_mask(fixed: Tensor | None, moving: Tensor | None, maps: Sequence[Tensor], grid: Grid) -> Tensor | None:
    """Return the weights ``(B, 1, *S)`` of the voxels that the fixed mask and all the warped ones leave, None for 1."""
    mask = fixed
    if moving is not None:
        for u in maps:
            mask = weighted(warp(moving, u, grid), mask)
    return mask


def compared(problem: RegistrationProblem, settings: RegistrationSettings) -> tuple[Channels, ...]:
    """Return all that is compared: what a measure takes of the intensities, if they are, and other channels."""
    if not problem.intensities:
        return problem.channels
    measure = settings.similarity.measure
    fixed, moving = (features(measure, image) for image in (problem.fixed, problem.moving))
    return Channels(problem.grid, fixed, moving, measure), *problem.channels


def forward_similarity(
    problem: RegistrationProblem, channels: Channels, settings: RegistrationSettings
) -> SimilarityTerm:
    """Return the similarity of the fixed and the warped moving channels."""
    similarity = make_similarity(channels.measure, channels.fixed, settings.similarity.window, grid=channels.grid)
    fixed_mask, moving_mask = problem.masks_on(channels.grid)
    return SimilarityTerm(channels.grid, channels.moving, similarity, moving_mask, fixed_mask)


@dataclass(frozen=True)
class Addition:
    """A similarity that is added to that of the images.

    Attributes:
        similarity: S, on its grid.
        weight: of S.
        transfer: between its grid and that of the map, None where they are one.
    """

    similarity: SimilarityTerm
    weight: float
    transfer: Transfer | None = None

    def evaluate(self, u: Tensor, stencil: str) -> tuple[Tensor, Tensor]:
        """Return what is added for maps u ``(B, D, *S)``, and its force N ∂S/∂u likewise, N being that of the nodes."""
        term = self.similarity
        warped, value, slope = term.evaluate(self._at(u))
        force = image_force(slope, warped, term.grid, stencil) * (self.weight / warped.shape[1])
        return self.weight * value, force if self.transfer is None else self.transfer.gather(force)

    def on_common_voxels(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Return what is added for each of the maps, over the voxels that all of them see."""
        return [self.weight * value for value in self.similarity.on_common_voxels([self._at(u) for u in maps])]

    def _at(self, u: Tensor) -> Tensor:
        return u if self.transfer is None else self.transfer.up(u)


@dataclass(frozen=True)
class Objective:
    """What is maximised on the grid of one level, S + Σ wₖ Sₖ − points_weight · E, and which maps move together.

    Attributes:
        similarity: S of the images, on their grid.
        landmarks: E of the pairs of points, on the grid of the map; None without.
        coupling: of the maps.
        more: wₖ Sₖ.
    """

    similarity: Any
    landmarks: Landmarks | None = None
    coupling: Coupling = _FREE
    more: tuple[Addition, ...] = ()

    def on_common_voxels(self, maps: Sequence[Tensor], at_images: Sequence[Tensor]) -> list[Tensor]:
        """Return S + Σ wₖ Sₖ of the maps, which are given on the grid of the images too, over what all of them see."""
        values = self.similarity.on_common_voxels(at_images)
        for addition in self.more:
            values = [value + other for value, other in zip(values, addition.on_common_voxels(maps), strict=True)]
        return values


def additions(terms: Sequence[SimilarityTerm], channels: Sequence[Channels], grid: Grid) -> tuple[Addition, ...]:
    """Return the similarities of channels with their weights, the map being on ``grid``."""
    return tuple(
        Addition(term, one.weight, Transfer(term.grid, grid, term.images) if term.grid != grid else None)
        for term, one in zip(terms, channels, strict=True)
    )


# From the problem on a level's grid, the grid of its map, and the settings.
MakeObjective = Callable[[RegistrationProblem, Grid, RegistrationSettings], Objective]


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
        transfer: between the grid of the images and that of the map, None where they are one.
        keep_best: end at the best map that was met, and stop where nothing is gained; otherwise make all steps.
        held: axes along which nothing is moved, from 0.
        tissue: what the fixed image is made of, on the grid of the map.
        hold: makes maps rigid again where the tissue is.
    """

    objective: Objective
    metric: VelocityMetric
    settings: RegistrationSettings
    steps: int
    index: int = 0
    levels: int = 1
    transfer: Transfer | None = None
    keep_best: bool = True
    held: tuple[int, ...] = ()
    tissue: Tissue | None = None
    hold: RigidHold | None = None

    @property
    def grid(self) -> Grid:
        """The grid of the level's map."""
        return self.metric.grid

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid of the level's images."""
        return self.objective.similarity.grid.shape

    def at_images(self, u: Tensor) -> Tensor:
        """Return the maps ``(B, D, *S)`` on the grid of the images."""
        return u if self.transfer is None else self.transfer.up(u)

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


def forward_objective(problem: RegistrationProblem, grid: Grid, settings: RegistrationSettings) -> Objective:
    """Return what is maximised where the moving image is warped onto the fixed one, the map being on ``grid``."""
    pairs = problem.pairs if settings.points_weight > 0 else None
    channels = compared(problem, settings)
    first, *others = [forward_similarity(problem, one, settings) for one in channels]
    return Objective(first, pairs and ForwardLandmarks(*pairs, grid), more=additions(others, channels[1:], grid))


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
    grid, below = _map_grid(problem.grid, settings), levels - 1 - index
    tissue = problem.tissue and problem.tissue.on(problem.grid, grid)
    return Level(
        objective=objective(problem, grid, settings),
        metric=VelocityMetric.of(grid, settings.metric, settings.solver, problem.fixed, below, tissue),
        settings=settings,
        steps=steps_on(problem.grid, settings.optimiser.steps[index - levels], settings),
        index=index,
        levels=levels,
        transfer=Transfer(problem.grid, grid, problem.fixed) if grid != problem.grid else None,
        held=problem.held,
        tissue=tissue,
        hold=None if tissue is None else tissue.hold(grid),
    )


def steps_on(grid: Grid, steps: int, settings: RegistrationSettings) -> int:
    """Return the steps of a level of images on this grid: a coarser map is found map_spacing² times as soon."""
    return steps if _map_grid(grid, settings) == grid else math.ceil(steps / settings.optimiser.map_spacing**2)


def _map_grid(grid: Grid, settings: RegistrationSettings) -> Grid:
    """Return the grid that carries the map of images on ``grid``."""
    return coarsened(grid, settings.optimiser.map_spacing) if math.prod(grid.shape) > _LARGE else grid


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
    state = State(u, one_sided_determinant(u, level.grid), torch.zeros_like(u), active, u)
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
    values = objective.on_common_voxels(maps, [level.at_images(u) if level else u for u in maps])
    goals = values
    if objective.landmarks:
        distances = [objective.landmarks.evaluate(u).distance for u in maps]
        goals = [v - settings.points_weight * d for v, d in zip(values, distances, strict=True)]
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
    at_images = level.at_images(state.u)
    warped, value, slope = objective.similarity.evaluate(at_images)
    value = sum((added for added, _ in more), start=value)
    points = objective.landmarks.evaluate(state.u) if objective.landmarks else None
    del at_images
    state = _judged(level, state, value, None if points is None else points.distance)
    if level.keep_best and (step == level.steps or not bool(state.active.any())):
        return state, True
    # 2. Force: steepest ascent of the similarity asks for N ∂S/∂warped ∇warped, the landmarks pull at their points.
    force, channels = image_force(slope, warped, objective.similarity.grid, settings.stencil), warped.shape[1]
    del warped, slope  # before the next are made
    force = force if level.transfer is None else level.transfer.gather(force)
    force = sum((channels * added for _, added in more), start=force)  # N counts the channels of the images
    scale = settings.points_weight * math.prod(grid.shape)  # to the unit of N ∂S/∂warped
    load = None if points is None else points.load(grid) * scale
    # 3. Least squares: div and curl of the velocity are paid for, nearly folded places ask for divergence.
    barrier = fold_barrier(state.lowest, settings.folds.soft_determinant)
    force, load = held_still(force, level.held), None if load is None else held_still(load, level.held)
    coupling = objective.coupling
    ascent = level.metric.ascent(force, barrier, load, coupling.together, state.ascent)
    v = held_still(ascent, level.held)
    v = normalise_step(coupling.velocity(v), grid, coupling.together)
    direction = v + settings.optimiser.momentum * state.direction
    v = normalise_step(direction, grid, coupling.together)
    # 4. and 5. Flow and guard: φ ← φ ∘ flow(v), no farther than where a determinant becomes too small.
    size = v.new_full((len(v),), step_size(settings.optimiser, step, level.steps))
    if points is not None:
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

    No one-sided determinant falls below ``min_determinant``, or below the smallest one there was if that was less. As
    the step is halved the trial tends to u, so a bold step ends as a short one. The extrapolated determinants on the
    faces of the box are left to `repair_folds`, after the last step: they take as long as all the others and hardly
    ever fold alone.
    """
    settings, grid = level.settings, level.grid
    floor = state.lowest.flatten(1).amin(1).clamp(max=settings.folds.min_determinant)
    u, lowest = state.u, state.lowest
    free = None if level.tissue is None else level.tissue.free

    def accept(share: Tensor) -> Tensor:
        nonlocal u, lowest
        u = compose(state.u, flow(v * per_item(share, v), grid, settings.flow), grid)
        if settings.metric.elasticity > 0:
            moved = per_item(settings.metric.elasticity * share * state.active, u)
            u = smooth_elastically(u, moved if free is None else moved * free, grid)
        u = level.objective.coupling.extended(u)
        if level.hold is not None:
            u = level.hold(u, floor)
        lowest = level.objective.coupling.counted(one_sided_determinant(u, grid))
        return level.objective.coupling.all(lowest.flatten(1).amin(1) >= floor)

    share = largest_share(accept, floor, halvings=_HALVINGS)
    good = share > 0
    return share, where_items(good, u, state.u), where_items(good, lowest, state.lowest)


def _judged(level: Level, state: State, value: Tensor, distance: Tensor | None) -> State:
    """Return the state with the best maps so far, and without the maps that gain no more."""
    if not level.keep_best:
        return replace(state, values=(*state.values, value.detach()))
    goal = value if distance is None else value - level.settings.points_weight * distance
    top = state.best_values[-1] if state.best_values else torch.full_like(goal, -torch.inf)
    better = goal > top
    best, top = where_items(better, state.u, state.best), where_items(better, goal, top)
    best_values = (*state.best_values, top)
    active = state.active & ~_stalled(best_values, level.settings.optimiser.tolerance)
    return replace(state, best=best, values=(*state.values, value), best_values=best_values, active=active)


def _stalled(best_values: tuple[Tensor, ...], tolerance: float) -> Tensor:
    """True for the maps whose last steps raised the best value by too small a share of the whole rise."""
    if len(best_values) <= _PATIENCE:
        return torch.zeros_like(best_values[0], dtype=torch.bool)
    return best_values[-1] - best_values[-1 - _PATIENCE] <= tolerance * (best_values[-1] - best_values[0])
