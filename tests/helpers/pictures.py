"""Images and maps with known answers, for tests of registration."""

import math

import torch
from torch import Tensor

from torchdeform.core.flow import integrate
from torchdeform.core.grid import Grid


def blobs(shape: tuple[int, ...], seed: int = 0, items: int = 1) -> Tensor:
    """A smooth image with structure everywhere."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(items, 1, *shape, generator=generator)
    grid = Grid(shape)
    for axis in grid.axes:
        k = torch.fft.rfftfreq(shape[axis - 2]).view([-1 if a == axis else 1 for a in range(2 + grid.dim)])
        noise = torch.fft.irfft(
            torch.fft.rfft(noise, dim=axis) * torch.exp(-((k * 18) ** 2)), shape[axis - 2], dim=axis
        )
    return (noise - noise.mean()) / noise.std() + 3


def bend(grid: Grid, amplitude: float) -> Tensor:
    """A flow that keeps the boundary, its velocity ``amplitude`` voxels at most."""
    x = grid.points()
    phases = [math.pi * x[:, k] / side for k, side in enumerate(grid.extent)]
    wave = torch.stack(
        [torch.sin(phases[k]) * torch.cos(2 * phases[(k + 1) % grid.dim] + k) for k in range(grid.dim)], dim=1
    )
    return integrate(wave * amplitude * grid.along(grid.spacing, x), grid)


def disc(shape: tuple[int, ...], centre: tuple[float, ...], radius: float) -> Tensor:
    """1 inside a ball, 0 outside."""
    x = Grid(shape).points()
    return ((x - Grid(shape).along(centre, x)).square().sum(1, keepdim=True) < radius**2).float()


def swell(grid: Grid, largest: float) -> Tensor:
    """Return u of ``largest`` voxels in the middle, along a diagonal, 0 on the faces."""
    unit = grid.points() / grid.along(grid.extent, grid.points())
    wave = torch.sin(math.pi * unit).prod(dim=1, keepdim=True)
    direction = [(-1) ** k / math.sqrt(grid.dim) for k in range(grid.dim)]
    return largest * min(grid.spacing) * grid.along(direction, wave) * wave
