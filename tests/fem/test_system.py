"""The div-curl system: loads, products, diagonal and matrix say the same, whatever is given where."""

import pytest
import torch
from torch.autograd import gradcheck

from torchdeform.core.grid import Grid
from torchdeform.fem.boundary import Face
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights

GRIDS = [Grid((5, 6), (0.5, 1.3)), Grid((3, 4, 3), (0.7, 1.0, 1.4))]
BOUNDARIES = ["slip", "no_slip_tangential", "dirichlet", "free"]
WEIGHTS = Weights(2.0, 0.7, 0.3)


def field(grid: Grid, channels: int | None = None, batch: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(batch, channels or grid.dim, *grid.shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("grid", GRIDS)
def test_the_matrix_is_the_operator(grid, boundary):
    system = DivCurlSystem(grid, WEIGHTS, boundary)
    v, matrix = field(grid), system.matrix()
    assert matrix.layout == torch.sparse_coo
    torch.testing.assert_close(matrix, matrix.T.coalesce())
    product = (matrix @ v.flatten(1).T).T.view_as(v)
    given = system.fixed().expand_as(v)
    torch.testing.assert_close(product.masked_fill(given, 0), system.apply(v), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(product[given], v[given])  # the identity there
    diagonal = matrix.to_dense().diagonal().view(1, *v.shape[1:])
    free = ~system.fixed()
    torch.testing.assert_close(diagonal[free], system.diagonal(v)[free], rtol=1e-12, atol=0)


@pytest.mark.parametrize("grid", GRIDS)
def test_unknowns_that_are_fixed_besides(grid):
    inside = torch.zeros(1, grid.dim, *grid.shape, dtype=torch.bool)
    inside[(0, slice(None), *(n // 2 for n in grid.shape))] = True
    system = DivCurlSystem(grid, WEIGHTS, "slip", inside)
    v = field(grid)
    assert not system.apply(v)[inside.expand_as(v)].any()
    assert not system.free(v)[inside.expand_as(v)].any()
    torch.testing.assert_close(
        (system.matrix() @ v.flatten(1).T).T.view_as(v)[inside.expand_as(v)], v[:, :, inside[0, 0]].flatten()
    )


@pytest.mark.parametrize("grid", GRIDS)
def test_loads_are_the_work_that_is_done(grid):
    """The load of (div w, curl w) is what K without w_zero does to w, that of a force what M does; all add up."""
    weights = Weights(2.0, 0.7)
    whole, plain = DivCurlSystem(grid, WEIGHTS, "free"), DivCurlSystem(grid, weights, "free")
    linear = grid.points(dtype=torch.float64) * 0.3 + 0.1  # its divergence is constant and its curl zero
    div = torch.full((1, 1, *grid.shape), 0.3 * grid.dim, dtype=torch.float64)
    torch.testing.assert_close(plain.load(div=div), plain.apply(linear))
    force = field(grid, batch=1)
    torch.testing.assert_close(whole.load(force=force), whole.mass(force))
    torch.testing.assert_close(whole.load(div=div, force=force), plain.load(div=div) + whole.mass(force))


def test_given_values_are_lifted_into_the_load():
    grid = GRIDS[0]
    system = DivCurlSystem(grid, WEIGHTS, "dirichlet")
    values, alpha = field(grid), field(grid, 1)
    load = system.load(div=alpha, values=values)
    edges = values.masked_fill(~system.fixed(), 0)
    unlifted = DivCurlSystem(grid, WEIGHTS, "free")
    torch.testing.assert_close(load, system.free(unlifted.load(div=alpha) - unlifted.apply(edges)))


def test_products_are_differentiable_in_the_weights():
    grid = Grid((4, 3), (0.5, 1.0))
    boundary = dict.fromkeys((Face(a, s) for a in range(2) for s in (0, 1)), "slip")
    weight = (torch.rand(1, 1, 3, 2, dtype=torch.float64) + 0.5).requires_grad_()
    system = DivCurlSystem(grid, Weights(weight, 0.7, 0.3), boundary)
    assert system.parameters == (weight,)
    assert gradcheck(lambda v, w: system.apply(v, w), (field(grid, batch=1).requires_grad_(), weight))
