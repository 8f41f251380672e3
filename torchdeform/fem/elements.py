"""Q1 elements on a box: everything is a Kronecker product of 2×2 matrices of the unit interval.

Corners and Gauss points of an element are numbered like ``itertools.product((0, 1), repeat=D)``, the last axis fastest.
"""

import math

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.tables import kept
from torchdeform.fem.form import Coefficient, Form, Row

# With N_0 = 1 − x, N_1 = x on an interval of length h: whether the test and the trial function are differentiated, and
# whether the product of two that are not is taken in the middle alone (others are the same there)
# -> (the matrix for h = 1, the power of h it takes). Row = test function, column = trial function.
Matrix = tuple[tuple[float, float], tuple[float, float]]
MASS: Matrix = ((1 / 3, 1 / 6), (1 / 6, 1 / 3))
STIFFNESS: Matrix = ((1.0, -1.0), (-1.0, 1.0))
MIXED: Matrix = ((-1 / 2, -1 / 2), (1 / 2, 1 / 2))
MIXED_TRANSPOSED: Matrix = ((-1 / 2, 1 / 2), (-1 / 2, 1 / 2))
MEAN: Matrix = ((1 / 4, 1 / 4), (1 / 4, 1 / 4))
Factor = tuple[bool, bool, bool]
INTERVAL: dict[Factor, tuple[Matrix, int]] = {
    (False, False, False): (MASS, 1),
    (False, False, True): (MEAN, 1),
    (True, True, False): (STIFFNESS, -1),
    (True, False, False): (MIXED, 0),
    (False, True, False): (MIXED_TRANSPOSED, 0),
}

# Two Gauss points make ∫ of cubics along each axis exact: enough for coefficient · ∂N · ∂N with a linear coefficient.
GAUSS = (0.5 - math.sqrt(1 / 12), 0.5 + math.sqrt(1 / 12))
CENTRE = (0.5,)


@kept(64)
def gauss_table(
    axis: int | None, spacing: tuple[float, ...], dtype: torch.dtype, device: torch.device, centre: bool = False
) -> Tensor:
    """Return ∂_axis N_i (N_i for None) at the Gauss points q, or at the ``centre`` alone, ``(2^D or 1, 2^D)``.

    Entry [q, i]. Not to be written to.
    """
    places = CENTRE if centre else GAUSS
    values = torch.tensor([[1 - x, x] for x in places], dtype=torch.float64, device="cpu")
    slopes = torch.tensor([[-1.0, 1.0]] * len(places), dtype=torch.float64, device="cpu")
    product = torch.ones(1, 1, dtype=torch.float64, device="cpu")
    for a, h in enumerate(spacing):
        product = torch.kron(product, slopes / h if a == axis else values)
    return product.to(dtype=dtype, device=device)


def gauss_weight(grid: Grid, centre: bool = False) -> float:
    """Return the weight of each Gauss point, Π h_k / 2^D, or of the ``centre``, Π h_k."""
    return grid.cell_volume if centre else grid.cell_volume / 2**grid.dim


def components(form: Form) -> int:
    """Return the number of components of the fields that a form takes."""
    return 1 + max(term.component for row in form for term in row.terms)


def row_table(row: Row, grid: Grid, count: int, device: torch.device) -> Tensor:
    """Return row(N_i) at the Gauss points of every element, ``(B, Q, count·2^D, *E)`` float64, unknown k·2^D + corner.

    Q is 2^D, or 1 for a row at the centre. B and E_a are 1 where no coefficient varies; ``count`` is the number of
    components of the form.
    """
    ones = [1] * grid.dim
    points = 1 if row.centre else 2**grid.dim
    parts = [torch.zeros(1, points, 2**grid.dim, *ones, dtype=torch.float64, device=device)] * count
    for term in row.terms:
        table = gauss_table(term.axis, grid.spacing, torch.float64, device, row.centre).unflatten(1, [-1, *ones])
        parts[term.component] = parts[term.component] + table * at_corners(term.coefficient)
    whole = torch.broadcast_tensors(*parts)  # `broadcast_shapes` would import sympy
    return torch.cat(whole, dim=2)


def element_matrices(form: Form, grid: Grid, device: torch.device | str = "cpu") -> Tensor:
    """Return Σ_rows ∫ weight · row(N_i) · row(N_j) for every element.

    Args:
        form: the form.
        grid: the grid.
        device: where the coefficients lie.

    Returns:
        ``(B, m, m, *E)`` float64, m = C·2^D unknowns numbered k·2^D + corner; B and E_a are 1 where no coefficient
        varies.

    Notes:
        Exact for coefficients up to linear in each element. Differentiable in the coefficients.
    """
    total = torch.zeros((), dtype=torch.float64, device=device)
    for row in form:
        table = row_table(row, grid, components(form), total.device)
        weighted = table * at_corners(row.weight) * gauss_weight(grid, row.centre)
        total = total + torch.einsum("bqi...,bqj...->bij...", *torch.broadcast_tensors(weighted, table))
    return total


def at_corners(coefficient: Coefficient) -> Coefficient:
    """Give a coefficient ``(B, Q, *E)`` the axis over which shape functions run: ``(B, Q, 1, *E)``."""
    return coefficient.unsqueeze(2) if isinstance(coefficient, Tensor) and coefficient.dim() > 0 else coefficient
