"""Landmarks as a term of the registration: how far pairs are apart, and the force that brings them together."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import sample

# Newton's steps that bring the middle points to where they belong, at first and after every step of the maps.
_FIRST, _AGAIN = 30, 3

# Longest of these steps, in voxels.
_LEAP = 2.0


@dataclass(frozen=True)
class Pull:
    """What the landmarks ask for.

    Attributes:
        distance: mean squared distance of the pairs in squared units of spacing ``(B,)``.
        at: grid points ``(sides·B, D, n)`` where the maps' domain is to be moved.
        arrows: the displacement wanted there, likewise.
        slopes: Jacobian of the map there ``(B, n, D, D)``; None for two maps, whose points move with their domain.
    """

    distance: Tensor
    at: Tensor
    arrows: Tensor
    slopes: Tensor | None = None

    def load(self, grid: Grid) -> Tensor:
        """Return minus the derivative of ``distance`` by a velocity of the domain, at every node ``(.., D, *S)``."""
        arrows = self.arrows if self.slopes is None else _times(self.slopes.transpose(2, 3), self.arrows)
        return spread(arrows * (2 / arrows.shape[2]), self.at, grid)

    def reach(self, v: Tensor, grid: Grid) -> Tensor:
        """Return the multiple of the velocity v that brings the pairs nearest to each other, ``(B,)``."""
        moved, items = sample(v, self.at, grid), len(self.distance)
        moved = moved - moved.roll(items, 0) if self.slopes is None else _times(self.slopes, moved)
        work, square = ((x * moved).flatten(1).sum(1).view(-1, items).sum(0) for x in (self.arrows, moved))
        return work / square.clamp(min=torch.finfo(v.dtype).tiny)


class Landmarks(ABC):
    """Pairs of points on one grid."""

    @abstractmethod
    def look(self, u: Tensor) -> Pull:
        """Return what the pairs ask of the maps u ``(sides·B, D, *S)``."""


class ForwardLandmarks(Landmarks):
    """E = mean over the pairs of |φ(p) − q|².

    Args:
        fixed: p ``(B, D, n)`` in grid points.
        moving: q likewise.
        grid: the grid.
    """

    def __init__(self, fixed: Tensor, moving: Tensor, grid: Grid) -> None:
        self.fixed, self.moving, self.grid = fixed, moving, grid

    def look(self, u: Tensor) -> Pull:
        arrows = self.moving - _mapped(u, self.fixed, self.grid)
        return Pull(_mean_square(arrows), self.fixed, arrows, _slopes(u, self.fixed, self.grid))


class MiddleLandmarks(Landmarks):
    """E = mean over the pairs of |φ_f⁻¹(p) − φ_m⁻¹(q)|², for two maps that start in the space between.

    Args:
        fixed: p ``(B, D, n)`` in grid points.
        moving: q likewise.
        grid: the grid.

    Notes:
        Remembers where the points were and goes on from there: ask along one path of maps.
    """

    def __init__(self, fixed: Tensor, moving: Tensor, grid: Grid) -> None:
        self.ends, self.grid = torch.cat([fixed, moving]), grid
        self.at, self.steps = self.ends, _FIRST

    def look(self, u: Tensor) -> Pull:
        for _ in range(self.steps):
            defect = self.ends - _mapped(u, self.at, self.grid)
            leap = _solved(_slopes(u, self.at, self.grid), defect)
            voxels = (leap / leap.new_tensor(self.grid.spacing).view(1, -1, 1)).norm(dim=1, keepdim=True)
            self.at = self.at + leap * (_LEAP / voxels.clamp(min=_LEAP))
        self.steps, items = _AGAIN, len(self.ends) // 2
        arrows = self.at - self.at.roll(items, 0)  # φ ∘ flow(v) takes to p what was at v from there
        return Pull(_mean_square(arrows[:items]), self.at, arrows)


def make_landmarks(fixed: Tensor | None, moving: Tensor | None, grid: Grid, sides: int) -> Landmarks | None:
    """Return the landmarks for one map or two, None without points."""
    if fixed is None or moving is None:
        return None
    return (ForwardLandmarks if sides == 1 else MiddleLandmarks)(fixed, moving, grid)


def spread(values: Tensor, points: Tensor, grid: Grid) -> Tensor:
    """Return Σ_i value_i N(p_i) at the nodes, the transpose of linear interpolation at the points.

    Args:
        values: ``(B, C, n)``.
        points: ``(B, D, n)`` in units of spacing; those outside Ω count where they are nearest to.
        grid: the grid.

    Returns:
        ``(B, C, *S)``. The order of summation is fixed, so the result is, too.
    """
    last = points.new_tensor([n - 1 for n in grid.shape]).view(1, -1, 1)
    place = (points / points.new_tensor(grid.spacing).view(1, -1, 1)).clamp(min=0).minimum(last)
    first = place.floor().minimum(last - 1)
    share, first = place - first, first.long()
    strides = torch.tensor([math.prod(grid.shape[k + 1 :]) for k in range(grid.dim)], device=points.device)
    nodes, parts = [], []
    for corner in product((0, 1), repeat=grid.dim):
        ends = torch.tensor(corner, device=points.device).view(1, -1, 1)
        nodes.append(((first + ends) * strides.view(1, -1, 1)).sum(1))
        parts.append(values * torch.where(ends > 0, share, 1 - share).prod(1, keepdim=True))
    return _summed(torch.cat(parts, dim=2), torch.cat(nodes, dim=1), grid)


def _summed(parts: Tensor, nodes: Tensor, grid: Grid) -> Tensor:
    """Add up parts ``(B, C, m)`` at nodes ``(B, m)``: sorted first, so that no two runs differ in their rounding."""
    items, channels, _ = parts.shape
    size = math.prod(grid.shape)
    rows = torch.arange(items * channels, device=parts.device).view(items, channels, 1) * size
    index = (rows + nodes.unsqueeze(1)).flatten()
    total = torch.sparse_coo_tensor(
        index.unsqueeze(0), parts.flatten(), (items * channels * size,), check_invariants=False
    )
    return total.coalesce().to_dense().view(items, channels, *grid.shape)


def _mapped(u: Tensor, points: Tensor, grid: Grid) -> Tensor:
    return points + sample(u, points, grid)


def _slopes(u: Tensor, points: Tensor, grid: Grid) -> Tensor:
    """Return ∇φ at the points by differences over two voxels, ``(B, n, D, D)``."""
    columns = []
    for axis, h in enumerate(grid.spacing):
        step = torch.zeros_like(points)
        step[:, axis] = h
        difference = _mapped(u, points + step, grid) - _mapped(u, points - step, grid)
        columns.append(difference.transpose(1, 2) / (2 * h))
    return torch.stack(columns, dim=3)


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    return torch.einsum("bnij,bjn->bin", matrices, vectors)


def _solved(matrices: Tensor, vectors: Tensor) -> Tensor:
    return torch.linalg.solve_ex(matrices, vectors.transpose(1, 2).unsqueeze(3))[0].squeeze(3).transpose(1, 2)


def _mean_square(arrows: Tensor) -> Tensor:
    return arrows.square().sum(1).mean(1)
