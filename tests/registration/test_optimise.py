"""The loop over levels: which carry a coarser map, and that it finds the motion all the same."""

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from nested_settings import settings_of
from pictures import bend, blobs, disc
from tissues import kabsch_residual, turning_bars

from torchdeform.core import grid as core_grid
from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.flow import integrate
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import coarsened
from torchdeform.core.warp import warp
from torchdeform.registration import optimise as levels
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register
from torchdeform.registration.objective import Objective, forward_objective
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.tissue import Tissue
from torchdeform.registration.velocity import VelocityMetric


def test_only_a_large_finest_level_carries_a_coarser_map(monkeypatch):
    settings = settings_of(map_spacing=2.0)
    grid = Grid((40, 48))
    assert levels._map_grid(grid, settings, 0) == grid
    monkeypatch.setattr(levels, "_LARGE", math.prod(grid.shape) - 1)
    assert levels._map_grid(grid, settings, 0) == coarsened(grid, 2.0)
    assert levels._map_grid(grid, settings, 1) == grid


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("shape", [(80, 96), (32, 40, 36)])
def test_a_coarser_map_finds_the_motion_without_folds(monkeypatch, shape, symmetric):
    monkeypatch.setattr(levels, "_LARGE", 4096)
    grid = Grid(shape)
    truth, moving = bend(grid, 3.0), blobs(shape)
    settings = settings_of(steps=(60, 60, 40), window=7, symmetric=symmetric)
    result = register(warp(moving, truth, grid), moving, settings)
    inside = (..., *[slice(5, -5)] * grid.dim)
    before, after = (d.square().sum(1).sqrt()[inside].mean() for d in (truth, result.displacement - truth))
    assert after < 0.3 * before
    assert result.diagnosis.folds.item() == 0
    assert result.displacement.shape[2:] == shape


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(40, 33), (24, 21, 18)])
def test_slabs_of_a_coarser_map_are_what_its_whole_displacement_gives(monkeypatch, shape, masked):
    monkeypatch.setattr(levels, "_LARGE", 0)
    monkeypatch.setattr(core_grid, "_SLAB_NODES", {"cpu": 1})
    grid = Grid(shape)
    fixed, moving, mask = (torch.rand(2, 1, *shape, dtype=torch.float64) for _ in range(3))
    problem = RegistrationProblem(grid, fixed, moving, None, mask if masked else None)
    level = levels.make_level(problem, settings_of(measure="lncc"), forward_objective, 0, 1)
    assert level.transfer is not None
    u, term = torch.randn_like(level.zero), level.objective.similarity
    whole = F.interpolate(u, shape, mode={2: "bilinear", 3: "trilinear"}[len(shape)], align_corners=True)
    with torch.no_grad():
        for found, expected in zip(term.evaluate(u, level.transfer), term.evaluate(whole), strict=True):
            torch.testing.assert_close(found, expected)
        both = term.on_common_voxels([u, level.zero], level.transfer)
        torch.testing.assert_close(both, term.on_common_voxels([whole, torch.zeros_like(whole)]))


def level_of(grid: Grid, flow: str = "midpoint", **settings) -> levels.Level:
    chosen = settings_of(flow=flow, elasticity=0.0, **settings)
    like = torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    metric = VelocityMetric.of(grid, chosen.metric, chosen.solver, like)
    return levels.Level(Objective(None), metric, chosen, steps=1)


def state_of(u: torch.Tensor, grid: Grid) -> levels.State:
    active = torch.ones(len(u), dtype=torch.bool)
    return levels.State(u, one_sided_determinant(u, grid), torch.zeros_like(u), active, u)


@pytest.mark.parametrize("method", ["euler", "midpoint", "rk4", "dopri5", "squaring"])
def test_a_step_follows_the_flow_of_its_velocity(method):
    grid = Grid((12, 14), (1.0, 0.5))
    v = 0.3 * torch.rand(1, 2, *grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    share, moved, lowest = levels.fold_free_step(level_of(grid, method), state_of(torch.zeros_like(v), grid), v)
    assert share.tolist() == [1.0]
    torch.testing.assert_close(moved, integrate(v, grid, steps=1, method=method))
    torch.testing.assert_close(lowest, one_sided_determinant(moved, grid))


def test_a_step_that_would_fold_is_shortened_and_others_are_not():
    grid = Grid((20, 24))
    v = torch.cat([bend(grid, 1.0), 40 * bend(grid, 1.0)])
    u = torch.zeros_like(v)
    share, _, lowest = levels.fold_free_step(level_of(grid), state_of(u, grid), v)
    assert share[0] == 1 > share[1]
    assert (lowest.flatten(1).amin(1) >= 0.03).all()
    nan = levels.fold_free_step(level_of(grid), state_of(u, grid), v * torch.nan)
    assert nan[0].tolist() == [0.0, 0.0]
    assert torch.equal(nan[1], u)


def test_every_registration_integrates_by_torchdiffeq_and_solves_as_it_is_told(monkeypatch):
    """Of each piece of the frame, the calls in a run that asks for it."""
    import torchdiffeq

    calls = []
    real = torchdiffeq.odeint
    monkeypatch.setattr(torchdiffeq, "odeint", lambda *a, **k: calls.append(k["method"]) or real(*a, **k))
    shape = (32, 36)
    fixed, moving = blobs(shape, 1), blobs(shape, 2)
    plain = register(fixed, moving, settings_of(steps=(4, 3)))
    assert calls
    assert set(calls) == {"midpoint"}
    calls.clear()
    frame = register(fixed, moving, settings_of(steps=(4, 3), flow="rk4", flow__steps=4, solver="assembled"))
    assert set(calls) == {"rk4"}
    assert (frame.displacement - plain.displacement).square().sum(1).sqrt().mean() < 0.05


def tissue_of(labels: torch.Tensor, kind: str) -> Tissue:
    return Tissue.of(labels, settings_of(tissues={1: kind}), torch.zeros(1, dtype=torch.float64))


def test_a_step_leaves_rigid_what_is_rigid():
    grid = Grid((40, 44))
    labels, v = disc(grid.shape, (20, 22), 8), bend(grid, 2.0).double()
    tissue = tissue_of(labels, "rigid")
    level, zero = level_of(grid), torch.zeros_like(v)
    free = levels.fold_free_step(level, state_of(zero, grid), v)
    held = levels.fold_free_step(replace(level, tissue=tissue, hold=tissue.hold(grid)), state_of(zero, grid), v)
    residuals = [kabsch_residual(found[1][0], labels[0, 0] > 0) for found in (free, held)]
    assert residuals[1] < 1e-6 < 0.1 < residuals[0]
    torch.testing.assert_close(held[2], one_sided_determinant(held[1], grid))
    assert held[2].min() > 0.03


def test_what_has_a_price_is_not_smoothed():
    """The elastic smoothing of a map would take off what a tissue has turned."""
    grid = Grid((40, 44))
    labels, u = disc(grid.shape, (20, 22), 10), bend(grid, 1.0).double()
    level = level_of(grid)
    level = replace(level, settings=settings_of(elasticity=0.5), tissue=tissue_of(labels, "stiff"))
    _, moved, _ = levels.fold_free_step(level, state_of(u, grid), torch.zeros_like(u))
    away = (moved - u).abs().amax(1, keepdim=True)
    assert away[labels > 0].max() < 1e-6 < 1e-4 < away[labels == 0].max()


def test_a_level_has_the_tissue_of_its_map(monkeypatch):
    _, moving, labels = turning_bars()
    settings = settings_of(tissues={1: "rigid", 2: "stiff"})
    tissue = Tissue.of(labels, settings, moving)
    problem = RegistrationProblem(Grid((64, 64)), moving, moving, tissue=tissue)
    monkeypatch.setattr(levels, "_LARGE", 1000)
    level = levels.make_level(problem, settings.decided(), forward_objective, 0, 1)
    assert level.grid != problem.grid
    assert level.tissue.shares.shape[2:] == level.grid.shape
    assert level.hold is not None
    assert levels.make_level(replace(problem, tissue=None), settings.decided(), forward_objective, 0, 1).hold is None


def test_large_levels_keep_rigid_what_is_rigid(monkeypatch):
    monkeypatch.setattr(levels, "_LARGE", 2000)
    fixed, moving, labels = turning_bars()
    settings = settings_of(tissues={1: "rigid", 2: "rigid"}, steps=(20, 15, 10), window=7)
    result = register(fixed, moving, settings, annotations=Annotations(tissue=labels))
    assert max(kabsch_residual(result.displacement[0], labels[0, 0] == number) for number in (1, 2)) < 0.05
    assert result.diagnosis.folds.item() == 0
