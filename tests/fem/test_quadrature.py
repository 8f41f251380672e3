"""Gauss quadrature: exact on multilinear fields, its adjoint the transpose, slabs without a trace."""

import pytest
import torch
from forms import GRIDS, close, element_values, random_field, random_form
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.core.grid import Grid
from torchdeform.fem import quadrature
from torchdeform.fem.elements import GAUSS
from torchdeform.fem.form import div_curl_form, gradient_form
from torchdeform.fem.operator import apply_form, form_diagonal
from torchdeform.fem.quadrature import adjoint, apply_by_quadrature, evaluate, interpolate, load_by_quadrature
from torchdeform.fem.weights import Weights


@pytest.mark.parametrize("grid", GRIDS)
def test_rows_at_gauss_points_are_exact_on_multilinear_fields(grid):
    # v = (x0 x1 [x2], x0, ..): its derivatives are known, and Q1 holds it exactly.
    x = grid.points(dtype=torch.float64)
    v = torch.cat([x.prod(dim=1, keepdim=True), x[:, :-1]], dim=1)
    rows = evaluate(gradient_form(grid.dim, grid.dim), v, grid)
    places = interpolate(x, grid)
    for a in range(grid.dim):
        rest = [b for b in range(grid.dim) if b != a]
        close(rows[a], places[:, rest].prod(dim=1))
        close(rows[grid.dim + a], torch.full_like(rows[a], float(a == 0)))
    unit = torch.cartesian_prod(*[torch.tensor(GAUSS, dtype=torch.float64)] * grid.dim)
    offset = (unit * torch.tensor(grid.spacing, dtype=torch.float64)).T.view(grid.dim, -1, *[1] * grid.dim)
    first = places[0].flatten(2)[:, :, :1].flatten(1)
    close(first, offset.flatten(1))


@pytest.mark.parametrize("grid", GRIDS)
def test_adjoint_is_the_transpose_of_evaluate(grid):
    form = random_form(grid, 2**grid.dim)
    v, w = random_field(grid, batch=1), [element_values(grid, points=2**grid.dim) for _ in form]
    pairing = (
        sum((r * s).sum() for r, s in zip(evaluate(form, v, grid), w, strict=True)) * grid.cell_volume / 2**grid.dim
    )
    close((adjoint(form, w, grid) * v).sum(), pairing)


@pytest.mark.parametrize("grid", GRIDS[:3])
def test_slabs_change_nothing(grid, monkeypatch):
    form, v = random_form(grid, 2**grid.dim), random_field(grid)
    whole = apply_by_quadrature(form, v, grid)
    data = random_field(grid, 2)
    load = load_by_quadrature(form, data, grid, (1, 0))
    monkeypatch.setattr(quadrature, "_SLAB", 1)
    monkeypatch.setattr(quadrature, "_LARGE_SLAB", 1)
    close(apply_by_quadrature(form, v, grid), whole)
    close(load_by_quadrature(form, data, grid, (1, 0)), load)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.integers(2, 6), min_size=2, max_size=3),
    st.lists(st.floats(0.1, 10.0), min_size=3, max_size=3),
    st.tuples(st.floats(0.1, 10.0), st.floats(0.1, 10.0), st.floats(0.0, 1.0)),
    st.booleans(),
)
def test_matrix_free_ways_agree_and_are_symmetric_and_positive(shape, spacing, weights, single):
    grid = Grid(tuple(shape), tuple(spacing[: len(shape)]))
    dtype, tolerance = (torch.float32, 2e-5) if single else (torch.float64, 1e-13)
    form, (v, w) = div_curl_form(grid.dim, Weights(*weights)), (random_field(grid, dtype=dtype) for _ in range(2))
    first, second = apply_form(form, v, grid), apply_by_quadrature(form, v, grid)
    size = float((form_diagonal(form, grid, v) * v.abs()).abs().max())
    assert first.dtype == second.dtype == dtype
    torch.testing.assert_close(first / size, second / size, atol=tolerance, rtol=0)
    there, back = (first * w).sum(), (apply_form(form, w, grid) * v).sum()
    assert abs(float(there - back)) <= tolerance * size * float(w.abs().sum())
    assert float((first * v).sum()) >= -tolerance * size
