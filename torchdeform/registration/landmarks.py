"""Landmarks as a term of the registration: how far pairs are apart, and the force that brings them together."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import inverse_matrix, jacobian_at, matrix_times, sample, voxels

# Newton's steps that bring the middle points to where they belong, at first and after every step of the maps.
_FIRST, _AGAIN = 30, 3

# Longest of these steps, in voxels.
_LEAP = 2.0


@dataclass(frozen=True)
class LandmarkForce:
    """What the landmarks ask for.

    Attributes:
        distance: mean squared distance of the pairs in squared units of spacing ``(B,)``.
        points: grid points ``(B, D, n)`` where the maps' domain is to be moved.
        residuals: the displacement wanted there, likewise.
        slopes: Jacobian of the map there ``(B, D, D, n)``; None where the points move with the domain, and those of
            the two maps of a pair, half a batch apart, move against each other.
        maps: how many maps of an item go equally far, those of the first for all items before those of the second.
    """

    distance: Tensor
    points: Tensor
    residuals: Tensor
    slopes: Tensor | None = None
    maps: int = 1

    def load(self, grid: Grid) -> Tensor:
        """Return minus the derivative of ``distance`` by a velocity of the domain, at every node ``(B, D, *S)``."""
        residuals = self.residuals if self.slopes is None else matrix_times(self.slopes.transpose(1, 2), self.residuals)
        return scatter_points(residuals * (2 / residuals.shape[2]), self.points, grid)

    def line_search(self, v: Tensor, grid: Grid) -> Tensor:
        """Return the multiple of the velocity v that brings the pairs nearest to each other, ``(B,)``."""
        moved = sample(v, self.points, grid)
        moved = moved - of_other_map(moved) if self.slopes is None else matrix_times(self.slopes, moved)
        work, square = (_joint((x * moved).flatten(1).sum(1), self.maps) for x in (self.residuals, moved))
        return work / square.clamp(min=torch.finfo(v.dtype).tiny)


class Landmarks(ABC):
    """Pairs of points on one grid."""

    @abstractmethod
    def evaluate(self, u: Tensor) -> LandmarkForce:
        """Return what the pairs ask of the maps u ``(B, D, *S)``."""


class ForwardLandmarks(Landmarks):
    """E = mean over the pairs of |φ(p) − q|².

    Args:
        fixed: p ``(B, D, n)`` in grid points.
        moving: q likewise.
        grid: the grid.
        belongs: 1 for the pairs that count in a map and 0 for the others ``(B, 1, n)``; all count when None.
        maps: of an item, which share its pairs; see `LandmarkForce`.
    """

    def __init__(self, fixed: Tensor, moving: Tensor, grid: Grid, belongs: Tensor | None = None, maps: int = 1) -> None:
        self.fixed, self.moving, self.grid = fixed, moving, grid
        self.belongs, self.maps = belongs, maps

    def evaluate(self, u: Tensor) -> LandmarkForce:
        residuals = self.moving - _mapped(u, self.fixed, self.grid)
        slopes = jacobian_at(u, self.fixed, self.grid)
        if self.belongs is not None:
            residuals, slopes = residuals * self.belongs, slopes * self.belongs.unsqueeze(1)
        return LandmarkForce(_joint(_mean_square(residuals), self.maps), self.fixed, residuals, slopes, self.maps)


class MidspaceLandmarks(Landmarks):
    """E = mean over the pairs of |φ_f⁻¹(p) − φ_m⁻¹(q)|², for the two maps of a pair, half a batch apart.

    Args:
        fixed: p ``(B, D, n)`` in grid points.
        moving: q likewise.
        grid: the grid.

    Notes:
        Newton's method begins where the points were found the time before: fast along one path of maps, right on any.
    """

    def __init__(self, fixed: Tensor, moving: Tensor, grid: Grid) -> None:
        self.ends, self.grid = torch.cat([fixed, moving]), grid
        self.points, self.steps = self.ends, _FIRST

    def evaluate(self, u: Tensor) -> LandmarkForce:
        for _ in range(self.steps):
            defect = self.ends - _mapped(u, self.points, self.grid)
            leap = matrix_times(inverse_matrix(jacobian_at(u, self.points, self.grid)), defect)
            self.points = self.points + leap * (_LEAP / voxels(leap, self.grid).clamp(min=_LEAP))
        self.steps = _AGAIN
        residuals = self.points - of_other_map(self.points)  # φ ∘ flow(v) takes to p what was at v from there
        return LandmarkForce(_mean_square(residuals), self.points, residuals, maps=2)


def of_other_map(values: Tensor) -> Tensor:
    """Return for each map of a pair what belongs to the other, half a batch away."""
    return values.roll(len(values) // 2, 0)


def _joint(sums: Tensor, maps: int) -> Tensor:
    """Return for each map ``(B,)`` the sum over the maps of its item."""
    return sums.unflatten(0, (maps, -1)).sum(0).repeat(maps)


def scatter_points(values: Tensor, points: Tensor, grid: Grid) -> Tensor:
    """Return Σ_i value_i N(p_i) at the nodes, the transpose of linear interpolation at the points.

    Args:
        values: ``(B, C, n)``.
        points: ``(B, D, n)`` in units of spacing; those outside Ω count where they are nearest to.
        grid: the grid.

    Returns:
        ``(B, C, *S)``. The order of summation is fixed, so the result is, too.
    """
    last = grid.along([n - 1 for n in grid.shape], points)
    place = (points / grid.along(grid.spacing, points)).clamp(min=0).minimum(last)
    first = place.floor().minimum(last - 1)
    share, first = place - first, first.long()
    strides = grid.along(grid.strides, first)
    nodes, parts = [], []
    for corner in product((0, 1), repeat=grid.dim):
        ends = grid.along(corner, first)
        nodes.append(((first + ends) * strides).sum(1))
        parts.append(values * torch.where(ends > 0, share, 1 - share).prod(1, keepdim=True))
    return _summed(torch.cat(parts, dim=2), torch.cat(nodes, dim=1), grid)


def _summed(parts: Tensor, nodes: Tensor, grid: Grid) -> Tensor:
    """Add up parts ``(B, C, m)`` at nodes ``(B, m)``: sorted first, so that no two runs differ in their rounding."""
    items, channels, _ = parts.shape
    size = math.prod(grid.shape)
    rows = torch.arange(items * channels, device=parts.device).view(items, channels, 1) * size
    index = (rows + nodes.unsqueeze(1)).flatten()
    place = {"size": (items * channels * size,), "device": parts.device}
    total = torch.sparse_coo_tensor(index.unsqueeze(0), parts.flatten(), **place, check_invariants=False)
    return total.coalesce().to_dense().view(items, channels, *grid.shape)


def _mapped(u: Tensor, points: Tensor, grid: Grid) -> Tensor:
    return points + sample(u, points, grid)


def _mean_square(residuals: Tensor) -> Tensor:
    return residuals.square().sum(1).mean(1)
