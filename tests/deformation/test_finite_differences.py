"""Rows of finite differences: the transpose against autograd, and how near the preconditioner is to the inverse."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, cofactors, curl, divergence, jacobian_determinant, map_jacobian
from torchdeform.core.grid import Grid
from torchdeform.deformation.finite_differences import Differences, clear_boundary, continued
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.solvers.cg import conjugate_gradient, dots

UNTIMED = settings(deadline=None, max_examples=30)


@st.composite
def differences(draw) -> Differences:
    dim, order = draw(st.sampled_from((2, 3))), draw(st.sampled_from((2, 4)))
    shape = draw(st.tuples(*[st.integers(order + 1, 8)] * dim))
    grid = Grid(shape, draw(st.tuples(*[st.floats(0.2, 5)] * dim)))
    return Differences(grid, order, draw(st.sampled_from(("dirichlet", "slip"))))


def random(grid: Grid, channels: int, *, items: int = 2) -> Tensor:
    return torch.randn(items, channels, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(0))


def inner(grid: Grid, boundary: str = "dirichlet", *, items: int = 2) -> Tensor:
    return clear_boundary(random(grid, grid.dim, items=items), grid, boundary)


@pytest.mark.parametrize("boundary", ["dirichlet", "slip"])
@pytest.mark.parametrize("shape", [(4, 5), (4, 3, 5)])
def test_what_the_boundary_gives_is_cleared(shape, boundary):
    field = inner(Grid(shape), boundary)
    assert torch.equal(field == 0, fixed_unknowns(boundary, Grid(shape)).expand_as(field))


@given(differences())
@UNTIMED
def test_rows_are_those_of_the_stencil(made):
    grid, order = made.grid, made.order
    u = random(grid, grid.dim)
    torch.testing.assert_close(made.rows(u), torch.cat([divergence(u, grid, order), curl(u, grid, order)], dim=1))
    matrix, rows = made.of_map(u)
    torch.testing.assert_close(matrix, map_jacobian(u, grid, order=order))
    want = torch.cat([jacobian_determinant(u, grid, order), curl(u, grid, order)], dim=1)
    torch.testing.assert_close(rows, want)


@given(differences())
@UNTIMED
def test_rows_with_cofactors_are_the_derivative_of_the_determinant_and_the_curl(made):
    u, v = random(made.grid, made.grid.dim), inner(made.grid)
    change = torch.autograd.functional.jvp(lambda w: made.of_map(w)[1], u, v)[1]
    torch.testing.assert_close(made.rows(v, cofactors(map_jacobian(u, made.grid, order=made.order))), change)


@given(differences(), st.booleans())
@UNTIMED
def test_the_adjoint_is_the_transpose_with_trapezoidal_weights(made, plain):
    grid = made.grid
    factors = None if plain else random(grid, grid.dim**2).unflatten(1, (grid.dim, grid.dim))
    rows, v = random(grid, 1 + len(CURL_PAIRS[grid.dim])), torch.zeros(2, grid.dim, *grid.shape, dtype=torch.float64)
    v.requires_grad_()
    weights = grid.quadrature(dtype=torch.float64) / grid.cell_volume
    (want,) = torch.autograd.grad((made.rows(v, factors) * rows * weights).sum(), v)
    torch.testing.assert_close(made.adjoint(rows, factors), clear_boundary(want, grid, made.boundary))
    torch.testing.assert_close(made.norm(rows), (rows**2 * weights).flatten(1).sum(1).sqrt())


@given(differences())
@UNTIMED
def test_the_preconditioner_is_self_adjoint_and_positive(made):
    a, b = inner(made.grid, made.boundary), inner(made.grid, made.boundary).flip(0)
    solve = made.preconditioner(a)
    torch.testing.assert_close(dots(a, solve(b)), dots(solve(a), b))
    assert bool((dots(a, solve(a)) > 0).all())
    solved = solve(a)
    assert torch.equal(solved, clear_boundary(solved.clone(), made.grid, made.boundary))


@pytest.mark.parametrize(("order", "most"), [(2, 30), (4, 60)])
@pytest.mark.parametrize("shapes", [((12, 17), (96, 129)), ((10, 8, 9), (30, 24, 37))])
def test_a_solve_takes_as_many_steps_on_fine_grids_as_on_coarse_ones(shapes, order, most):
    for shape in shapes:
        grid = Grid(shape, (1.0, 0.7, 1.2)[: len(shape)])
        made, v = Differences(grid, order), inner(Grid(shape), items=1)
        load = made.adjoint(made.rows(v))
        solution = conjugate_gradient(
            lambda w, made=made: made.adjoint(made.rows(w)), load, preconditioner=made.preconditioner(load)
        )
        assert int(solution.steps) <= most
        torch.testing.assert_close(solution.value, v, atol=1e-8, rtol=0)


@pytest.mark.parametrize(("order", "most"), [(2, 90), (4, 180)])
@pytest.mark.parametrize("shape", [(24, 17), (10, 8, 9)])
def test_with_slip_a_solve_takes_three_times_as_many(shape, order, most):
    made, v = Differences(Grid(shape), order, "slip"), inner(Grid(shape), "slip", items=1)
    load = made.adjoint(made.rows(v))
    solution = conjugate_gradient(lambda w: made.adjoint(made.rows(w)), load, preconditioner=made.preconditioner(load))
    assert int(solution.steps) <= most
    torch.testing.assert_close(solution.value, v, atol=1e-7, rtol=0)


@pytest.mark.parametrize("shape", [(9, 12), (8, 9, 7)])
def test_parabolas_go_on_over_faces_and_edges(shape):
    x = Grid(shape).points(dtype=torch.float64)
    smooth = (x[:, :1] - 3) ** 2 + 2 * x[:, 1:2] - 0.5 * x[:, -1:] ** 2
    known = torch.zeros_like(smooth, dtype=torch.bool)
    known[(..., *[slice(1, -1)] * len(shape))] = True
    torch.testing.assert_close(continued(smooth.masked_fill(~known, torch.nan), known), smooth)


@pytest.mark.parametrize("shape", [(3, 4), (14, 11), (9, 8, 10), (2, 9, 8)])
def test_what_is_far_from_what_is_known_stays_in_its_range(shape):
    field = torch.rand(2, 2, *shape, generator=torch.manual_seed(0))
    known = torch.rand(2, 2, *shape, generator=torch.manual_seed(1)) < 0.05
    known[(..., *[1] * len(shape))] = True
    known[1, 1] = False
    made = continued(field.masked_fill(~known, torch.nan), known)
    assert torch.equal(made[known], field[known])
    assert not made[1, 1].any()
    for values, where in zip(made.flatten(0, 1)[:3], known.flatten(0, 1)[:3], strict=True):
        low, high = values[where].aminmax()
        assert float(values.min()) >= float(low - (high - low) / 2) - 1e-6
        assert float(values.max()) <= float(high + (high - low) / 2) + 1e-6
