"""The rows of a weak form: what they leave alone, and what costs nothing."""

import torch
from forms import close, element_values, random_field
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.form import div_curl_form
from torchdeform.fem.operator import apply_form, form_diagonal
from torchdeform.fem.weights import Weights

SHAPES = st.lists(st.integers(2, 6), min_size=2, max_size=3)
SPACINGS = st.lists(st.floats(0.1, 10.0), min_size=3, max_size=3)
PRICES = st.floats(1e-2, 1e4)


def turning(grid: Grid) -> Tensor:
    """A rigid motion: v = W x + c with W skew."""
    turn = torch.randn(grid.dim, grid.dim, dtype=torch.float64)
    motion = torch.einsum("ka,ba...->bk...", turn - turn.T, grid.points(dtype=torch.float64))
    return motion + torch.randn(1, grid.dim, *[1] * grid.dim, dtype=torch.float64)


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


@settings(max_examples=25, deadline=None)
@given(SHAPES, SPACINGS, PRICES, PRICES, st.booleans())
def test_a_rigid_motion_costs_nothing_where_rotation_is_not_priced(shape, spacing, div, strain, by_element):
    grid = Grid(tuple(shape), tuple(spacing[: len(shape)]))
    factor = element_values(grid) if by_element else 1.0
    form = div_curl_form(grid.dim, Weights(div * factor, 0.0, 0.0, strain * factor))
    motion = turning(grid)
    size = float((form_diagonal(form, grid, motion) * motion.abs()).max())
    torch.testing.assert_close(apply_form(form, motion, grid) / size, torch.zeros_like(motion), rtol=0, atol=1e-12)
    held = div_curl_form(grid.dim, Weights(div * factor, 0.0, 0.3, strain * factor))
    only = div_curl_form(grid.dim, Weights(1e-300, 0.0, 0.3, 1e-300))
    close(apply_form(held, motion, grid) / size, apply_form(only, motion, grid) / size, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(SHAPES, SPACINGS, st.tuples(PRICES, st.floats(0.0, 1e4), st.floats(0.0, 1.0), PRICES))
def test_the_form_is_symmetric_and_nothing_costs_less_than_nothing(shape, spacing, prices):
    grid = Grid(tuple(shape), tuple(spacing[: len(shape)]))
    form = div_curl_form(grid.dim, Weights(*(p * element_values(grid) for p in prices)))
    v, w = random_field(grid, batch=1), random_field(grid, batch=1)
    size = float((form_diagonal(form, grid, v) * v.abs()).max())
    there, back = (apply_form(form, v, grid) * w).sum(), (apply_form(form, w, grid) * v).sum()
    assert abs(float(there - back)) <= 1e-12 * size * float(w.abs().sum() + v.abs().sum())
    assert float((apply_form(form, v, grid) * v).sum()) >= -1e-12 * size
