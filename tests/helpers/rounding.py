"""Equality to rounding: of what differs in nothing but the order of its sums, or in the kernel that a library takes.

A library for products of matrices takes another kernel for another processor, shape, number of threads or alignment of
the memory. So a batch gives the results of its items to rounding, not bit for bit, wherever there is such a product.
"""

import torch
from torch import Tensor

from torchdeform.core.grid import Grid


def assert_same_to_rounding(
    got: Tensor, want: Tensor, terms: int, condition: float = 1.0, size: float | None = None
) -> None:
    """Assert |got − want| ≤ terms · condition · eps · size.

    Args:
        got: what one way gave.
        want: what the other way gave.
        terms: products in the longest sum; of a chain of sums, all of them together. Two orders of summation differ by
            terms · eps · Σ|product| at most.
        condition: how much larger Σ|product| may be than the largest result; of a solve, the condition of its matrix.
        size: what the results are compared with, max|want| when None.
    """
    assert got.dtype == want.dtype
    assert got.shape == want.shape
    bound = terms * condition * torch.finfo(want.dtype).eps * (float(want.abs().max()) if size is None else size)
    apart = float((got - want).abs().max())
    assert apart <= bound, f"apart by {apart:.3g} > {bound:.3g}"


def terms_of_a_solve(grid: Grid) -> int:
    """Return the products in the sums of a solve by sine and cosine transforms: there and back along every axis."""
    return 2 * sum(grid.shape)


def condition_of_a_solve(grid: Grid, weights: float = 1.0) -> float:
    """Return a bound for the largest eigenvalue of a Laplacian of elements by its smallest one that is not zero.

    The largest is Σ 12/h² at most, the smallest (π/L)² of the longest side L at least; ``weights`` is the ratio of the
    largest to the smallest weight of a form.
    """
    return weights * sum(12 / h**2 for h in grid.spacing) * (max(grid.extent) / torch.pi) ** 2
