"""A map from its divergence and curl: the paper's accuracy and better, any field to solver precision, derivatives."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core.derivatives import curl, divergence, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.deformation.reconstruction import Reconstruction, reconstruct
from torchdeform.errors import InputError
from torchdeform.fem import solve_div_curl

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
UNTIMED = settings(deadline=None, max_examples=25)


def adapted_to_a_sphere(nodes: int) -> tuple[Grid, Tensor]:
    """The unit cube with nodes drawn towards a sphere of radius 1/4, in closed form: u = d(r) x/r about the middle."""
    grid = Grid((nodes,) * 3, (1 / (nodes - 1),) * 3)
    x = grid.points(dtype=torch.float64) - 0.5
    r = x.norm(dim=1, keepdim=True).clamp(min=1e-12)

    def pull(s: Tensor) -> Tensor:
        return -0.056 * s * torch.exp(-(s**2) / 2)

    return grid, x / r * (pull((r - 0.25) / 0.0875) + pull((r + 0.25) / 0.0875))  # odd in r, so smooth at the middle


def again(u: Tensor, grid: Grid, *, order: int = 2, **options) -> Reconstruction:
    return reconstruct(divergence(u, grid, order), curl(u, grid, order), grid, u, order=order, **options)


def error(solution: Reconstruction, u: Tensor) -> float:
    """The largest distance over the nodes, as the paper defines the error."""
    return float((solution.value - u).norm(dim=1).max())


def test_the_map_of_the_second_example_and_better_than_the_paper():
    grid, u = adapted_to_a_sphere(40)
    det = jacobian_determinant(u, grid)
    assert float(det.min()) < 0.38
    assert float(det.max()) > 1.8
    assert float(u.norm(dim=1).max()) == pytest.approx(0.034, abs=5e-4)
    second, fourth, refined = (again(u, grid), again(u, grid, order=4), again(u, grid, refine=True))
    assert second.ok
    assert fourth.ok
    assert refined.ok
    assert error(second, u) < 1.6e-3
    assert error(fourth, u) < 6e-4
    assert error(refined, u) < 1e-8
    assert error(again(u, grid, order=4, refine=True), u) < 1e-8
    finer, v = adapted_to_a_sphere(80)
    slope = math.log(error(second, u) / error(again(v, finer), v)) / math.log(79 / 39)
    assert slope == pytest.approx(2.0, abs=0.1)


def same(got: Tensor, want: Tensor, grid: Grid) -> None:
    """Assert equality to the rounding of a direct solve and the steps that refine it."""
    assert_same_to_rounding(got, want, 10 * terms_of_a_solve(grid), condition_of_a_solve(grid))


@st.composite
def fields(draw) -> tuple[Tensor, Grid, int]:
    """Random numbers at the nodes: nothing could be rougher."""
    dim, order = draw(st.sampled_from((2, 3))), draw(st.sampled_from((2, 4)))
    shape = draw(st.tuples(*[st.integers(order + 1, 9)] * dim))
    grid = Grid(shape, draw(st.tuples(*[st.floats(0.2, 5)] * dim)))
    seed = torch.manual_seed(draw(st.integers(0, 99)))
    return torch.randn(2, dim, *shape, dtype=torch.float64, generator=seed), grid, order


@given(fields())
@UNTIMED
def test_refined_any_field_comes_back(made):
    u, grid, order = made
    solution = again(u, grid, order=order, refine=True)
    assert solution.ok
    torch.testing.assert_close(solution.value, u, atol=1e-7, rtol=0)
    assert bool((solution.misfit < 1e-7).all())


def test_unrefined_it_is_the_finite_element_solution():
    grid = Grid((9, 7), (0.5, 1.0))
    u = torch.randn(1, 2, 9, 7, dtype=torch.float64)
    div, rotation = divergence(u, grid), curl(u, grid)
    elements = solve_div_curl(div, rotation, grid, "dirichlet", boundary_values=u)
    solution = reconstruct(div, rotation, grid, boundary_displacement=u)
    same(solution.value, elements.value, grid)
    assert not solution.steps.any()
    assert solution.trajectory is None
    left = torch.cat([div - divergence(solution.value, grid), rotation - curl(solution.value, grid)], dim=1)
    whole, weights = torch.cat([div, rotation], dim=1), grid.quadrature(dtype=torch.float64)
    misfit = ((left**2 * weights).sum() / (whole**2 * weights).sum()).sqrt()
    torch.testing.assert_close(solution.misfit, misfit.view(1))


def test_the_divergence_is_that_of_the_displacement():
    # φ = 2 x has div φ = 2 D, and u = x has div u = D.
    grid = Grid((6, 5, 7), (0.5, 1.0, 0.8))
    x = grid.points(dtype=torch.float64)
    div, rotation = torch.full_like(x[:, :1], 3.0), torch.zeros_like(x)
    torch.testing.assert_close(reconstruct(div, rotation, grid, x).value, x, atol=1e-12, rtol=0)


@pytest.mark.parametrize("refine", [False, True])
def test_time_steps_lead_from_the_identity_to_the_map_without_folds(refine):
    grid, u = adapted_to_a_sphere(24)
    solution = again(u, grid, refine=refine, steps=10)
    assert solution.trajectory.shape == (10, *u.shape)
    assert torch.equal(solution.trajectory[-1], solution.value)
    for step, middle in enumerate(solution.trajectory, start=1):
        part = step / 10
        alone = reconstruct(part * divergence(u, grid), part * curl(u, grid), grid, part * u, refine=refine)
        torch.testing.assert_close(middle, alone.value, atol=1e-9, rtol=0)
        assert int(diagnose(middle, grid).folds) == 0


@pytest.mark.parametrize("refine", [False, True])
def test_a_batch_equals_its_items_one_by_one(refine):
    grid = Grid((8, 9), (1.0, 0.6))
    u = torch.randn(3, 2, 8, 9, dtype=torch.float64) * torch.tensor([1.0, 0.0, 1e-6]).double().view(3, 1, 1, 1)
    together = again(u, grid, refine=refine, steps=2)
    for i in range(3):
        alone = again(u[i : i + 1], grid, refine=refine, steps=2)
        same(together.value[i : i + 1], alone.value, grid)
        same(together.trajectory[:, i : i + 1], alone.trajectory, grid)
        torch.testing.assert_close(together.misfit[i : i + 1], alone.misfit, rtol=1e-10, atol=1e-12)
        assert together.steps[i] == alone.steps[0]
        assert together.status[i] is alone.status[0]
    assert float(together.misfit[1]) == 0


def test_one_item_spreads_over_the_others():
    grid = Grid((6, 5))
    u = torch.randn(2, 2, 6, 5, dtype=torch.float64)
    div, rotation = divergence(u, grid), curl(u, grid)[:1]
    for refine in (False, True):
        spread = reconstruct(div, rotation, grid, u[:1], refine=refine)
        want = reconstruct(div, rotation.expand(2, -1, -1, -1), grid, u[:1].expand(2, -1, -1, -1), refine=refine)
        same(spread.value, want.value, grid)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("refine", [False, True])
def test_float32_comes_near_float64(refine, device):
    grid, u = adapted_to_a_sphere(20)
    single = again(u.to(device, torch.float32), grid, refine=refine)
    assert single.value.dtype == torch.float32
    assert single.value.device.type == device
    torch.testing.assert_close(single.value.cpu().double(), again(u, grid, refine=refine).value, atol=2e-6, rtol=0)


@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.parametrize(("grid", "order"), [(Grid((5, 6), (0.7, 1.1)), 4), (Grid((3, 4, 3), (0.7, 1.0, 1.2)), 2)])
def test_derivatives_by_all_data(grid, refine, order):
    u = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64)
    inputs = tuple(t.requires_grad_() for t in (divergence(u, grid, order), curl(u, grid, order), u.clone()))

    def solve(div, rotation, values):
        return reconstruct(div, rotation, grid, values, order=order, refine=refine).value

    assert gradcheck(solve, inputs, fast_mode=True)
    assert gradgradcheck(lambda *t: solve(*t).square().sum(), inputs, fast_mode=True)


GRID = Grid((6, 5))
ZERO = torch.zeros(1, 1, 6, 5)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((torch.zeros(1, 2, 6, 5), ZERO, GRID, torch.zeros(1, 2, 6, 5)), {}, r"div must have shape \(B, 1, 6, 5\)"),
        ((ZERO, torch.zeros(6, 5), GRID, torch.zeros(1, 2, 6, 5)), {}, "reconstruct: curl must have shape"),
        ((ZERO, ZERO, GRID, ZERO), {}, "reconstruct: boundary_displacement must have shape"),
        ((ZERO, ZERO.double(), GRID, torch.zeros(1, 2, 6, 5)), {}, "all must be float32, or all float64"),
        ((ZERO, ZERO, GRID, torch.zeros(1, 2, 6, 5)), {"order": 3}, "order must be one of 2, 4"),
        ((ZERO, ZERO, GRID, torch.zeros(1, 2, 6, 5)), {"steps": 0}, "steps must be a whole number, at least 1"),
        (
            (ZERO[:, :, :3], ZERO[:, :, :3], Grid((3, 5)), torch.zeros(1, 2, 3, 5)),
            {"order": 4},
            "order 4 needs 5 nodes",
        ),
    ],
)
def test_wrong_input_is_refused(arguments, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(*arguments, **options)
