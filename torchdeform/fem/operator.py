"""What a system needs of a form: its operator, right-hand sides and diagonal, each by the cheapest exact way."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import reduce

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.elements import Factor, at_corners, components, gauss_weight, row_table
from torchdeform.fem.form import Coefficient, Form, Row
from torchdeform.fem.kronecker import Product, apply_products
from torchdeform.fem.quadrature import apply_by_quadrature, load_by_quadrature, scatter


def apply_form(form: Form, v: Tensor, grid: Grid) -> Tensor:
    """Return A v, the load Σ_rows ∫ weight · row(v) · row(N) for every test function N, without a matrix.

    Args:
        form: the form.
        v: nodal values ``(B, C, *S)``.
        grid: the grid.

    Returns:
        ``(B, C, *S)``.

    Raises:
        InputError: shape.

    Notes:
        Self-adjoint. Coefficients constant over space are applied as Kronecker products, others by quadrature, both
        exactly. Differentiable in v and in tensors among the coefficients, to every degree.
    """
    grid.check(v, "apply_form: v", components=components(form))
    if not _constant(form):
        return apply_by_quadrature(form, v, grid)
    return _sum_by_weight(form, lambda rows: apply_products(_energy(rows, grid.dim), v, grid, v.shape[1]))


def assemble_load(form: Form, data: Tensor, grid: Grid, channels: Sequence[int] | None = None) -> Tensor:
    """Return the right-hand side Σ_rows ∫ weight · data_row · row(N), data being Q1 between its nodal values.

    Args:
        form: the form.
        data: nodal values ``(B, R, *S)``, one channel per row of the form.
        grid: the grid.
        channels: which channel each row has, where rows share them.

    Returns:
        ``(B, C, *S)``.

    Raises:
        InputError: shape.

    Notes:
        Exact and differentiable as `apply_form`.
    """
    channels = range(len(form)) if channels is None else channels
    grid.check(data, "assemble_load: data", components=1 + max(channels))
    if not _constant(form):
        return load_by_quadrature(form, data, grid, channels)
    count = components(form)
    return _sum_by_weight(form, lambda rows: apply_products(_work(rows, channels, grid.dim), data, grid, count))


def form_diagonal(form: Form, grid: Grid, like: Tensor) -> Tensor:
    """Return the diagonal of A, ``(B, C, *S)`` with the type and device of ``like``."""
    corners = reduce(torch.add, [_squares(row, grid, components(form), like.device) for row in form])
    elements = [n - 1 for n in grid.shape]
    return scatter(corners.to(like).unflatten(1, (components(form), -1)).expand(-1, -1, -1, *elements))


def _squares(row: Row, grid: Grid, count: int, device: torch.device) -> Tensor:
    """Return ∫ weight · row(N_i)² for every element, ``(B, count·2^D, *E)``."""
    squares = row_table(row, grid, count, device) ** 2 * gauss_weight(grid, row.centre)
    if isinstance(row.weight, Tensor) and row.weight.dim() > 0 and row.weight.shape[1] > 1:
        return (squares * at_corners(row.weight)).sum(1)
    # One weight per element: summing first keeps it from being spread over the Gauss points.
    return squares.sum(1) * row.weight


def _constant(form: Form) -> bool:
    """True when terms have numbers and weights do not vary over space."""
    numbers = all(not isinstance(t.coefficient, Tensor) for row in form for t in row.terms)
    return numbers and all(not isinstance(row.weight, Tensor) or row.weight.shape[1:].numel() == 1 for row in form)


_Rows = list[tuple[int, Row]]


def _sum_by_weight(form: Form, apply: Callable[[_Rows], Tensor]) -> Tensor:
    """Return Σ weight · apply(rows), once for all rows whose weight is a number and once for each tensor of weights."""
    groups: dict[int | None, tuple[Coefficient, _Rows]] = {}
    for index, row in enumerate(form):
        tensor = isinstance(row.weight, Tensor)
        entry = (index, replace(row, weight=1.0) if tensor else row)
        groups.setdefault(id(row.weight) if tensor else None, (row.weight if tensor else 1.0, []))[1].append(entry)
    parts = [apply(rows) if key is None else weight * apply(rows) for key, (weight, rows) in groups.items()]
    return reduce(torch.add, parts)


def _energy(rows: Iterable[tuple[int, Row]], dim: int) -> tuple[Product, ...]:
    """The products of row(N_i) with row(N_j), from component to component."""
    return tuple(
        (
            float(row.weight) * float(s.coefficient) * float(t.coefficient),
            s.component,
            t.component,
            _factors(s.axis, t.axis, dim, row.centre),
        )
        for _, row in rows
        for s in row.terms
        for t in row.terms
    )


def _work(rows: Iterable[tuple[int, Row]], channels: Sequence[int], dim: int) -> tuple[Product, ...]:
    """The products of row(N_i) with the values of the data, from channel to component."""
    return tuple(
        (
            float(row.weight) * float(t.coefficient),
            t.component,
            channels[index],
            _factors(t.axis, None, dim, row.centre),
        )
        for index, row in rows
        for t in row.terms
    )


def _factors(test: int | None, trial: int | None, dim: int, centre: bool) -> tuple[Factor, ...]:
    return tuple((test == axis, trial == axis, centre and axis not in (test, trial)) for axis in range(dim))
