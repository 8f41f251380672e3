"""The loop over levels: which carry a coarser map, and that it finds the motion all the same."""

import math

import pytest
from pictures import bend, blobs

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import coarsened
from torchdeform.core.warp import warp
from torchdeform.registration import optimise as levels
from torchdeform.registration.deformable import register
from torchdeform.registration.settings import RegistrationSettings


def test_only_large_levels_carry_a_coarser_map(monkeypatch):
    settings = RegistrationSettings(map_spacing=2.0)
    grid = Grid((40, 48))
    assert levels._map_grid(grid, settings) == grid
    monkeypatch.setattr(levels, "_LARGE", math.prod(grid.shape) - 1)
    assert levels._map_grid(grid, settings) == coarsened(grid, 2.0)


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("shape", [(80, 96), (32, 40, 36)])
def test_a_coarser_map_finds_the_motion_without_folds(monkeypatch, shape, symmetric):
    monkeypatch.setattr(levels, "_LARGE", 100)
    grid = Grid(shape)
    truth, moving = bend(grid, 3.0), blobs(shape)
    settings = RegistrationSettings(steps=(60, 60, 40), window=7, symmetric=symmetric)
    result = register(warp(moving, truth, grid), moving, settings)
    inside = (..., *[slice(5, -5)] * grid.dim)
    before, after = (d.square().sum(1).sqrt()[inside].mean() for d in (truth, result.displacement - truth))
    assert after < 0.3 * before
    assert result.diagnosis.folds.item() == 0
    assert result.displacement.shape[2:] == shape
