"""A map from its determinant and curl: consistent data to rounding, inconsistent data to the least-squares answer."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core.derivatives import CURL_PAIRS, curl, jacobian_determinant
from torchdeform.core.diagnostics import diagnose, smallest_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import max_voxels
from torchdeform.deformation.prescribed import NewtonSettings, PrescribedSolution, from_jacobian_and_curl
from torchdeform.errors import InputError
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.solvers.base import Status

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
UNTIMED = settings(deadline=None, max_examples=25)


def waves(grid: Grid, across: float = 1.8, turning: float = 1.0) -> Tensor:
    """Sines that are zero on the boundary of a plane grid, in its units: stretching, and turning to and fro."""
    x = grid.points(dtype=torch.float64) * (math.pi / grid.extent[0])
    one, two = (torch.cat([torch.sin(x[:, :1] * k), torch.sin(x[:, 1:] * k)], dim=1) for k in (1, 2))
    stretch = one * torch.sin(7 * x) * one.flip(1) ** 2 * torch.cos(2 * x.flip(1))
    turn = two.flip(1) * one.prod(dim=1, keepdim=True)
    turn[:, 1].neg_()
    return (across * stretch + turning * turn) * (grid.extent[0] / 100)


def turned_core(grid: Grid, angles: tuple[float, ...], inner: float = 0.1, outer: float = 0.9) -> Tensor:
    """The core of the box turned in the planes of `CURL_PAIRS`, one after the other, fading out from inner to outer."""
    middle = grid.along([e / 2 for e in grid.extent], torch.empty(0, dtype=torch.float64))
    start = grid.points(dtype=torch.float64) - middle
    moved, reach = start, min(grid.extent) / 2
    for (a, b), angle in zip(CURL_PAIRS[grid.dim], angles, strict=True):
        t = ((moved.norm(dim=1, keepdim=True) / reach - inner) / (outer - inner)).clamp(0, 1)
        turn = angle * (1 - t**3 * (10 - 15 * t + 6 * t**2))
        parts = list(moved.split(1, dim=1))
        parts[a], parts[b] = (
            turn.cos() * parts[a] - turn.sin() * parts[b],
            turn.sin() * parts[a] + turn.cos() * parts[b],
        )
        moved = torch.cat(parts, dim=1)
    return moved - start


def again(u: Tensor, grid: Grid, *, order: int = 2, **options) -> PrescribedSolution:
    return from_jacobian_and_curl(
        jacobian_determinant(u, grid, order), curl(u, grid, order), grid, order=order, **options
    )


def error(solution: PrescribedSolution, u: Tensor, grid: Grid) -> float:
    return float(max_voxels(solution.value - u, grid).max())


@pytest.mark.parametrize("order", [2, 4])
def test_a_plane_map_comes_back_to_rounding_in_few_steps(order):
    grid = Grid((101, 101))
    u = waves(grid)
    det = jacobian_determinant(u, grid)
    assert float(det.min()) < 0.58
    assert float(det.max()) > 1.75
    assert float(max_voxels(u, grid)) > 2.5
    solution = again(u, grid, order=order)
    assert solution.ok
    assert error(solution, u, grid) < 1e-8
    assert int(solution.steps) <= 8
    assert solution.residuals.shape == (int(solution.steps) + 1, 1)
    assert float(solution.residuals[0]) == pytest.approx(1.0)
    assert torch.equal(solution.residuals[-1], solution.residual)
    assert bool((solution.residuals.diff(dim=0) < 0).all())
    assert int(diagnose(solution.value, grid).folds) == 0
    assert torch.equal(solution.smallest, smallest_determinant(solution.value, grid))


def test_a_core_turned_by_60_degrees_about_all_three_axes_comes_back():
    grid = Grid((31, 31, 31))
    u = turned_core(grid, (math.pi / 3,) * 3)
    solution = again(u, grid)
    assert solution.ok
    assert error(solution, u, grid) < 1e-6
    assert int(solution.steps) <= 8


def test_convergence_is_quadratic():
    grid = Grid((41, 41))
    residuals = again(turned_core(grid, (1.0,)), grid).residuals.flatten()
    ratios = [float(b / a**2) for a, b in pairwise(residuals[1:]) if b > 1e-12]
    assert max(ratios) < 5


@st.composite
def maps(draw) -> tuple[Tensor, Grid, int]:
    """Random numbers at inner nodes, small enough not to fold."""
    dim, order = draw(st.sampled_from((2, 3))), draw(st.sampled_from((2, 4)))
    shape = draw(st.tuples(*[st.integers(order + 1, 9)] * dim))
    grid = Grid(shape, draw(st.tuples(*[st.floats(0.3, 3)] * dim)))
    seed = torch.manual_seed(draw(st.integers(0, 99)))
    u = 0.15 * (torch.rand(1, dim, *shape, dtype=torch.float64, generator=seed) - 0.5) * min(grid.spacing)
    return u.masked_fill(fixed_unknowns("dirichlet", grid), 0), grid, order


@given(maps())
@UNTIMED
def test_rough_maps_come_back_on_any_grid(made):
    u, grid, order = made
    solution = again(u, grid, order=order)
    assert solution.ok
    assert error(solution, u, grid) < 1e-8


def test_no_step_lets_a_determinant_vanish():
    grid = Grid((41, 41))
    u = waves(grid, across=3.6)
    assert float(jacobian_determinant(u, grid).min()) < 0.15
    for steps in range(1, 7):
        solution = again(u, grid, settings=NewtonSettings(max_steps=steps))
        assert float(jacobian_determinant(solution.value, grid).min()) > 0
    assert error(solution, u, grid) < 1e-8


def test_beyond_a_quarter_turn_it_needs_a_start_that_is_near():
    grid = Grid((33, 33))
    u = turned_core(grid, (math.radians(115),))
    far = again(u, grid, settings=NewtonSettings(max_steps=10, linear_steps=100))
    assert not far.ok
    near = again(u, grid, start=turned_core(grid, (math.radians(112),)), settings=NewtonSettings(linear_steps=3000))
    assert near.ok
    assert error(near, u, grid) < 1e-5


@pytest.mark.parametrize("order", [2, 4])
def test_boundaries_may_move(order):
    grid = Grid((15, 12, 9), (1.0, 0.8, 1.2))
    x = grid.points(dtype=torch.float64)
    matrix = torch.tensor([[1.2, -0.5, 0.1], [0.4, 0.9, 0.2], [0.0, -0.3, 1.1]]).double()
    u = torch.einsum("ka,bauvw->bkuvw", matrix, x) - x
    u = u + turned_core(grid, (0.2, 0.1, -0.2))
    solution = again(u, grid, order=order, boundary_displacement=u)
    assert solution.ok
    assert error(solution, u, grid) < 1e-8


def test_at_the_answer_there_is_nothing_to_do():
    grid = Grid((21, 21))
    u = waves(grid)
    there = again(u, grid, start=u)
    assert there.ok
    assert not there.steps.any()
    assert torch.equal(there.value, u.masked_fill(fixed_unknowns("dirichlet", grid), 0))
    still = again(torch.zeros_like(u), grid)
    assert still.ok
    assert not still.value.any()
    assert float(still.residual) == 0


def energy(u: Tensor, f: Tensor, g: Tensor, grid: Grid) -> Tensor:
    """∫ (det ∇φ − f)² + |curl φ − g|² by what is public, for autograd to differentiate."""
    left = torch.cat([jacobian_determinant(u, grid) - f, curl(u, grid) - g], dim=1)
    return (left**2 * grid.quadrature(dtype=u.dtype)).sum()


def noisy(grid: Grid, size: float) -> tuple[Tensor, Tensor]:
    u = turned_core(grid, (0.5,) if grid.dim == 2 else (0.5, 0.3, 0.2))
    f, g = jacobian_determinant(u, grid), curl(u, grid)
    return f * torch.exp(size * torch.randn_like(f)), g + size * torch.randn_like(g)


@pytest.mark.parametrize("grid", [Grid((17, 21), (1.0, 0.8)), Grid((9, 11, 10), (1.0, 0.8, 1.1))])
def test_inconsistent_data_give_the_least_squares_answer_and_say_so(grid):
    torch.manual_seed(0)
    f, g = noisy(grid, 0.1)
    solution = from_jacobian_and_curl(f, g, grid)
    assert solution.status == (Status.STAGNATED,)
    assert "least-squares" in solution.status[0].value
    assert 0.05 < float(solution.residual) < 1
    u = solution.value.clone().requires_grad_()
    (slope,) = torch.autograd.grad(energy(u, f, g, grid), u)
    inside = ~fixed_unknowns("dirichlet", grid)
    assert float((slope * inside).abs().max()) < 1e-8
    u = u.detach()
    move = 1e-3 * torch.randn_like(u) * inside
    assert float(energy(u + move, f, g, grid)) > float(energy(u, f, g, grid))


def test_a_volume_that_does_not_fit_is_inconsistent():
    grid = Grid((21, 21))
    f = torch.full((1, 1, 21, 21), 1.2, dtype=torch.float64)
    solution = from_jacobian_and_curl(f, torch.zeros_like(f), grid)
    assert solution.status == (Status.STAGNATED,)


def same(got: Tensor, want: Tensor, grid: Grid, steps: Tensor, size: float | None = None) -> None:
    """Assert equality to the rounding of some linear steps, each with a solve."""
    terms = int(steps.max()) * terms_of_a_solve(grid)
    assert_same_to_rounding(got, want, terms, condition_of_a_solve(grid), size)


def test_a_batch_equals_its_items_one_by_one():
    grid = Grid((21, 21))
    torch.manual_seed(0)
    f, g = (torch.cat(parts) for parts in zip(*[_data(u, grid) for u in _mixed(grid)], noisy(grid, 0.1), strict=True))
    together = from_jacobian_and_curl(f, g, grid)
    assert [s.name for s in together.status] == ["CONVERGED"] * 3 + ["STAGNATED"]
    assert len(set(together.steps.tolist())) > 2
    for i in range(len(f)):
        alone = from_jacobian_and_curl(f[i : i + 1], g[i : i + 1], grid)
        same(together.value[i : i + 1], alone.value, grid, alone.linear_steps)
        assert together.status[i] is alone.status[0]
        assert together.steps[i] == alone.steps[0]
        assert together.linear_steps[i] == alone.linear_steps[0]
        count = int(alone.steps) + 1
        same(together.residuals[:count, i], alone.residuals[:, 0], grid, alone.linear_steps, 1.0)
        same(together.residual[i : i + 1], alone.residual, grid, alone.linear_steps, 1.0)


def _mixed(grid: Grid) -> list[Tensor]:
    """An easy map, the identity and one near to folding."""
    return [waves(grid, 0.3, 0.2), waves(grid, 0.0, 0.0), waves(grid, 3.6, 2.0)]


def _data(u: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    return jacobian_determinant(u, grid), curl(u, grid)


def test_one_item_spreads_over_the_others():
    grid = Grid((9, 9))
    f, g = _data(torch.cat([waves(grid, 0.5, 0.2), waves(grid, 0.2, 0.4)]), grid)
    spread = from_jacobian_and_curl(f, g[:1], grid)
    want = from_jacobian_and_curl(f, g[:1].expand(2, -1, -1, -1), grid)
    same(spread.value, want.value, grid, want.linear_steps)


@pytest.mark.parametrize("device", DEVICES)
def test_float32_comes_back_to_its_rounding(device):
    grid = Grid((51, 51))
    u = waves(grid).float().to(device)
    solution = again(u, grid)
    assert solution.ok
    assert solution.value.dtype == torch.float32
    assert solution.value.device.type == device
    assert error(solution, u, grid) < 1e-3


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("grid", [Grid((6, 5), (0.7, 1.2)), Grid((4, 5, 4), (0.7, 1.2, 0.9))])
def test_derivatives_by_all_data_also_where_they_are_inconsistent(grid, noise):
    torch.manual_seed(0)
    u = 0.1 * torch.randn(2, grid.dim, *grid.shape, dtype=torch.float64)
    f, g = _data(u, grid)
    f = (f * torch.exp(noise * torch.randn_like(f))).requires_grad_()
    g = (g + noise * torch.randn_like(g)).requires_grad_()

    def solve(f, g, values):
        return from_jacobian_and_curl(f, g, grid, boundary_displacement=values).value

    assert from_jacobian_and_curl(f, g, grid, boundary_displacement=u).ok == (noise == 0)
    assert gradcheck(solve, (f, g, u.clone().requires_grad_()), fast_mode=True)


def test_a_derivative_does_not_change_the_value():
    grid = Grid((9, 9))
    f, g = _data(waves(grid, 0.5, 0.5), grid)
    plain = from_jacobian_and_curl(f, g, grid)
    watched = from_jacobian_and_curl(f, g.requires_grad_(), grid)
    assert watched.value.requires_grad
    same(plain.value, watched.value.detach(), grid, plain.linear_steps)
    with torch.no_grad():
        assert not from_jacobian_and_curl(f, g, grid).value.requires_grad


def test_what_stops_it_is_said():
    grid = Grid((21, 21))
    u = waves(grid)
    early = again(u, grid, settings=NewtonSettings(max_steps=2))
    assert early.status == (Status.MAX_STEPS,)
    assert early.steps.tolist() == [2]
    none = again(u, grid, settings=NewtonSettings(max_steps=0))
    assert none.status == (Status.MAX_STEPS,)
    assert not none.value.any()
    strict = again(u, grid, settings=NewtonSettings(rtol=1e-19))
    assert strict.status == (Status.ROUNDING,)
    loose = again(u, grid, settings=NewtonSettings(rtol=1e-2))
    assert loose.ok
    assert 1e-6 < float(loose.residual) < 1e-2


GRID = Grid((5, 6))
ONE = torch.ones(1, 1, 5, 6)
ZERO = torch.zeros(1, 1, 5, 6)


@pytest.mark.parametrize(
    ("f", "g", "options", "message"),
    [
        (ONE[0], ZERO, {}, r"from_jacobian_and_curl: f must have shape \(B, 1, 5, 6\)"),
        (ONE, ZERO.expand(1, 3, 5, 6), {}, "curl must have shape"),
        (ZERO, ZERO, {}, "f must be positive, got 0"),
        (ONE * math.inf, ZERO, {}, "f must be finite"),
        (ONE, ZERO.double(), {}, "all must be float32, or all float64"),
        (ONE.half(), ZERO.half(), {}, "32 or 64 bits"),
        (ONE, ZERO, {"order": 3}, "order must be one of 2, 4"),
        (ONE, ZERO, {"boundary_displacement": ZERO}, "boundary_displacement must have shape"),
        (ONE, ZERO, {"start": ZERO}, "start must have shape"),
        (ONE, ZERO, {"start": torch.zeros(2, 2, 5, 6)}, "start has 2 items, the data 1"),
        (ONE, ZERO, {"start": torch.full((1, 2, 5, 6), math.nan)}, "start must be finite"),
        (ONE.expand(2, -1, -1, -1), ZERO.expand(3, -1, -1, -1), {}, r"batch sizes must agree or be 1, got \[2, 3\]"),
    ],
)
def test_wrong_input_is_refused(f, g, options, message):
    with pytest.raises(InputError, match=message):
        from_jacobian_and_curl(f, g, GRID, **options)


@pytest.mark.parametrize("options", [{"rtol": -1.0}, {"max_steps": -1}, {"linear_steps": 0}])
def test_wrong_settings_are_refused(options):
    with pytest.raises(InputError, match="NewtonSettings"):
        replace(NewtonSettings(), **options)


def test_too_few_nodes_for_the_order_are_refused():
    f = torch.ones(1, 1, 4, 9)
    with pytest.raises(InputError, match="order 4 needs 5 nodes"):
        from_jacobian_and_curl(f, torch.zeros_like(f), Grid((4, 9)), order=4)
