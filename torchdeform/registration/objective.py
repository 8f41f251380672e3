"""What is maximised on a level: similarity of the images, what is added to it, landmarks; which maps move together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial, reduce
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import Transfer
from torchdeform.core.warp import warp, warp_by_rows
from torchdeform.metrics.base import Similarity, weighted
from torchdeform.metrics.similarity import features, make_similarity
from torchdeform.registration.landmarks import ForwardLandmarks, Landmarks
from torchdeform.registration.problem import Channels, RegistrationProblem
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.velocity import image_force


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

    def evaluate(self, u: Tensor | None = None, transfer: Transfer | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the images warped by u ``(B, D, *S)``, as they are when None, S of each, and N ∂S/∂warped.

        With ``transfer`` the displacement is on a coarser grid.
        """
        warped = self._masked if u is None else self._warped(self._masked, u, transfer)
        if self.masks is None:
            return warped, *self.similarity.evaluate(warped, self.fixed_mask)
        warped, mask = warped.tensor_split([-1], dim=1)
        return warped, *self.similarity.evaluate(warped.contiguous(), weighted(mask, self.fixed_mask))

    def _warped(self, images: Tensor, u: Tensor, transfer: Transfer | None) -> Tensor:
        return warp(images, u, self.grid) if transfer is None else warp_by_rows(images, transfer.up(u), self.grid)

    def on_common_voxels(self, maps: Sequence[Tensor], transfer: Transfer | None = None) -> list[Tensor]:
        """Return S of the images warped by each of the maps ``(B, D, *S)``, over the voxels that all of them see."""
        if self.masks is None:
            found = (self._warped(self.images, u, transfer) for u in maps)
            return [self.similarity.evaluate(warped, self.fixed_mask)[0] for warped in found]
        pairs = [self._warped(self._masked, u, transfer).tensor_split([-1], dim=1) for u in maps]
        mask = reduce(lambda mask, pair: weighted(pair[1], mask), pairs, self.fixed_mask)
        return [self.similarity.evaluate(warped.contiguous(), mask)[0] for warped, _ in pairs]

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
        warped, value, slope = term.evaluate(u, self.transfer)
        force = partial(image_force, slope * (self.weight / warped.shape[1]), warped, term.grid, stencil)
        return self.weight * value, force() if self.transfer is None else self.transfer.gather(force)

    def on_common_voxels(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """Return what is added for each of the maps, over the voxels that all of them see."""
        return [self.weight * value for value in self.similarity.on_common_voxels(maps, self.transfer)]


@dataclass(frozen=True)
class Objective:
    """What is maximised on the grid of one level, S + Σ wₖ Sₖ − points_weight · E, and which maps move together.

    Attributes:
        similarity: S of the images, on their grid.
        landmarks: E of the pairs of points, on the grid of the map; None without.
        points_weight: of E; the landmarks themselves have that of the settings.
        coupling: of the maps.
        more: wₖ Sₖ.
    """

    similarity: Any
    landmarks: Landmarks | None = None
    coupling: Coupling = _FREE
    more: tuple[Addition, ...] = ()
    points_weight: float = 0.0

    def on_common_voxels(self, maps: Sequence[Tensor], transfer: Transfer | None) -> list[Tensor]:
        """Return S + Σ wₖ Sₖ of the maps, taken to the grid of the images, over what all of them see."""
        values = self.similarity.on_common_voxels(maps, transfer)
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


def forward_objective(problem: RegistrationProblem, grid: Grid, settings: RegistrationSettings) -> Objective:
    """Return what is maximised where the moving image is warped onto the fixed one, the map being on ``grid``."""
    pairs = problem.pairs if settings.points_weight > 0 else None
    channels = compared(problem, settings)
    first, *others = [forward_similarity(problem, one, settings) for one in channels]
    landmarks, more = pairs and ForwardLandmarks(*pairs, grid), additions(others, channels[1:], grid)
    return Objective(first, landmarks, more=more, points_weight=settings.points_weight)
