"""Labels and maps for tests of what becomes of a label."""

import math

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.regions import nearest


def smooth_map(grid: Grid, size: float, seed: int = 0) -> Tensor:
    """Random long waves that keep the faces of the box, in voxels."""
    made, x = torch.Generator().manual_seed(seed), grid.points(dtype=torch.float64)
    parts = []
    for k in range(grid.dim):
        wave = torch.zeros_like(x[:, :1])
        for _ in range(3):
            turns = 2 * math.pi * (torch.rand(grid.dim, generator=made, dtype=torch.float64) * 1.5)
            phase = sum(turns[a] * x[:, a : a + 1] / grid.extent[a] for a in range(grid.dim))
            wave = wave + torch.sin(phase + 6 * torch.rand(1, generator=made, dtype=torch.float64))
        parts.append(size * grid.spacing[k] * wave * torch.sin(math.pi * x[:, k : k + 1] / grid.extent[k]))
    return torch.cat(parts, dim=1)


def ball(grid: Grid, centre: tuple[float, ...], radius: float) -> Tensor:
    """Nodes within a radius in voxels of a centre given as shares of the box."""
    x = grid.points(dtype=torch.float64) / grid.along(grid.spacing, torch.empty(0, dtype=torch.float64))
    middle = torch.tensor([c * (n - 1) for c, n in zip(centre, grid.shape, strict=True)]).view(1, -1, *[1] * grid.dim)
    return (x - middle).norm(dim=1, keepdim=True) <= radius


def turned(grid: Grid, inside: Tensor, angle: float, u: Tensor, reach: int = 12) -> Tensor:
    """u, turned about the centre of a label in the plane of the last two axes, fading out over some voxels."""
    away = _from_centre(grid, inside)
    *_, a, b = away.split(1, dim=1)
    move = torch.zeros_like(u)
    move[:, -2:] = torch.cat([a, b], 1) * (math.cos(angle) - 1) + torch.cat([-b, a], 1) * math.sin(angle)
    return u + _fade(inside, reach) * move


def scaled(grid: Grid, inside: Tensor, factor: float, u: Tensor, reach: int = 10) -> Tensor:
    """u, shrunk or grown about the centre of a label, fading out over some voxels."""
    return u + _fade(inside, reach) * (factor - 1) * _from_centre(grid, inside)


def _from_centre(grid: Grid, inside: Tensor) -> Tensor:
    x = grid.points(dtype=torch.float64)
    return x - ((x * inside).flatten(2).sum(2) / inside.sum()).view(1, -1, *[1] * grid.dim)


def _fade(inside: Tensor, reach: int) -> Tensor:
    share = (1 - nearest(inside, reach)[0].clamp(max=reach**2).sqrt() / reach).double()
    return share**2 * (3 - 2 * share)
