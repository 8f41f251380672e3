"""Averages of maps: copies, opposites, rotations about one point, weights, batches, derivatives, errors."""

import math

import pytest
import torch
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core.derivatives import CURL_PAIRS, curl, jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import max_voxels
from torchdeform.deformation.averages import average_maps
from torchdeform.deformation.prescribed import NewtonSettings
from torchdeform.errors import InputError
from torchdeform.solvers.base import Status

GRIDS = [Grid((41, 41)), Grid((17, 17, 17))]


def turned_core(grid: Grid, angle: float) -> Tensor:
    """The core of the box turned in the plane of the last two axes, fading out towards the boundary."""
    middle = grid.along([e / 2 for e in grid.extent], torch.empty(0, dtype=torch.float64))
    away = grid.points(dtype=torch.float64) - middle
    t = ((2 / min(grid.extent)) * away.norm(dim=1, keepdim=True) / 0.9 - 0.2).clamp(0, 1)
    turn = angle * (1 - t**3 * (10 - 15 * t + 6 * t**2))
    a, b = CURL_PAIRS[grid.dim][0]
    u = torch.zeros_like(away)
    u[:, a : a + 1] = (turn.cos() - 1) * away[:, a : a + 1] - turn.sin() * away[:, b : b + 1]
    u[:, b : b + 1] = turn.sin() * away[:, a : a + 1] + (turn.cos() - 1) * away[:, b : b + 1]
    return u


def wavy(grid: Grid, size: float = 0.8, phase: float = 0.0) -> Tensor:
    """Any smooth map, moving the boundary too."""
    x = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.empty(0, dtype=torch.float64))
    return size * torch.sin(3 * x.flip(1) + 2 * x + phase)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_average_of_copies_is_the_map(grid):
    u = wavy(grid)
    for copies in ([u], [u, u], [u] * 5):
        average = average_maps(copies, grid)
        assert average.ok
        torch.testing.assert_close(average.value, u, atol=1e-9, rtol=0)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_average_has_the_mean_curl_and_the_geometric_mean_of_determinants(grid):
    one, two = wavy(grid, 0.6), wavy(grid, 0.6, phase=2.0)
    average = average_maps([one, two], grid, weights=[1, 3])
    assert average.status == (Status.STAGNATED,)
    assert float(average.residual) < 0.1
    boundary = torch.ones_like(one[:, :1], dtype=torch.bool)
    boundary[(..., *[slice(1, -1)] * grid.dim)] = False
    torch.testing.assert_close(average.value * boundary, (0.25 * one + 0.75 * two) * boundary)
    f = (0.25 * jacobian_determinant(one, grid).log() + 0.75 * jacobian_determinant(two, grid).log()).exp()
    g = 0.25 * curl(one, grid) + 0.75 * curl(two, grid)
    mean = 0.25 * one + 0.75 * two
    off, plain = (
        float((jacobian_determinant(u, grid) - f).norm() ** 2 + (curl(u, grid) - g).norm() ** 2)
        for u in (average.value, mean)
    )
    assert off < plain


@pytest.mark.parametrize("grid", GRIDS)
def test_rotations_about_one_point_average_to_one_by_the_mean_angle(grid):
    average = average_maps([turned_core(grid, 0.1), turned_core(grid, 0.7)], grid)
    want = turned_core(grid, 0.4)
    off = float(max_voxels(average.value - want, grid))
    plain = float(max_voxels((turned_core(grid, 0.1) + turned_core(grid, 0.7)) / 2 - want, grid))
    assert off < 0.6 * plain
    middle = tuple(n // 2 for n in grid.shape)
    angle = math.asin(float(curl(average.value, grid)[0, 0][middle]) / 2)
    assert angle == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize("grid", GRIDS)
def test_opposite_rotations_average_to_the_identity(grid):
    turns = [turned_core(grid, 0.4), turned_core(grid, -0.4)]
    average = average_maps(turns, grid)
    mean = (turns[0] + turns[1]) / 2
    assert float(max_voxels(average.value, grid)) < 0.5 * float(max_voxels(mean, grid))


def test_a_weight_of_zero_leaves_a_map_out():
    grid = GRIDS[0]
    u = wavy(grid)
    average = average_maps([turned_core(grid, 0.3), u], grid, weights=[0.0, 2.0])
    torch.testing.assert_close(average.value, u, atol=1e-9, rtol=0)


def test_a_batch_equals_its_items_one_by_one():
    grid = Grid((17, 17))
    one = torch.cat([turned_core(grid, 0.2), wavy(grid), turned_core(grid, 0.8)])
    two = torch.cat([turned_core(grid, 0.5), wavy(grid), turned_core(grid, -0.5)])
    together = average_maps([one, two], grid, order=4)
    for i in range(3):
        alone = average_maps([one[i : i + 1], two[i : i + 1]], grid, order=4)
        terms = int(alone.linear_steps.max()) * terms_of_a_solve(grid)
        assert_same_to_rounding(together.value[i : i + 1], alone.value, terms, condition_of_a_solve(grid))
        assert together.status[i] is alone.status[0]


def test_derivatives_by_the_maps():
    grid = Grid((5, 6))
    one, two = (wavy(grid, 0.15, phase).requires_grad_() for phase in (0.0, 1.0))
    assert gradcheck(lambda *u: average_maps(u, grid, weights=[1, 2]).value, (one, two), fast_mode=True)


def test_settings_reach_the_solver():
    grid = GRIDS[0]
    maps = [turned_core(grid, 0.1), turned_core(grid, 0.7)]
    early = average_maps(maps, grid, settings=NewtonSettings(max_steps=1))
    assert early.status == (Status.MAX_STEPS,)


SMALL = Grid((4, 5))
STILL = torch.zeros(1, 2, 4, 5)
FOLDED = SMALL.points() * torch.tensor([-3.0, 0.0]).view(1, 2, 1, 1)


def test_small_determinants_may_be_lifted():
    grid = Grid((17, 17))
    u = wavy(grid, 5.0)
    assert float(jacobian_determinant(u, grid).min()) < 0
    with pytest.raises(InputError, match="folds"):
        average_maps([u], grid)
    average = average_maps([u, torch.zeros_like(u)], grid, least=0.1)
    assert bool(average.value.isfinite().all())
    mild = wavy(grid)
    assert torch.equal(average_maps([mild], grid, least=0.1).value, average_maps([mild], grid).value)


@pytest.mark.parametrize(
    ("maps", "weights", "message"),
    [
        ([], None, "got 0 maps and 0 weights"),
        ([STILL, STILL], [1.0], "got 2 maps and 1 weights"),
        ([STILL], [-1.0], "weights must be finite, not negative"),
        ([STILL], [0.0], "not all zero"),
        ([STILL], [math.nan], "weights must be finite"),
        ([STILL, FOLDED], None, "map 1 folds, its determinant falls to"),
        ([torch.zeros(1, 3, 4, 5)], None, "must have shape"),
    ],
)
def test_wrong_input_is_refused(maps, weights, message):
    with pytest.raises(InputError, match=message):
        average_maps(maps, SMALL, weights)
