"""The operator of a form without its matrix: equal to brute force, differentiable, one item like the next."""

import pytest
import torch
from forms import GRIDS, WEIGHTS, close, element_values, random_field, random_form
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.assembly import assemble
from torchdeform.fem.form import Form, Row, Term, curl_form, div_curl_form, div_form
from torchdeform.fem.operator import apply_form, assemble_load, form_diagonal
from torchdeform.fem.quadrature import apply_by_quadrature, load_by_quadrature
from torchdeform.fem.weights import Weights
from torchdeform.solvers.cg import to_csr


def uneven_weights(grid: Grid) -> list[Tensor]:
    """w_div, w_curl, w_zero, w_strain by element; divergence or curl is by far the dearer in most of them."""
    div, curl, zero, strain = (element_values(grid) for _ in range(4))
    return [div * 30 ** (2 * torch.rand_like(div) - 1), curl, zero, strain]


def data_form(dim: int, weights: Weights) -> tuple[Form, list[int]]:
    """The rows of divergence and curl, and which channel of (divergence, curl) each has."""
    div, curl = div_form(dim, weights), curl_form(dim, weights)
    turns = list(range(1, 1 + len(CURL_PAIRS[dim])))
    return (*div, *curl), [*[0] * len(div), *turns, *turns]


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
    weights = uneven_weights(grid)
    oracle = brute(grid.shape, grid.spacing)
    matrix = oracle.matrix(oracle.div_curl(*(w[0, 0].numpy() for w in weights)), grid.dim)
    form, v = div_curl_form(grid.dim, Weights(*weights)), random_field(grid)
    assembled = assemble(form, grid)
    close(assembled.to_dense(), matrix)
    want = (v.flatten(1) @ matrix).view_as(v)
    close(apply_form(form, v, grid), want)
    close((to_csr(assembled) @ v.flatten(1).T).T.view_as(v), want)
    close(form_diagonal(form, grid, v).flatten(), matrix.diagonal())


@pytest.mark.parametrize("weights", [(2.0, 0.5), (1.0, 1.0), (0.5, 2.0)])
@pytest.mark.parametrize("grid", GRIDS)
def test_right_hand_sides_equal_brute_force(brute, grid, weights):
    form, channels = data_form(grid.dim, Weights(*weights))
    data, oracle = random_field(grid, 1 + max(channels)), brute(grid.shape, grid.spacing)
    want = torch.stack([oracle.load(oracle.div_curl(*weights), item, grid.dim) for item in data])
    close(assemble_load(form, data, grid, channels).flatten(1), want)
    close(load_by_quadrature(form, data, grid, channels).flatten(1), want)


@pytest.mark.parametrize("grid", GRIDS)
def test_right_hand_sides_with_weights_by_element_equal_brute_force(brute, grid):
    div, curl, *_ = uneven_weights(grid)
    (form, channels), oracle = data_form(grid.dim, Weights(div, curl)), brute(grid.shape, grid.spacing)
    data = random_field(grid, 1 + max(channels), batch=1)
    want = oracle.load(oracle.div_curl(div[0, 0].numpy(), curl[0, 0].numpy()), data[0], grid.dim)
    close(assemble_load(form, data, grid, channels).flatten(), want)


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


def test_weights_that_vary_over_the_batch_spread_one_field():
    grid = Grid((4, 5))
    v, weights = random_field(grid, batch=1), Weights(element_values(grid, batch=3), 2.0)
    together = apply_form(div_curl_form(2, weights), v, grid)
    assert together.shape == (3, 2, 4, 5)
    for i in range(3):
        alone = weights.with_tensors((weights.tensors[0][i : i + 1],))
        close(together[i : i + 1], apply_form(div_curl_form(2, alone), v, grid))


@pytest.mark.parametrize("grid", [Grid((3, 4), (0.5, 1.3)), Grid((2, 2, 2), (0.7, 1.0, 1.4))])
def test_first_and_second_derivatives(grid):
    form = div_curl_form(grid.dim, Weights(2.0, 0.5, 0.1, 0.7))
    v = random_field(grid, batch=1).requires_grad_()
    assert gradcheck(lambda t: apply_form(form, t, grid), v)
    assert gradgradcheck(lambda t: apply_form(form, t, grid).square().sum(), v, fast_mode=True)
    data = random_field(grid, 1 + len(CURL_PAIRS[grid.dim]), batch=1).requires_grad_()
    rows = form[: data.shape[1]]
    assert gradcheck(lambda t: assemble_load(rows, t, grid), data)

    def by_weight(field, *tensors):
        return apply_form(div_curl_form(grid.dim, Weights(*tensors)), field, grid)

    for weights in (
        uneven_weights(grid),
        [torch.tensor([1.5], dtype=torch.float64).view(1, 1, *[1] * grid.dim)] * 4,
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


def test_wrong_input_is_refused():
    grid, form = Grid((4, 5)), div_curl_form(2, Weights())
    with pytest.raises(InputError, match="apply_form: v must have shape"):
        apply_form(form, torch.zeros(1, 3, 4, 5), grid)
    with pytest.raises(InputError, match="assemble_load: data must have shape"):
        assemble_load(form, torch.zeros(1, 3, 4, 5), grid)
    with pytest.raises(InputError, match="one set of coefficients, got a batch of 2"):
        assemble(div_curl_form(2, Weights(torch.ones(2, 1, 3, 4))), grid)
