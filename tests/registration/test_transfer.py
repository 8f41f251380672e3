"""Between the grid of the images and that of the map."""

import math

import pytest
import torch
import torch.nn.functional as F
from pictures import bend, blobs

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import Transfer, thinned
from torchdeform.core.warp import warp
from torchdeform.registration import optimise as levels
from torchdeform.registration.deformable import register
from torchdeform.registration.settings import RegistrationSettings

MODES = {2: "bilinear", 3: "trilinear"}


@pytest.fixture(params=[(41, 36), (30, 20, 25), (12, 600)], ids=["2d", "3d", "long"])
def transfer(request):
    fine = Grid(request.param, spacing=(1.0, 0.7, 1.3)[: len(request.param)])
    return Transfer(fine, thinned(fine, 2.0), torch.zeros(1, dtype=torch.float64))


def test_up_is_linear_interpolation(transfer):
    field = torch.rand(2, 3, *transfer.coarse.shape, dtype=torch.float64)
    expected = F.interpolate(field, transfer.fine.shape, mode=MODES[transfer.fine.dim], align_corners=True)
    torch.testing.assert_close(transfer.up(field), expected, rtol=0, atol=1e-12)


def test_gather_is_the_transpose_per_volume(transfer):
    field = torch.rand(2, 3, *transfer.coarse.shape, dtype=torch.float64)
    force = torch.rand(2, 3, *transfer.fine.shape, dtype=torch.float64)
    work = (transfer.up(field) * force).sum() * transfer.fine.cell_volume
    torch.testing.assert_close((field * transfer.gather(force)).sum() * transfer.coarse.cell_volume, work)


def test_a_constant_force_stays_what_it_is_inside(transfer):
    inner = (..., *[slice(2, -2)] * transfer.fine.dim)
    found = transfer.gather(torch.ones(1, 1, *transfer.fine.shape, dtype=torch.float64))[inner]
    torch.testing.assert_close(found.mean(), torch.ones((), dtype=torch.float64), rtol=0.02, atol=0)


def test_only_large_levels_carry_a_coarser_map(monkeypatch):
    settings = RegistrationSettings(map_spacing=2.0)
    grid = Grid((40, 48))
    assert levels._map_grid(grid, settings) == grid
    monkeypatch.setattr(levels, "_LARGE", math.prod(grid.shape) - 1)
    assert levels._map_grid(grid, settings) == thinned(grid, 2.0)


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
