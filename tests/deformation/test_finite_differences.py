"""Rows of finite differences: the transpose against autograd, and how near the preconditioner is to the inverse."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, cofactors, curl, divergence, jacobian_determinant, map_jacobian
from torchdeform.core.grid import Grid
from torchdeform.deformation.finite_differences import Differences, clear_boundary
from torchdeform.solvers.cg import conjugate_gradient, dots

UNTIMED = settings(deadline=None, max_examples=30)


@st.composite
def differences(draw) -> Differences:
    dim, order = draw(st.sampled_from((2, 3))), draw(st.sampled_from((2, 4)))
    shape = draw(st.tuples(*[st.integers(order + 1, 8)] * dim))
    return Differences(Grid(shape, draw(st.tuples(*[st.floats(0.2, 5)] * dim))), order)


def random(grid: Grid, channels: int, *, items: int = 2) -> Tensor:
    return torch.randn(items, channels, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(0))


def inner(grid: Grid, *, items: int = 2) -> Tensor:
    return clear_boundary(random(grid, grid.dim, items=items), grid)


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
    torch.testing.assert_close(made.adjoint(rows, factors), clear_boundary(want, grid))
    torch.testing.assert_close(made.norm(rows), (rows**2 * weights).flatten(1).sum(1).sqrt())


@given(differences())
@UNTIMED
def test_the_preconditioner_is_self_adjoint_and_positive(made):
    a, b = inner(made.grid), inner(made.grid).flip(0)
    solve = made.preconditioner(a)
    torch.testing.assert_close(dots(a, solve(b)), dots(solve(a), b))
    assert bool((dots(a, solve(a)) > 0).all())
    solved = solve(a)
    assert torch.equal(solved, clear_boundary(solved.clone(), made.grid))


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
