"""Climbing the levels: forces ask for divergence and curl, least squares give the velocity, its flow moves the maps."""

import math
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter

import torch
from torch import Tensor

from torchdeform.core.derivatives import derivative
from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.fold_free import advance, keep, mended
from torchdeform.core.grid import Grid, limit_threads, per_item
from torchdeform.core.resampling import Transfer, coarsened, prolong, pyramid_grids
from torchdeform.core.warp import warp
from torchdeform.fem.fast_transform import TransformSolver
from torchdeform.fem.form import Form, Row, Term
from torchdeform.fem.operator import assemble_load
from torchdeform.fem.weights import Weights
from torchdeform.metrics.base import Similarity
from torchdeform.metrics.similarity import features, make_similarity
from torchdeform.registration.landmarks import Landmarks, Pull, make_landmarks
from torchdeform.registration.problem import Scene
from torchdeform.registration.result import Callback, LevelRecord, Progress
from torchdeform.registration.settings import RegistrationSettings


@dataclass(frozen=True)
class Comparison:
    """Images on one grid, ready to be compared again and again.

    Attributes:
        grid: their grid.
        images: what the maps warp ``(sides·B, C, *S)``: the moving image, or first the fixed and then the moving one.
        similarity: of the warped images.
        masks: their masks, warped likewise, or None.
        still: a mask that is not warped, or None.
        sides: maps of a pair, 1, or 2 where both images are warped.
    """

    grid: Grid
    images: Tensor
    similarity: Similarity
    masks: Tensor | None = None
    still: Tensor | None = None
    sides: int = 1

    def look(self, u: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the images warped by u ``(sides·B, D, *S)``, as they are when None, S per pair, and N ∂S/∂warped."""
        warped = self._masked if u is None else warp(self._masked, u, self.grid)
        del u  # where a coarser grid carries the map, nobody else holds it
        if self.masks is None:
            return warped, *self.similarity.evaluate(warped, self.still)
        warped, mask = warped.tensor_split([-1], dim=1)
        return warped, *self.similarity.evaluate(warped.contiguous(), self._weight(mask))

    @cached_property
    def _masked(self) -> Tensor:
        """The images and their masks, side by side: one sampling costs less than two."""
        return self.images if self.masks is None else torch.cat([self.images, self.masks], dim=1)

    def _weight(self, mask: Tensor) -> Tensor:
        """Return the product of the masks where the maps have taken them."""
        other = self.still if self.sides == 1 else _of_other_side(mask)
        return mask if other is None else mask * other


# Steps over which a level must have gained, see `RegistrationSettings.tolerance`.
_PATIENCE = 5


# The step falls to this share of itself over a level.
_LAST_STEP = 0.1


# Levels whose images have more nodes than this carry the map on the coarser grid of `RegistrationSettings.map_spacing`.
# Mouse brains (10^6 nodes) gain 0.003 Dice and half of the time by it; slices and hippocampi (7·10^4) would lose 0.01.
_LARGE = 2**17


# Weight of the divergence that opens up nearly folded places, against a force of 1 at its strongest.
_RESISTANCE = 3.0


@dataclass(frozen=True)
class _Level:
    """What stays the same during the steps of one level.

    Attributes:
        index: its number, 0 is the coarsest.
        comparison: of the images, on their grid.
        landmarks: pairs of points that pull, or None.
        metric: the least-squares operator.
        held: its weight w_0 of the velocity itself.
        controls: the form of the load: divergence and force.
        settings: the settings.
        transfer: between the grid of the images and that of the map, None where they are one.
    """

    index: int
    comparison: Comparison
    landmarks: Landmarks | None
    metric: TransformSolver
    held: float
    controls: Form
    settings: RegistrationSettings
    transfer: Transfer | None = None

    @property
    def grid(self) -> Grid:
        """The grid of the level's map."""
        return self.metric.grid

    @property
    def sides(self) -> int:
        """Maps of a pair."""
        return self.comparison.sides


def climb_levels(
    scene: Scene, settings: RegistrationSettings, start: Tensor | None, callback: Callback | None
) -> tuple[Tensor, tuple[LevelRecord, ...]]:
    """Return the maps that make the images of the scene most similar, and how each level went.

    Args:
        scene: images on their scale.
        settings: how.
        start: maps to begin with ``(sides·B, D, *S)`` in units of spacing, on any grid of the box; zero when None.
        callback: is shown every step.

    Returns:
        u ``(sides·B, D, *S)``: with ``symmetric`` first the maps to the fixed images, then those to the moving ones.
    """
    grids = pyramid_grids(scene.grid, len(settings.steps))
    sides = 2 if settings.symmetric else 1
    u = scene.fixed.new_zeros(sides * scene.fixed.shape[0], scene.grid.dim, *grids[0].shape)
    u, records = u if start is None else start.to(u), []
    for index, grid in enumerate(grids):
        level = _make_level(index, len(grids) - 1 - index, scene.on(grid), settings)
        with limit_threads(len(u), grid):
            u, record = _climb(level, mended(prolong(u, level.grid), level.grid), len(grids), callback)
        records.append(record)
    return mended(prolong(u, scene.grid), scene.grid), tuple(records)


def metric_weights(grid: Grid, settings: RegistrationSettings, below: int) -> Weights:
    """Return the weights of the metric on a level's grid that has so many finer levels below it."""
    held = settings.weight_div / (settings.length_at(below) * grid.cell_volume ** (1 / grid.dim)) ** 2
    return Weights(div=settings.weight_div, curl=settings.weight_curl, zero=held)


def steps_on(grid: Grid, steps: int, settings: RegistrationSettings) -> int:
    """Return the steps of a level of images on this grid: a coarser map is found map_spacing² times as soon."""
    return steps if _map_grid(grid, settings) == grid else math.ceil(steps / settings.map_spacing**2)


def _map_grid(grid: Grid, settings: RegistrationSettings) -> Grid:
    """Return the grid that carries the map of images on ``grid``."""
    return coarsened(grid, settings.map_spacing) if math.prod(grid.shape) > _LARGE else grid


def _make_level(index: int, below: int, scene: Scene, settings: RegistrationSettings) -> _Level:
    """Return the level of a scene that is on the level's grid, with so many finer levels below it."""
    grid, sides = _map_grid(scene.grid, settings), 2 if settings.symmetric else 1
    compare = compare_from_middle if settings.symmetric else compare_from_fixed
    pulls = settings.points_weight > 0
    weights = metric_weights(grid, settings, below)
    divergence = Row(_RESISTANCE, tuple(Term(1.0, k, k) for k in range(grid.dim)))
    force = tuple(Row(1.0, (Term(1.0, k, None),)) for k in range(grid.dim))
    return _Level(
        index=index,
        comparison=compare(scene, settings),
        landmarks=make_landmarks(scene.fixed_points, scene.moving_points, grid, sides) if pulls else None,
        metric=TransformSolver(grid, weights, "slip", dtype=scene.fixed.dtype, device=scene.fixed.device),
        held=float(weights.zero),
        controls=(divergence, *force),
        settings=settings,
        transfer=Transfer(scene.grid, grid, scene.fixed) if grid != scene.grid else None,
    )


def _climb(level: _Level, u: Tensor, levels: int, callback: Callback | None) -> tuple[Tensor, LevelRecord]:
    """Climb one level; every pair ends at the best maps it met."""
    start, shortened, settings = perf_counter(), 0, level.settings
    steps = steps_on(level.comparison.grid, settings.steps[level.index - levels], settings)
    carried, best, values, tops = torch.zeros_like(u), u, [], []
    top = u.new_full((len(u) // level.sides,), -torch.inf)
    active, lowest = torch.ones_like(top, dtype=torch.bool), one_sided_determinant(u, level.grid)
    for step in range(steps + 1):
        warped, value, gradient = level.comparison.look(level.transfer.up(u) if level.transfer else u)
        pull = level.landmarks.look(u) if level.landmarks else None
        goal = value if pull is None else value - settings.points_weight * pull.distance
        better = goal > top
        best, top = keep(better.repeat(level.sides), u, best), keep(better, goal, top)
        values.append(value)
        tops.append(top)
        if callback:
            callback(Progress(level.index, levels, step, steps, value, level.comparison.grid.shape))
        active &= ~_stalled(tops, settings.tolerance)
        if step == steps or not bool(active.any()):
            break
        divergence = (settings.soft_determinant / lowest - 1).clamp_(min=0)
        carried = _velocity(level, warped, gradient, divergence, pull) + settings.momentum * carried
        v = in_voxels(carried, level.grid)
        del warped, gradient  # before the next are made
        pace = step_length(settings, step, steps) / level.sides
        move = v * per_item((_pace(pace, v, pull, level) * active).repeat(level.sides), v)
        share = (settings.elasticity * active).repeat(level.sides)
        u, lowest, moved, short = advance((u, lowest), move, share, level.grid, settings.min_determinant, level.sides)
        active &= moved
        shortened += short
    return best, LevelRecord(level.comparison.grid.shape, tuple(values), shortened, perf_counter() - start)


def _stalled(tops: list[Tensor], tolerance: float) -> Tensor:
    """True for the pairs whose last steps raised the best similarity by too small a share of the whole rise."""
    if len(tops) <= _PATIENCE:
        return torch.zeros_like(tops[0], dtype=torch.bool)
    return tops[-1] - tops[-1 - _PATIENCE] <= tolerance * (tops[-1] - tops[0])


def _velocity(level: _Level, warped: Tensor, gradient: Tensor, divergence: Tensor, pull: Pull | None) -> Tensor:
    """Return the velocity that least squares find for the forces and the divergence, its longest move being one voxel.

    The force is scaled to 1 at its strongest, so the divergence needs no unit of similarity. That of the landmarks is
    smoothed by one power more, w_0 (M⁻¹K)⁻¹, which keeps its sum: what least squares alone answer to a point, a
    logarithm in 2D and 1/r in 3D, has a peak there. Two maps of a pair move against each other.
    """
    grid = level.grid
    force = image_force(gradient, warped, level.comparison.grid)
    force = level.transfer.gather(force) if level.transfer else force
    points = None if pull is None else pull.load(grid) * (level.settings.points_weight * math.prod(grid.shape))
    strongest = strongest_of(force) if points is None else strongest_of(force).maximum(strongest_of(points))
    scale = 1 / strongest.clamp(min=torch.finfo(force.dtype).tiny)
    load = assemble_load(level.controls, torch.cat([divergence, force * per_item(scale, force)], dim=1), grid)
    v = level.metric.solve(load, power=level.settings.power)
    if points is not None:
        load = points * per_item(scale * (grid.cell_volume * level.held), points)
        v = v + level.metric.solve(load, power=level.settings.power + 1)
    if level.sides == 2:
        v = v - v.roll(len(v) // 2, 0)
    return in_voxels(v, grid)


def in_voxels(v: Tensor, grid: Grid) -> Tensor:
    """Return the velocity ``(B, D, *S)`` on the scale on which its longest move is one voxel; 0 stays 0."""
    longest = strongest_of(v / grid.along(grid.spacing, v))
    return v / per_item(longest.clamp(min=torch.finfo(v.dtype).tiny), v)


def step_length(settings: RegistrationSettings, step: int, steps: int) -> float:
    """Return the longest move in voxels in this step of so many, from 0."""
    return settings.step_length * (1 - (1 - _LAST_STEP) * step / steps)


def image_force(gradient: Tensor, warped: Tensor, grid: Grid) -> Tensor:
    """Return Σ_c gradient_c ∇warped_c ``(B, D, *S)`` from N ∂S/∂warped and the warped image, both ``(B, C, *S)``."""
    return torch.cat([(gradient * derivative(warped, grid, a)).sum(1, keepdim=True) for a in range(grid.dim)], dim=1)


def strongest_of(force: Tensor) -> Tensor:
    """Return the largest |force| of each item ``(B,)``."""
    return force.square().sum(1).flatten(1).amax(1).sqrt()


def _pace(pace: float, v: Tensor, pull: Pull | None, level: _Level) -> Tensor:
    """Return how far to go in voxels ``(B,)``: no farther than where the landmarks are nearest to each other."""
    full = v.new_full((len(v) // level.sides,), pace)
    return full if pull is None else pull.reach(v, level.grid).clamp(min=_LAST_STEP * pace, max=pace)


def compare_from_fixed(scene: Scene, settings: RegistrationSettings) -> Comparison:
    """Return the comparison in which the moving image is warped."""
    fixed, moving = (features(settings.similarity, image) for image in (scene.fixed, scene.moving))
    similarity = make_similarity(settings.similarity, fixed, settings.window, grid=scene.grid)
    return Comparison(scene.grid, moving, similarity, scene.moving_mask, scene.fixed_mask)


def compare_from_middle(scene: Scene, settings: RegistrationSettings) -> Comparison:
    """Return the comparison in which both images are warped."""
    images = torch.cat([features(settings.similarity, image) for image in (scene.fixed, scene.moving)])
    masks = None
    if scene.fixed_mask is not None or scene.moving_mask is not None:
        ones = torch.ones_like(scene.fixed[:, :1])
        masks = torch.cat([ones if mask is None else mask for mask in (scene.fixed_mask, scene.moving_mask)])
    return Comparison(scene.grid, images, _MutualSimilarity(settings, scene.grid), masks, sides=2)


class _MutualSimilarity(Similarity):
    """(S(a, b) + S(b, a)) / 2 for images a and b of which both are warped.

    ``evaluate`` takes first all a, then all b, ``(2B, C, *S)``. It returns S per pair ``(B,)``, and the derivative of
    S(b, a) by a and of S(a, b) by b. Nothing changes when a and b change places, except the places.
    """

    def __init__(self, settings: RegistrationSettings, grid: Grid) -> None:
        self.settings, self.grid = settings, grid

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        others = _of_other_side(warped)
        similarity = make_similarity(self.settings.similarity, others, self.settings.window, grid=self.grid)
        value, slope = similarity.evaluate(warped, mask)
        return torch.stack(value.chunk(2)).mean(0), slope


def _of_other_side(both: Tensor) -> Tensor:
    return both.roll(len(both) // 2, 0)
