"""Forms, fields and grids that the tests of the finite elements share."""

from functools import partial

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.form import Form, Row, Term

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


GRIDS = [Grid((4, 6), (0.5, 1.3)), Grid((2, 3), (1.0, 0.2)), Grid((3, 4, 3), (0.7, 1.0, 1.4)), Grid((2, 2, 2))]


# w_div, w_curl, w_zero, w_strain: alike, apart so that some is looked at in the centres alone, and with strain.
WEIGHTS = [
    (1.0, 1.0, 0.0, 0.0),
    (2.0, 2.0, 0.3, 0.0),
    (3.0, 0.5, 0.0, 0.0),
    (0.2, 4.0, 0.6, 0.0),
    (1.0, 1.5, 0.1, 2.0),
    (7.0, 0.0, 0.2, 5.0),
    (0.3, 9.0, 0.0, 4.0),
]


close = partial(torch.testing.assert_close, atol=1e-13, rtol=1e-13)


def random_field(grid: Grid, channels: int | None = None, batch: int = 2, dtype=torch.float64) -> Tensor:
    return torch.randn(batch, grid.dim if channels is None else channels, *grid.shape, dtype=dtype)


def element_values(grid: Grid, batch: int = 1, points: int = 1) -> Tensor:
    return 0.5 + torch.rand(batch, points, *[n - 1 for n in grid.shape], dtype=torch.float64)


def random_form(grid: Grid, points: int) -> Form:
    """Rows with coefficients at will, as a linearised determinant would have: all derivatives in the first row."""
    terms = [Term(element_values(grid, points=points), k, a) for k in range(grid.dim) for a in range(grid.dim)]
    second = (Term(-0.7, 0, None), Term(element_values(grid, points=points), grid.dim - 1, 0))
    return (Row(element_values(grid, points=points), tuple(terms)), Row(2.0, second))
