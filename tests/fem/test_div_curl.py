"""A field from its divergence and curl: convergence, exactness, boundary conditions, solvers, derivatives, errors."""

import math
from dataclasses import replace

import pytest
import torch
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.boundary import Face, faces, fixed_unknowns
from torchdeform.fem.div_curl import curl_potential, solve_div_curl
from torchdeform.fem.form import div_curl_form, gradient_form
from torchdeform.fem.operator import assemble_load
from torchdeform.fem.quadrature import adjoint, evaluate
from torchdeform.fem.solver import SolverSettings
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Status

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
CG = SolverSettings(method="cg")


def grid_on_unit_box(dim: int, cells: int) -> Grid:
    """Anisotropic: half as many cells again along the last axis, on a box that is no cube."""
    counts = [cells] * (dim - 1) + [3 * cells // 2]
    return Grid(tuple(n + 1 for n in counts), (*[1.0 / cells] * (dim - 1), 1.2 / counts[-1]))


def slip_field(x: Tensor, extent: tuple[float, ...]) -> Tensor:
    """Smooth, n·v = 0 on every face, with divergence and curl."""
    unit = x / torch.tensor(extent, dtype=x.dtype).view(1, -1, *[1] * (x.dim() - 2))
    parts = []
    for k in range(x.shape[1]):
        others = [torch.cos(math.pi * unit[:, a] * (1 + k)) + 0.5 * a for a in range(x.shape[1]) if a != k]
        parts.append(torch.sin(math.pi * unit[:, k]) * (k + 1) * math.prod(others[1:], start=others[0]))
    return torch.stack(parts, dim=1)


def any_field(x: Tensor, extent: tuple[float, ...]) -> Tensor:
    """Smooth, nothing in particular at the boundary."""
    waves = [torch.sin(2.0 * x[:, k] + 1.3 * x[:, (k + 1) % x.shape[1]] ** 2 + k) for k in range(x.shape[1])]
    return torch.stack(waves, dim=1) + x.flip(1) ** 2


def manufactured(field, grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """Return v, div v and curl v at the nodes, derivatives by autograd."""
    x = grid.points(dtype=torch.float64).requires_grad_()
    v = field(x, grid.extent)
    slopes = [torch.autograd.grad(v[:, k].sum(), x, retain_graph=True)[0] for k in range(grid.dim)]
    div = torch.stack([slopes[k][:, k] for k in range(grid.dim)]).sum(0).unsqueeze(1)
    curl = torch.stack([slopes[b][:, a] - slopes[a][:, b] for a, b in CURL_PAIRS[grid.dim]], dim=1)
    return v.detach(), div, curl


def l2(field: Tensor, grid: Grid) -> float:
    return math.sqrt(float((field.square() * grid.quadrature(dtype=field.dtype)).sum()))


def random_data(grid: Grid, batch: int = 1, dtype=torch.float64) -> tuple[Tensor, Tensor]:
    curls = len(CURL_PAIRS[grid.dim])
    return tuple(torch.randn(batch, c, *grid.shape, dtype=dtype) for c in (1, curls))


@pytest.mark.parametrize(("dim", "cells"), [(2, (16, 32, 64)), (3, (8, 16, 24))])
@pytest.mark.parametrize("weights", [Weights(), Weights(2.0, 0.5)])
@pytest.mark.parametrize(
    ("boundary", "field"),
    [("slip", slip_field), ("slip", any_field), ("dirichlet", any_field), ("no_slip_tangential", any_field)],
)
def test_the_error_falls_with_the_square_of_the_spacing(boundary, field, weights, dim, cells):
    errors = []
    for n in cells:
        grid = grid_on_unit_box(dim, n)
        v, div, curl = manufactured(field, grid)
        settings = SolverSettings(rtol=1e-9)
        solution = solve_div_curl(div, curl, grid, boundary, boundary_values=v, weights=weights, solver=settings)
        assert solution.ok
        errors.append(l2(solution.value - v, grid))
    slopes = [
        math.log(a / b) / math.log(n / m) for a, b, m, n in zip(errors, errors[1:], cells, cells[1:], strict=False)
    ]
    assert slopes[-1] == pytest.approx(2.0, abs=0.1), (errors, slopes)


@pytest.mark.parametrize("boundary", ["slip", "no_slip_tangential", "dirichlet", "faces"])
@pytest.mark.parametrize("settings", [SolverSettings(), CG])
@pytest.mark.parametrize("grid", [Grid((5, 6), (0.7, 1.1)), Grid((4, 3, 5), (0.7, 1.0, 1.4))])
def test_it_solves_the_brute_force_system(brute, grid, settings, boundary):
    kinds = boundary
    if boundary == "faces":
        kinds = dict.fromkeys(faces(grid.dim), "slip") | {Face(0, 1): "free", Face(1, 0): "dirichlet"}
    div, curl = random_data(grid)
    values = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64)
    weights = (2.0, 0.7, 0.1)
    solution = solve_div_curl(
        div,
        curl,
        grid,
        kinds,
        boundary_values=values,
        weights=Weights(*weights),
        solver=replace(settings, rtol=1e-12),
    )
    assert solution.ok
    oracle, fixed = brute(grid.shape, grid.spacing, points=2), fixed_unknowns(kinds, grid).flatten()
    matrix = oracle.matrix(oracle.div_curl(*weights), grid.dim)
    data = torch.cat([div - solution.incompatibility.view(-1, *[1] * (grid.dim + 1)), curl], dim=1)[0]
    load = oracle.load(oracle.div_curl(*weights[:2]), data, grid.dim)
    want = values.flatten().clone()
    want[~fixed] = torch.linalg.solve(matrix[~fixed][:, ~fixed], load[~fixed] - matrix[~fixed][:, fixed] @ want[fixed])
    torch.testing.assert_close(solution.value.flatten(), want, atol=1e-10, rtol=1e-10)


@pytest.mark.parametrize("grid", [Grid((33, 40), (1.0, 0.7)), Grid((17, 12, 15), (1.0, 0.7, 1.3))])
@pytest.mark.parametrize(
    ("boundary", "weights"),
    [
        ("slip", Weights()),
        ("slip", Weights(1.0, 7.0, 0.01)),
        ("dirichlet", Weights(2.0, 2.0, 0.1)),
        ("no_slip_tangential", Weights(5.0, 1.0)),
    ],
)
def test_where_the_transform_is_exact_cg_needs_two_steps_with_it(grid, boundary, weights):
    div, curl = random_data(grid, batch=2)
    settings = SolverSettings(method="cg", rtol=1e-10)
    solution = solve_div_curl(div, curl, grid, boundary, weights=weights, solver=settings)
    assert solution.ok
    assert int(solution.steps.max()) <= 2
    direct = solve_div_curl(div, curl, grid, boundary, weights=weights)
    assert direct.ok
    assert not direct.steps.any()
    torch.testing.assert_close(solution.value, direct.value, atol=1e-8, rtol=1e-8)


@pytest.mark.parametrize(
    "grid", [Grid((65, 65)), Grid((33, 70), (1.0, 0.4)), Grid((17, 17, 17)), Grid((9, 20, 14), (2.0, 0.7, 1.0))]
)
@pytest.mark.parametrize("ratio", [1 / 16, 1 / 4, 4, 16])
def test_under_dirichlet_data_forty_steps_do_for_any_ratio_up_to_sixteen(grid, ratio):
    div, curl = random_data(grid)
    smooth = manufactured(any_field, Grid(grid.shape, tuple(1 / n for n in grid.shape)))
    for alpha, beta, values in ((div, curl, None), (smooth[1], smooth[2], smooth[0])):
        solution = solve_div_curl(
            alpha,
            beta,
            grid,
            "dirichlet",
            boundary_values=values,
            weights=Weights(ratio, 1.0),
            solver=SolverSettings(rtol=1e-8),
        )
        assert solution.ok
        assert int(solution.steps) <= 40


@pytest.mark.parametrize("preconditioner", ["transform", "jacobi", "none"])
@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
def test_preconditioners_and_weights_by_element(preconditioner, boundary):
    grid = Grid((12, 9), (0.8, 1.2))
    div, curl = random_data(grid, batch=2)
    varying = 0.5 + torch.rand(2, 1, 11, 8, dtype=torch.float64)
    weights = Weights(varying, 2.0, varying / 10)
    settings = SolverSettings(preconditioner=preconditioner, rtol=1e-11)
    solution = solve_div_curl(div, curl, grid, boundary, weights=weights, solver=settings)
    assert solution.ok
    other = solve_div_curl(div, curl, grid, boundary, weights=weights, solver=SolverSettings(rtol=1e-12))
    torch.testing.assert_close(solution.value, other.value, atol=1e-8, rtol=1e-8)
    if preconditioner != "transform":
        assert bool((solution.steps > other.steps).all())


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
@pytest.mark.parametrize("settings", [SolverSettings(), CG, SolverSettings(method="cg", preconditioner="jacobi")])
def test_float32_comes_near_float64(settings, boundary, device):
    grid = Grid((20, 24), (1.0, 0.7))
    v, div, curl = manufactured(any_field, Grid(grid.shape, (0.05, 0.04)))
    double = solve_div_curl(div, curl, grid, boundary, boundary_values=v)
    single = solve_div_curl(
        *(t.to(device).float() for t in (div, curl)),
        grid,
        boundary,
        boundary_values=v.to(device).float(),
        solver=settings,
    )
    assert single.ok
    assert single.value.dtype == torch.float32
    assert single.value.device.type == device
    error = (single.value.cpu().double() - double.value).abs().max() / double.value.abs().max()
    assert float(error) < 1e-4


@pytest.mark.parametrize("settings", [SolverSettings(), CG])
def test_smooth_data_on_a_fine_grid_in_float32_count_as_solved(settings):
    # ‖K‖ ‖v‖ ε / ‖load‖ is 1e-3 here: no float32 field has a residual of 1e-5.
    grid = Grid((257, 257))
    x = grid.points() * (math.pi / 256)
    div = x.cos().prod(dim=1, keepdim=True)
    solution = solve_div_curl(div, None, grid, solver=settings)
    assert solution.ok
    assert 1e-5 < float(solution.residual) < 5e-3
    strict = solve_div_curl(div, None, grid, solver=replace(settings, rtol=1e-5))
    assert strict.status == (Status.ROUNDING,)
    double = solve_div_curl(div.double(), None, grid)
    assert float((solution.value - double.value).abs().max() / double.value.abs().max()) < 1e-4


@pytest.mark.parametrize("settings", [SolverSettings(), CG])
@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
def test_a_batch_equals_its_items_one_by_one(settings, boundary):
    grid, weights = Grid((9, 7, 8)), Weights(3.0, 1.0)
    div, curl = random_data(grid, batch=4)
    values = torch.randn(4, 3, *grid.shape, dtype=torch.float64)
    div[1], curl[1], values[1], curl[2, 0, 3, 3, 3] = 0.0, 0.0, 0.0, math.nan
    together = solve_div_curl(div, curl, grid, boundary, boundary_values=values, weights=weights, solver=settings)
    for i in range(4):
        part = slice(i, i + 1)
        alone = solve_div_curl(
            div[part], curl[part], grid, boundary, boundary_values=values[part], weights=weights, solver=settings
        )
        assert together.status[i] is alone.status[0]
        assert together.steps[i] == alone.steps[0]
        if i != 2:
            terms, condition = terms_of_a_solve(grid), condition_of_a_solve(grid, 3.0)
            assert_same_to_rounding(together.value[part], alone.value, terms, condition)
    assert together.status[2] is Status.NON_FINITE
    assert all(together.status[i].ok for i in (0, 1, 3))
    assert not together.value[1].any()
    assert float(together.residual[1]) == 0


def test_what_is_left_out_is_zero_and_one_item_spreads():
    grid = Grid((6, 7))
    div, curl = random_data(grid, batch=2)
    zero = torch.zeros_like(div)
    same = [
        (solve_div_curl(div, None, grid), solve_div_curl(div, zero, grid)),
        (solve_div_curl(None, curl, grid), solve_div_curl(zero, curl, grid)),
        (solve_div_curl(div, curl[:1], grid), solve_div_curl(div, curl[:1].expand(2, -1, -1, -1), grid)),
    ]
    for a, b in same:
        assert_same_to_rounding(a.value, b.value, terms_of_a_solve(grid), condition_of_a_solve(grid))
    # Only boundary values: the field without divergence and curl that takes them.
    x = grid.points(dtype=torch.float64)
    still = torch.cat([x[:, 1:], x[:, :1]], dim=1)
    solution = solve_div_curl(None, None, grid, "dirichlet", boundary_values=still)
    torch.testing.assert_close(solution.value, still, atol=1e-12, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_incompatible_is_taken_off_and_reported(dim):
    grid = Grid((6, 7, 5)[:dim], (0.5, 1.0, 2.0)[:dim])
    div, curl = random_data(grid, batch=2)
    div = div + 3.0
    weight = 0.5 + torch.rand(1, 1, *[n - 1 for n in grid.shape], dtype=torch.float64)
    mean = (div * grid.quadrature(dtype=torch.float64)).flatten(1).sum(1) / grid.volume
    for weights in (Weights(), Weights(weight)):
        solution = solve_div_curl(div, curl, grid, weights=weights)
        torch.testing.assert_close(solution.incompatibility, mean)
        again = solve_div_curl(div - mean.view(-1, *[1] * (dim + 1)), curl, grid, weights=weights)
        torch.testing.assert_close(again.value, solution.value, atol=1e-8, rtol=0)
        torch.testing.assert_close(again.incompatibility, torch.zeros(2, dtype=torch.float64), atol=1e-12, rtol=0)
    # A field that spreads, v = x, has div = D and its flux through the boundary: compatible.
    x = grid.points(dtype=torch.float64)
    right = solve_div_curl(torch.full_like(div[:1], float(dim)), None, grid, "dirichlet", boundary_values=x)
    torch.testing.assert_close(right.incompatibility, torch.zeros(1, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(right.value, x, atol=1e-11, rtol=0)
    assert not solve_div_curl(div, curl, grid, "free", weights=Weights(zero=1.0)).incompatibility.any()


def test_theta_is_the_part_of_the_curl_that_is_none():
    grid = grid_on_unit_box(3, 16)
    v, div, curl = manufactured(slip_field, grid)
    plain = solve_div_curl(div, curl, grid, theta=True)
    assert l2(plain.theta, grid) < 0.01 * l2(plain.value, grid)
    # Add the gradient of a potential that is zero on the boundary: θ finds it, and v does not notice.
    x = grid.points(dtype=torch.float64).requires_grad_()
    unit = x / grid.along(grid.extent, x)
    potential = torch.sin(math.pi * unit).prod(dim=1, keepdim=True)
    (gradient,) = torch.autograd.grad(potential.sum(), x)
    solution = solve_div_curl(div, curl + gradient, grid, theta=True)
    assert l2(solution.theta - plain.theta - potential.detach(), grid) < 0.01 * l2(potential.detach(), grid)
    assert l2(solution.value - plain.value, grid) < 0.01 * l2(v, grid)
    assert solve_div_curl(div, curl, grid).theta is None
    assert not solve_div_curl(div, None, grid, theta=True).theta.any()


@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
def test_theta_decouples_exactly(boundary):
    # The Q1 load of ∇θ against curl N is zero to rounding for any Q1 θ that is zero on the boundary.
    grid = Grid((5, 4, 6), (0.7, 1.0, 1.3))
    theta = curl_potential(torch.randn(1, 3, *grid.shape, dtype=torch.float64), grid)
    assert not theta[fixed_unknowns("dirichlet", grid)[:, :1].expand_as(theta)].any()
    load = adjoint(div_curl_form(3, Weights())[1:], evaluate(gradient_form(3), theta, grid), grid)
    assert float(load.masked_fill(fixed_unknowns(boundary, grid), 0).abs().max()) < 1e-13


@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
@pytest.mark.parametrize("settings", [SolverSettings(), replace(CG, rtol=1e-13)])
@pytest.mark.parametrize("grid", [Grid((3, 4), (1.0, 0.7)), Grid((3, 3, 2), (1.0, 0.7, 1.2))])
def test_derivatives_by_data_and_boundary_values(grid, settings, boundary):
    div, curl = random_data(grid)
    values = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64)
    inputs = tuple(t.requires_grad_() for t in (div, curl, values))

    def solve(div, curl, values):
        return solve_div_curl(div, curl, grid, boundary, boundary_values=values, solver=settings).value

    assert gradcheck(solve, inputs, fast_mode=grid.dim == 3)
    assert gradgradcheck(lambda *t: solve(*t).square().sum(), inputs, fast_mode=True)


@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("grid", [Grid((3, 4), (1.0, 0.7)), Grid((3, 3, 2), (1.0, 0.7, 1.2))])
def test_derivatives_by_weights(grid, varying, boundary):
    shape = (1, 1, *[n - 1 for n in grid.shape]) if varying else (1, 1, *[1] * grid.dim)
    weights = tuple((0.5 + torch.rand(shape, dtype=torch.float64)).requires_grad_() for _ in range(3))
    div, curl = random_data(grid)
    values = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64)
    settings = SolverSettings(rtol=1e-13)

    def solve(*weights):
        w = Weights(*weights)
        return solve_div_curl(div, curl, grid, boundary, boundary_values=values, weights=w, solver=settings).value

    assert gradcheck(solve, weights, atol=1e-6, fast_mode=grid.dim == 3)
    assert gradgradcheck(lambda *t: solve(*t).square().sum(), weights, fast_mode=True, atol=1e-4)


def test_derivatives_through_cg_equal_those_through_the_transform():
    grid = Grid((6, 5))
    div, curl = (t.requires_grad_() for t in random_data(grid))
    weights = [torch.tensor(w, dtype=torch.float64, requires_grad=True) for w in (2.0, 0.5, 0.1)]
    gradients = []
    for settings in (SolverSettings(method="transform"), replace(CG, rtol=1e-13)):
        value = solve_div_curl(div, curl, grid, weights=Weights(*weights), solver=settings).value
        gradients.append(torch.autograd.grad(value.sin().sum(), (div, curl, *weights)))
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-10, rtol=1e-8)


def test_steps_that_run_out_are_said():
    grid = Grid((20, 20))
    div, curl = random_data(grid)
    settings = SolverSettings(method="cg", preconditioner="none", max_steps=3)
    solution = solve_div_curl(div, curl, grid, solver=settings)
    assert solution.status == (Status.MAX_STEPS,)
    assert int(solution.steps) == 3
    assert "max_steps" in solution.status[0].value


GRID2, GRID3 = Grid((4, 5)), Grid((4, 5, 3))
DIV2 = torch.zeros(1, 1, 4, 5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (DIV2, torch.zeros(1, 3, 4, 5), GRID2),
            r"solve_div_curl: curl must have shape \(B, 1, 4, 5\), got \(1, 3, 4, 5\)",
        ),
        ((torch.zeros(1, 1, 4, 5, 3), torch.zeros(1, 1, 4, 5, 3), GRID3), r"curl must have shape \(B, 3, 4, 5, 3\)"),
        ((torch.zeros(4, 5), None, GRID2), r"div must have shape \(B, 1, 4, 5\)"),
        ((DIV2.long(), None, GRID2), "div must be a floating-point tensor"),
        ((DIV2.half(), None, GRID2), r"of 32 or 64 bits, got torch.float16; convert it with .float\(\)"),
        ((DIV2, DIV2.double(), GRID2), "all must be float32, or all float64"),
        ((torch.zeros(2, 1, 4, 5), torch.zeros(3, 1, 4, 5), GRID2), r"batch sizes must agree or be 1, got \[2, 3\]"),
        ((None, None, GRID2), "nothing to solve for"),
        ((DIV2, None, GRID2, "dirichlett"), "did you mean 'dirichlet'"),
    ],
)
def test_wrong_input_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        solve_div_curl(*arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"boundary_values": torch.zeros(1, 3, 4, 5)}, "boundary_values must have shape"),
        ({"weights": Weights(torch.ones(1, 1, 4, 5))}, "Weights: div must be a number or have shape"),
        ({"weights": Weights(torch.zeros(1, 1, 3, 4))}, "Weights: div must be finite and positive"),
        (
            {"weights": Weights(torch.ones(2, 1, 3, 4)), "boundary_values": torch.zeros(3, 2, 4, 5)},
            "batch sizes must agree",
        ),
        ({"theta": True}, "theta belongs to the curl in 3D"),
        (
            {"solver": SolverSettings(method="transform"), "weights": Weights(torch.ones(1, 1, 3, 4))},
            "transform is not exact",
        ),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        solve_div_curl(DIV2, None, GRID2, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "transfrom"}, "did you mean 'transform'"),
        ({"preconditioner": "jakobi"}, "did you mean 'jacobi'"),
        ({"rtol": -1.0}, "must not be negative"),
        ({"atol": -1.0}, "must not be negative"),
        ({"max_steps": -1}, "must not be negative"),
    ],
)
def test_wrong_settings_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        SolverSettings(**options)


def test_a_field_given_by_its_own_load_comes_back():
    # The load of exact data equals K v when div v and curl v are Q1, as for a linear v.
    grid = Grid((5, 6), (0.5, 1.0))
    x = grid.points(dtype=torch.float64)
    v = torch.cat([2 * x[:, :1] + x[:, 1:], -x[:, :1] + 0.5 * x[:, 1:]], dim=1)
    div, curl = torch.full_like(x[:, :1], 2.5), torch.full_like(x[:, :1], -2.0)
    for boundary in ("slip", "dirichlet", "no_slip_tangential"):
        solution = solve_div_curl(div, curl, grid, boundary, boundary_values=v, weights=Weights(2.0, 3.0))
        torch.testing.assert_close(solution.value, v, atol=1e-8, rtol=0)
    assert assemble_load(div_curl_form(2, Weights()), torch.cat([div, curl], dim=1), grid).shape == v.shape


@pytest.mark.parametrize(("dtype", "size"), [(torch.float32, 1e30), (torch.float32, 1e-30), (torch.float64, 1e200)])
@pytest.mark.parametrize("solver", ["transform", "cg", "assembled"])
@pytest.mark.parametrize("grid", [GRID2, GRID3])
def test_the_unit_of_the_data_does_not_matter(grid, solver, dtype, size):
    """The squares in a norm of 1e200 overflow, those of 1e-30 in float32 vanish: that says nothing of v."""
    x = grid.points(dtype=dtype)
    div, turn = torch.sin(x).sum(1, keepdim=True), torch.cos(x)[:, : 2 * grid.dim - 3]
    expected = solve_div_curl(div, turn, grid, solver=solver)
    found = solve_div_curl(size * div, size * turn, grid, solver=solver)
    assert found.status == expected.status == (Status.CONVERGED,)
    torch.testing.assert_close(
        found.value / size, expected.value, rtol=1e-4, atol=1e-4 * float(expected.value.abs().max())
    )
    assert found.residual.item() == pytest.approx(expected.residual.item(), abs=1e-5)


@pytest.mark.parametrize("solver", ["transform", "cg"])
def test_what_is_beyond_all_numbers_is_said(solver):
    div = torch.full((1, 1, *GRID2.shape), 3e38).cos() * 3e38
    div[..., 2:] = math.inf
    found = solve_div_curl(div, None, GRID2, solver=solver)
    assert found.status == (Status.NON_FINITE,)
    assert found.residual.isnan().all()
