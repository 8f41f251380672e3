"""Borders that glide: each side has a map of its own, and at the border they move alike across it.

A velocity that is smooth on either side and agrees across the border, not along it, has a sheet of curl there and no
divergence. The loop sees a batch of as many maps as there are sides, each compared on its side alone. Beyond its side a
map goes on smoothly, and in the end every node takes that of its own side.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from torchdeform.core.derivatives import derivative
from torchdeform.core.fold_free import keep_faces, lowest_determinant, neighbour_mean, repair_folds
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import restrict
from torchdeform.core.warp import sample
from torchdeform.errors import InputError
from torchdeform.metrics.base import Similarity, weighted
from torchdeform.registration.landmarks import ForwardLandmarks
from torchdeform.registration.objective import Coupling, Objective, SimilarityTerm, forward_objective
from torchdeform.registration.optimise import held_still, optimise_levels
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.result import Callback, LevelRecord
from torchdeform.registration.settings import RegistrationSettings

Given = TypeVar("Given")

# How often a border is smoothed to see its direction: some 2 voxels wide.
_ROUNDS = 4

# How often the values of a side are smoothed to go on beyond it: 2 voxels.
_BEYOND = 2

# Widths in voxels over which one map passes into the other where a narrower border folds, each so much wider.
_NARROWEST, _WIDER, _WIDEST, _TRIALS = 1.0, 1.25, 6.0, 16


def optimise_sides(
    problem: RegistrationProblem, settings: RegistrationSettings, start: Tensor | None, callback: Callback | None
) -> tuple[Tensor, tuple[LevelRecord, ...]]:
    """Return the displacements ``(B, D, *S)`` of maps that glide along the borders of labels, and how each level went.

    Args:
        problem: images on their scale, with a tissue of which some labels glide.
        settings: how.
        start: displacement ``(B, D, *S)`` to begin with; zero when None.
        callback: is shown every step.
    """
    items, sides = len(problem.fixed), _sides(problem)
    count = sides.shape[1]
    shown = None if callback is None else lambda step: callback(replace(step, similarity=step.similarity[:items]))
    several = _by_sides(problem, sides)
    begun = None if start is None else start.repeat(count, *[1] * (start.dim() - 1))
    u, records = optimise_levels(several, settings, begun, shown, _objective)
    u = _given(several.tissue).exact(u, problem.grid, settings.folds.min_determinant, problem.held, glides=True)
    joined = join(u.unflatten(0, (count, items)).transpose(0, 1), sides, problem.grid, settings.folds.min_determinant)
    return joined, tuple(replace(one, similarity=tuple(v[:items] for v in one.similarity)) for one in records)


def _sides(problem: RegistrationProblem) -> Tensor:
    """Return how much of each node belongs to each side ``(B or 1, K, *S)``: to labels that glide, and to the rest."""
    own = _given(problem.tissue).gliding
    return torch.cat([own, 1 - own.sum(1, keepdim=True).clamp(max=1)], dim=1)


def _given(part: Given | None) -> Given:
    if part is None:
        raise InputError("sliding needs labels: give annotations.tissue")
    return part


def _by_sides(problem: RegistrationProblem, sides: Tensor) -> RegistrationProblem:
    """Return the problem with a pair for each side and item, the items of a side after one another."""
    items, count = len(problem.fixed), sides.shape[1]

    def repeated(field: Tensor | None) -> Tensor | None:
        return None if field is None else field.repeat(count, *[1] * (field.dim() - 1))

    names = ("fixed", "moving", "moving_mask", "fixed_points", "moving_points")
    masks = sides.expand(items, *sides.shape[1:]).transpose(0, 1).flatten(0, 1).unsqueeze(1)
    tissue = _given(problem.tissue)
    # A label is there in the map of its own side alone: what it holds there does not reach beyond the border.
    shares = tissue.shares.expand(items, *tissue.shares.shape[1:]).repeat(count, *[1] * (tissue.shares.dim() - 1))
    tissue = replace(tissue, shares=shares * (masks > 0.5))
    return replace(
        problem,
        fixed_mask=weighted(masks, repeated(problem.fixed_mask)),
        tissue=tissue,
        sides=sides,
        channels=tuple(
            replace(one, fixed=repeated(one.fixed), moving=repeated(one.moving)) for one in problem.channels
        ),
        **{name: repeated(getattr(problem, name)) for name in names},
    )


def _objective(problem: RegistrationProblem, grid: Grid, settings: RegistrationSettings) -> Objective:
    """Return what is maximised where every side has a map: the similarity of all sides, each by its size."""
    alone = forward_objective(problem, grid, settings)
    sides = restrict(_given(problem.sides), problem.grid, grid)
    count = sides.shape[1]

    def joint(term: SimilarityTerm) -> SimilarityTerm:
        sizes = _given(term.fixed_mask).flatten(1).mean(1).unflatten(0, (count, -1))
        return replace(term, similarity=_OfAllSides(term.similarity, sizes))

    more = tuple(replace(one, similarity=joint(one.similarity)) for one in alone.more)
    points = alone.landmarks and _landmarks(problem, grid)
    gliding = Gliding(sides, grid, problem.held)
    return Objective(joint(alone.similarity), points, gliding, more, settings.points_weight)


def _landmarks(problem: RegistrationProblem, grid: Grid) -> ForwardLandmarks | None:
    """Return the landmarks, each of which counts in the map of the side that it lies on."""
    if problem.pairs is None:
        return None
    sides, (fixed, moving) = _given(problem.sides), problem.pairs
    count = sides.shape[1]
    shares = sample(sides, fixed[: len(fixed) // count], problem.grid)  # (B, K, n)
    belongs = one_hot(shares.argmax(1), count).to(fixed).permute(2, 0, 1).flatten(0, 1).unsqueeze(1)
    return ForwardLandmarks(fixed, moving, grid, belongs, count)


@dataclass(frozen=True)
class _OfAllSides(Similarity):
    """The similarity of an item's sides together, weighted by their sizes ``(K, B)``, for each of its maps."""

    alone: Similarity
    sizes: Tensor

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        value, slope = self.alone.evaluate(warped, mask)
        count = len(self.sizes)
        shares = self.sizes / self.sizes.sum(0)
        joint = (value.unflatten(0, (count, -1)) * shares).sum(0)
        # Of a side the slope is per node of that side.
        return joint.repeat(count), slope


class Gliding(Coupling):
    """The maps of an item's sides move alike across their common borders.

    Args:
        sides: how much of each node belongs to each side ``(B or 1, K, *S)``.
        grid: their grid.
        held: axes along which nothing is moved.
    """

    def __init__(self, sides: Tensor, grid: Grid, held: Sequence[int] = ()) -> None:
        self.grid, self.count = grid, sides.shape[1]
        own = (sides > 0.5).to(sides)
        self.own, self.reach = own.unsqueeze(2), smoothed(own, _BEYOND).unsqueeze(2)
        self.shares = smoothed(own)
        slopes = torch.stack([derivative(self.shares, grid, a) for a in range(grid.dim)], dim=2)  # (B, K, D, *S)
        slopes = held_still(slopes.flatten(0, 1), held).view_as(slopes)
        length = slopes.square().sum(2, keepdim=True).sqrt()
        self.normals = slopes / length.clamp(min=torch.finfo(sides.dtype).tiny)
        self.near = (8 * self.shares * (1 - self.shares)).clamp(max=1).unsqueeze(2)

    def velocity(self, v: Tensor) -> Tensor:
        """Return the velocities ``(K·B, D, *S)`` with one component across borders, the mean by shares."""
        apart = v.unflatten(0, (self.count, -1)).transpose(0, 1)  # (B, K, D, *S)
        mean = (apart * self.shares.unsqueeze(2)).sum(1, keepdim=True)
        across = ((mean - apart) * self.normals).sum(2, keepdim=True)
        return (apart + self.near * across * self.normals).transpose(0, 1).flatten(0, 1)

    def extended(self, u: Tensor) -> Tensor:
        """Return the displacements ``(K·B, D, *S)``, each going on beyond its side as it is there.

        What holds a map back beyond its side would else hold back its border.
        """
        apart = u.unflatten(0, (self.count, -1)).transpose(0, 1)  # (B, K, D, *S)
        flat = (apart * self.own).flatten(1, 2)
        near = smoothed(flat, _BEYOND).unflatten(1, (self.count, -1)) / self.reach.clamp(min=1e-6)
        beyond = (1 - self.own) * (10 * self.reach).clamp(max=1)
        return keep_faces(torch.lerp(apart, near, beyond.expand_as(apart)).transpose(0, 1).flatten(0, 1), u, self.grid)

    def counted(self, lowest: Tensor) -> Tensor:
        own = self.own.transpose(0, 1).expand(-1, len(lowest) // self.count, *lowest.shape[1:])
        return torch.where(own.flatten(0, 1) > 0, lowest, 1)

    def all(self, flags: Tensor) -> Tensor:
        return flags.unflatten(0, (self.count, -1)).all(0).repeat(self.count)

    def together(self, sizes: Tensor) -> Tensor:
        return sizes.unflatten(0, (self.count, -1)).amax(0).repeat(self.count)


def smoothed(field: Tensor, rounds: int = _ROUNDS) -> Tensor:
    """Return a field smoothed by so many means of neighbours."""
    for _ in range(rounds):
        field = neighbour_mean(field)
    return field


def join(apart: Tensor, sides: Tensor, grid: Grid, floor: float) -> Tensor:
    """Return the displacement that is each side's own on it, passing from one to the other as fast as folds allow.

    Args:
        apart: displacements of all sides ``(B, K, D, *S)`` in units of spacing, without folds.
        sides: how much of each node belongs to each side ``(B or 1, K, *S)``.
        grid: the grid.
        floor: smallest one-sided determinant that the border may have.

    Returns:
        ``(B, D, *S)`` without folds.
    """
    inside = smoothed((sides > 0.5).to(apart))
    slopes = [derivative(inside, grid, a) * grid.spacing[a] for a in range(grid.dim)]
    slope = torch.stack(slopes).square().sum(0).sqrt()
    distance = (inside - 0.5) / slope.clamp(min=1e-6)  # in voxels, near the border
    width = torch.full_like(apart[:, :1, 0], _NARROWEST)
    u = apart[:, 0]
    for _ in range(_TRIALS):
        shares = (0.5 + distance / width).clamp(0, 1)
        shares = shares / shares.sum(1, keepdim=True).clamp(min=1e-6)
        u = (apart * shares.unsqueeze(2)).sum(1)
        folded = lowest_determinant(u, grid) <= floor
        if not bool(folded.any()):
            break
        around = (2**grid.dim * smoothed(folded.to(u), 1)).clamp(max=1)
        width = (width * (1 + (_WIDER - 1) * around)).clamp(max=_WIDEST)
    return repair_folds(u, grid)
