"""Three ways to one matrix: brute force, assembly from element matrices, and matrix-free application."""

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem import quadrature
from torchdeform.fem.assembly import assemble, constrain_matrix, to_csr
from torchdeform.fem.boundary import fixed_unknowns, lift
from torchdeform.fem.elements import INTERVAL, components, element_matrices, gauss_points
from torchdeform.fem.form import Form, Row, Term, div_curl_form, gradient_form
from torchdeform.fem.operator import apply_form, assemble_load, form_diagonal
from torchdeform.fem.quadrature import adjoint, apply_by_quadrature, evaluate, interpolate, load_by_quadrature
from torchdeform.fem.weights import Weights

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
GRIDS = [Grid((4, 6), (0.5, 1.3)), Grid((2, 3), (1.0, 0.2)), Grid((3, 4, 3), (0.7, 1.0, 1.4)), Grid((2, 2, 2))]
WEIGHTS = [(1.0, 1.0, 0.0), (2.0, 2.0, 0.3), (3.0, 0.5, 0.0), (0.2, 4.0, 0.6)]

close = partial(torch.testing.assert_close, atol=1e-13, rtol=1e-13)


def random_field(grid: Grid, channels: int | None = None, batch: int = 2, dtype=torch.float64) -> Tensor:
    return torch.randn(batch, grid.dim if channels is None else channels, *grid.shape, dtype=dtype)


def element_values(grid: Grid, batch: int = 1, points: int = 1) -> Tensor:
    return 0.5 + torch.rand(batch, points, *[n - 1 for n in grid.shape], dtype=torch.float64)


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("grid", GRIDS)
def test_assembled_and_matrix_free_operators_equal_brute_force(brute, grid, weights):
    oracle = brute(grid.shape, grid.spacing)
    matrix = oracle.matrix(oracle.div_curl(*weights), grid.dim)
    form, v = div_curl_form(grid.dim, Weights(*weights)), random_field(grid)
    assembled = assemble(form, grid)
    close(assembled.to_dense(), matrix)
    want = (v.flatten(1) @ matrix).view_as(v)
    close(apply_form(form, v, grid), want)
    close(apply_by_quadrature(form, v, grid), want)
    close((to_csr(assembled) @ v.flatten(1).T).T.view_as(v), want)
    close(form_diagonal(form, grid, v).flatten(), matrix.diagonal())


@pytest.mark.parametrize("grid", GRIDS)
def test_weights_by_element_equal_brute_force(brute, grid):
    div, curl, zero = (element_values(grid) for _ in range(3))
    oracle = brute(grid.shape, grid.spacing)
    matrix = oracle.matrix(oracle.div_curl(*(w[0, 0].numpy() for w in (div, curl, zero))), grid.dim)
    form, v = div_curl_form(grid.dim, Weights(div, curl, zero)), random_field(grid)
    close(assemble(form, grid).to_dense(), matrix)
    close(apply_form(form, v, grid), (v.flatten(1) @ matrix).view_as(v))
    close(form_diagonal(form, grid, v).flatten(), matrix.diagonal())


def test_the_matrix_is_a_sum_of_kronecker_products():
    grid, (div, curl, zero) = Grid((3, 4, 5), (0.7, 1.0, 1.4)), WEIGHTS[3]

    def chain(axis: int, test: bool, trial: bool) -> Tensor:
        local, power = INTERVAL[test, trial]
        size, total = grid.shape[axis], torch.zeros(grid.shape[axis], grid.shape[axis], dtype=torch.float64)
        for i in range(size - 1):
            total[i : i + 2, i : i + 2] += torch.tensor(local, dtype=torch.float64) * grid.spacing[axis] ** power
        return total

    def block(test: int | None, trial: int | None) -> Tensor:
        product = torch.ones(1, 1, dtype=torch.float64)
        for axis in range(3):
            product = torch.kron(product, chain(axis, test == axis, trial == axis))
        return product

    rows = []
    for k in range(3):
        others = [a for a in range(3) if a != k]
        own = div * block(k, k) + curl * sum(block(a, a) for a in others) + zero * block(None, None)
        rows.append([own if m == k else div * block(k, m) - curl * block(m, k) for m in range(3)])
    want = torch.cat([torch.cat(r, dim=1) for r in rows])
    close(assemble(div_curl_form(3, Weights(div, curl, zero)), grid).to_dense(), want)


@pytest.mark.parametrize("weights", [(2.0, 0.5), (1.0, 1.0)])
@pytest.mark.parametrize("grid", GRIDS)
def test_right_hand_sides_equal_brute_force(brute, grid, weights):
    form = div_curl_form(grid.dim, Weights(*weights))
    data, oracle = random_field(grid, len(form)), brute(grid.shape, grid.spacing)
    want = torch.stack([oracle.load(oracle.div_curl(*weights), item, grid.dim) for item in data])
    close(assemble_load(form, data, grid).flatten(1), want)
    close(load_by_quadrature(form, data, grid).flatten(1), want)


@pytest.mark.parametrize("grid", GRIDS)
def test_right_hand_sides_with_weights_by_element_equal_brute_force(brute, grid):
    div, curl = element_values(grid), element_values(grid)
    form, oracle = div_curl_form(grid.dim, Weights(div, curl)), brute(grid.shape, grid.spacing)
    data = random_field(grid, len(form), batch=1)
    want = oracle.load(oracle.div_curl(div[0, 0].numpy(), curl[0, 0].numpy()), data[0], grid.dim)
    close(assemble_load(form, data, grid).flatten(), want)


def random_form(grid: Grid, points: int) -> Form:
    """Rows with coefficients at will, as a linearised determinant would have: all derivatives in the first row."""
    terms = [Term(element_values(grid, points=points), k, a) for k in range(grid.dim) for a in range(grid.dim)]
    second = (Term(-0.7, 0, None), Term(element_values(grid, points=points), grid.dim - 1, 0))
    return (Row(element_values(grid, points=points), tuple(terms)), Row(2.0, second))


@pytest.mark.parametrize("per_point", [False, True])
@pytest.mark.parametrize("grid", GRIDS)
def test_any_coefficients_equal_brute_force(brute, grid, per_point):
    form, oracle = random_form(grid, 2**grid.dim if per_point else 1), brute(grid.shape, grid.spacing, points=2)

    def at(c, element, index):
        return c if isinstance(c, float) else float(c[(0, index if per_point else 0, *element)])

    def rows(element, index):
        for row in form:
            terms = [(k, axis, at(c, element, index)) for c, k, axis in row.terms]
            yield at(row.weight, element, index), terms

    matrix, v = oracle.matrix(rows, grid.dim), random_field(grid)
    close(assemble(form, grid).to_dense(), matrix)
    close(apply_form(form, v, grid), (v.flatten(1) @ matrix).view_as(v))
    close(form_diagonal(form, grid, v).flatten(), matrix.diagonal())
    data = random_field(grid, 2, batch=1)
    close(assemble_load(form, data, grid).flatten(), oracle.load(rows, data[0], grid.dim))


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
    offset = gauss_points(grid).T.view(grid.dim, -1, *[1] * grid.dim)
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
    load = load_by_quadrature(form, data, grid)
    monkeypatch.setattr(quadrature, "_SLAB", 1)
    monkeypatch.setattr(quadrature, "_LARGE_SLAB", 1)
    close(apply_by_quadrature(form, v, grid), whole)
    close(load_by_quadrature(form, data, grid), load)


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


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_gives_its_items_bit_for_bit(dtype, device, monkeypatch):
    monkeypatch.setattr(quadrature, "_SLAB", 100)
    grid = Grid((7, 7, 6), (0.7, 1.0, 1.4))
    v, varying = random_field(grid, batch=3).to(device, dtype), element_values(grid, batch=3).to(device, dtype)
    for weights in (Weights(2.0, 0.5, 0.1), Weights(varying, 2.0, 0.1), Weights(varying[:, :, :1, :1, :1], 2.0)):
        together = apply_form(div_curl_form(3, weights), v, grid)
        for i in range(3):
            alone = weights.with_tensors(tuple(w[i : i + 1] for w in weights.tensors))
            assert torch.equal(together[i : i + 1], apply_form(div_curl_form(3, alone), v[i : i + 1], grid))


def test_weights_that_vary_over_the_batch_spread_one_field():
    grid = Grid((4, 5))
    v, weights = random_field(grid, batch=1), Weights(element_values(grid, batch=3), 2.0)
    together = apply_form(div_curl_form(2, weights), v, grid)
    assert together.shape == (3, 2, 4, 5)
    for i in range(3):
        alone = weights.with_tensors((weights.tensors[0][i : i + 1],))
        close(together[i : i + 1], apply_form(div_curl_form(2, alone), v, grid))


def test_constants_cost_nothing_and_equal_weights_leave_no_coupling_inside():
    grid = Grid((6, 5, 7), (1.0, 0.5, 2.0))
    form = div_curl_form(3, Weights())
    close(
        apply_form(form, torch.ones(1, 3, *grid.shape, dtype=torch.float64), grid),
        torch.zeros(1, 3, *grid.shape).double(),
    )
    v = random_field(grid)
    v[:, 1:] = 0
    inside = apply_form(form, v, grid)[:, 1:, 1:-1, 1:-1, 1:-1]
    assert not inside.any()


@pytest.mark.parametrize("grid", [Grid((3, 4), (0.5, 1.3)), Grid((2, 2, 2), (0.7, 1.0, 1.4))])
def test_first_and_second_derivatives(grid):
    form = div_curl_form(grid.dim, Weights(2.0, 0.5, 0.1))
    v = random_field(grid, batch=1).requires_grad_()
    assert gradcheck(lambda t: apply_form(form, t, grid), v)
    assert gradgradcheck(lambda t: apply_form(form, t, grid).square().sum(), v, fast_mode=True)
    data = random_field(grid, 1 + len(CURL_PAIRS[grid.dim]), batch=1).requires_grad_()
    rows = form[: data.shape[1]]
    assert gradcheck(lambda t: assemble_load(rows, t, grid), data)

    def by_weight(field, *tensors):
        return apply_form(div_curl_form(grid.dim, Weights(*tensors)), field, grid)

    for weights in (
        [element_values(grid)] * 3,
        [torch.tensor([1.5], dtype=torch.float64).view(1, 1, *[1] * grid.dim)] * 3,
    ):
        tensors = tuple(w.clone().requires_grad_() for w in weights)
        assert gradcheck(by_weight, (v, *tensors))
        assert gradgradcheck(lambda *t: by_weight(*t).square().sum(), (v, *tensors), fast_mode=True)

    def by_coefficient(field, c):
        return apply_form((Row(1.0, (Term(c, 0, 1), Term(1.0, 1, 0))),), field, grid).square().sum()

    first_two = v.detach()[:, :2].clone().requires_grad_()
    coefficient = element_values(grid, points=2**grid.dim).requires_grad_()
    assert gradcheck(by_coefficient, (first_two, coefficient))
    assert gradgradcheck(by_coefficient, (first_two, coefficient), fast_mode=True)


def test_a_constrained_matrix_solves_with_the_values_lifted():
    grid = Grid((4, 5), (1.0, 0.7))
    form, fixed = div_curl_form(2, Weights(2.0, 1.0)), fixed_unknowns("dirichlet", grid)
    exact = random_field(grid, batch=1)
    load = apply_form(form, exact, grid)
    matrix = constrain_matrix(assemble(form, grid), fixed)
    close(matrix.to_dense(), matrix.to_dense().T)
    right = lift(lambda v: apply_form(form, v, grid), load, exact, fixed)
    solved = torch.linalg.solve(matrix.to_dense(), right.flatten()).view_as(exact) + exact.masked_fill(~fixed, 0)
    close(solved, exact, atol=1e-12)


def test_element_matrices_of_constant_forms_are_kept_once():
    grid = Grid((9, 9, 9))
    assert element_matrices(div_curl_form(3, Weights()), grid).shape == (1, 24, 24, 1, 1, 1)
    assert components(gradient_form(3)) == 1


def test_wrong_input_is_refused():
    grid, form = Grid((4, 5)), div_curl_form(2, Weights())
    with pytest.raises(InputError, match="apply_form: v must have shape"):
        apply_form(form, torch.zeros(1, 3, 4, 5), grid)
    with pytest.raises(InputError, match="assemble_load: data must have shape"):
        assemble_load(form, torch.zeros(1, 3, 4, 5), grid)
    with pytest.raises(InputError, match="one set of coefficients, got a batch of 2"):
        assemble(div_curl_form(2, Weights(torch.ones(2, 1, 3, 4))), grid)
