"""What weights by element cost beyond constant ones: with the base it is the whole, and C and Cᵀ are transposed."""

import pytest
import torch
from forms import GRIDS, close, element_values, random_field

from torchdeform.core.grid import Grid
from torchdeform.fem import excess as module
from torchdeform.fem.excess import Excess, excesses
from torchdeform.fem.form import div_curl_form
from torchdeform.fem.operator import apply_form
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.cg import to_csr


def some_dear(grid: Grid, batch: int = 1) -> Weights:
    """Base weights, and here and there others, dearer and cheaper, by any factor."""
    here = torch.rand(batch, 1, *[n - 1 for n in grid.shape]) > 0.6
    here[(0, 0, *[0] * grid.dim)] = True
    div, curl, zero, strain = (element_values(grid, batch) for _ in range(4))
    return Weights(
        torch.where(here, 300 * div, 0.5), torch.where(here, curl, 1.0), torch.where(here, zero, 0.1), here * strain
    )


BASE = Weights(0.5, 1.0, 0.1)


@pytest.mark.parametrize("grid", GRIDS)
def test_base_and_excess_are_the_whole(grid, monkeypatch):
    weights, v = some_dear(grid, 2), random_field(grid)
    want = apply_form(div_curl_form(grid.dim, weights), v, grid)
    plain = apply_form(div_curl_form(grid.dim, BASE), v, grid)
    excess = Excess(grid, weights, BASE, v)
    scale = float(want.abs().max())
    close((plain + excess.apply(v)) / scale, want / scale)
    monkeypatch.setattr(module, "_SLAB", 3)
    close((plain + Excess(grid, weights, BASE, v).apply(v)) / scale, want / scale)
    close(excess.transposed(excess.of(v) * excess.by_row(excess.excess)) / scale, excess.apply(v) / scale)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_transposed_rows_are_transposed(grid):
    v = random_field(grid)
    excess = Excess(grid, some_dear(grid), BASE, v)
    rows = excess.of(v)
    p = torch.randn_like(rows)
    close((rows * p).sum(), (v * excess.transposed(p)).sum(), atol=1e-10)
    assert sum(excess.rows) == rows.shape[1]
    assert excess.kinds == ["div", "div_centre", "curl", "strain", "zero"]


def test_elements_that_cost_what_the_base_costs_play_no_part():
    grid = Grid((6, 5))
    weight = torch.ones(1, 1, 5, 4)
    weight[0, 0, 2, 1] = 7.0
    excess = Excess(grid, Weights(1.0, weight), Weights(), torch.zeros(1, 2, 6, 5))
    assert excess.corners.tolist() == [[11], [12], [16], [17]]
    assert excess.kinds == ["curl", "curl_centre"]
    over = excesses(Weights(1.0, weight), Weights(), grid, weight)
    assert [float(o.max()) for o in over] == [0.0, 0.0, 1.0, 5.0, 0.0, 0.0]


@pytest.mark.parametrize("boundary", ["slip", "free"])
@pytest.mark.parametrize("grid", GRIDS)
def test_all_products_of_a_system_are_equal(grid, boundary):
    """Compressed rows, rows at points element by element, and base and excess, to 1e-12."""
    v = random_field(grid)
    system = DivCurlSystem(grid, some_dear(grid), boundary)
    want = system.apply(v)
    scale = 1 + float(want.abs().max())
    matrix = system.matrix()
    for product in (matrix, to_csr(matrix)):
        got = system.free((product @ system.free(v).flatten(1).T).T.view_as(v))
        torch.testing.assert_close(got / scale, want / scale, rtol=0, atol=1e-12)
    torch.testing.assert_close(system.product(v)(v) / scale, want / scale, rtol=0, atol=1e-12)
