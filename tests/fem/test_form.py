"""The rows of a weak form: what they leave alone."""

import torch
from forms import close, random_field

from torchdeform.core.grid import Grid
from torchdeform.fem.form import div_curl_form
from torchdeform.fem.operator import apply_form
from torchdeform.fem.weights import Weights


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
