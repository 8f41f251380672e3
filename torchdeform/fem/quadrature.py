"""Forms with any coefficients applied without a matrix: element by element, row by row at the Gauss points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.elements import components, gauss_table, gauss_weight
from torchdeform.fem.form import Coefficient, Form, map_coefficients

# Elements worked on at once: on a CPU what is known of them (some 8 MB) stays near, elsewhere few launches matter.
_SLAB, _LARGE_SLAB = 1 << 15, 1 << 20


def apply_by_quadrature(form: Form, v: Tensor, grid: Grid) -> Tensor:
    """Return Σ_rows ∫ weight · row(v) · row(N) for every test function N.

    Args:
        form: the form, with coefficients constant or varying by element or Gauss point.
        v: nodal values ``(B, C, *S)``.
        grid: the grid.

    Returns:
        ``(B, C, *S)``.

    Notes:
        Exact for coefficients up to linear in each element. Differentiable in v and in the coefficients, to every
        degree. Temporaries are those of one slab of elements.
    """
    return _by_slabs(form, v, grid, evaluate)


def load_by_quadrature(form: Form, data: Tensor, grid: Grid, channels: Sequence[int]) -> Tensor:
    """Return Σ_rows ∫ weight · data_row · row(N) for every test function N, data being Q1 between its nodal values.

    Args:
        form: the form.
        data: nodal values ``(B, R, *S)``.
        grid: the grid.
        channels: which channel each row has.

    Returns:
        ``(B, C, *S)``.

    Notes:
        As `apply_by_quadrature`.
    """

    def rows_of(local: Form, field: Tensor, slab: Grid) -> list[Tensor]:
        found = {centre: interpolate(field, slab, centre) for centre in {row.centre for row in local}}
        return [found[row.centre][:, channel] for channel, row in zip(channels, local, strict=True)]

    return _by_slabs(form, data, grid, rows_of)


def evaluate(form: Form, v: Tensor, grid: Grid) -> list[Tensor]:
    """Return row(v) at the Gauss points of every element.

    Args:
        form: the form; its weights play no part.
        v: nodal values ``(B, C, *S)``.
        grid: the grid.

    Returns:
        One ``(B, Q, *E)`` per row; Q = 2^D, or 1 for a row at the centre, E_a = n_a − 1.
    """
    corners, elements = _corners(v), [n - 1 for n in grid.shape]
    derivatives: dict[tuple[int, int | None, bool], Tensor] = {}
    rows = []
    for row in form:
        total = None
        for coefficient, k, axis in row.terms:
            key = k, axis, row.centre
            if key not in derivatives:
                table = gauss_table(axis, grid.spacing, v.dtype, v.device, row.centre)
                derivatives[key] = _product(table, corners[:, k]).unflatten(2, elements)
            total = _plus(total, derivatives[key], coefficient)
        rows.append(total)
    return rows


def interpolate(field: Tensor, grid: Grid, centre: bool = False) -> Tensor:
    """Return nodal ``(B, C, *S)`` at the Gauss points of every element, or at its centre, ``(B, C, Q, *E)``."""
    table = gauss_table(None, grid.spacing, field.dtype, field.device, centre)
    values = _product(table, _corners(field).flatten(0, 1))
    return values.view(*field.shape[:2], -1, *[n - 1 for n in grid.shape])


def adjoint(form: Form, rows: list[Tensor], grid: Grid) -> Tensor:
    """Return Σ_rows ∫ rows · row(N) for every test function N: `evaluate` transposed, with the Gauss weights.

    Args:
        form: the form; its weights play no part.
        rows: values at the Gauss points, one ``(B, Q, *E)`` per row.
        grid: the grid.

    Returns:
        ``(B, C, *S)``.
    """
    sums: dict[tuple[int, int | None, bool], Tensor] = {}
    for row, values in zip(form, rows, strict=True):
        for coefficient, k, axis in row.terms:
            key = k, axis, row.centre
            sums[key] = _plus(sums.get(key), values, coefficient)
    batch, elements = max(s.shape[0] for s in sums.values()), [n - 1 for n in grid.shape]
    load = rows[0].new_zeros(batch, components(form), 2**grid.dim, *elements)
    for (k, axis, centre), values in sums.items():
        table = gauss_table(axis, grid.spacing, load.dtype, load.device, centre).T * gauss_weight(grid, centre)
        load[:, k] += _product(table, values.flatten(2)).unflatten(2, elements)
    return scatter(load)


def _by_slabs(form: Form, field: Tensor, grid: Grid, rows_of: Callable[[Form, Tensor, Grid], list[Tensor]]) -> Tensor:
    """Return the adjoint of weight · rows_of(form, field), slab by slab along the first axis."""
    elements, out = [n - 1 for n in grid.shape], None
    layers = elements[0]
    # Whatever the batch, the slabs are the same, and so are the sums over them.
    layer = math.prod(elements[1:])
    thickness = max(1, (_SLAB if field.device.type == "cpu" else _LARGE_SLAB) // layer)
    for start in range(0, layers, thickness):
        size = min(thickness, layers - start)
        slab, local = replace(grid, shape=(size + 1, *grid.shape[1:])), _restrict(form, start, size)
        rows = rows_of(local, field.narrow(2, start, size + 1), slab)
        load = adjoint(local, [values * row.weight for row, values in zip(local, rows, strict=True)], slab)
        out = load.new_zeros(*load.shape[:2], *grid.shape) if out is None else out
        out.narrow(2, start, size + 1).add_(load)
    return field if out is None else out


def _restrict(form: Form, start: int, size: int) -> Form:
    """Return the form on ``size`` layers of elements from ``start`` on."""

    def layers(c: Tensor) -> Tensor:
        # (B, Q, *E): axis 2 is the first of the elements.
        return c.narrow(2, start, size) if c.dim() > 0 and c.shape[2] > 1 else c

    return map_coefficients(form, layers)


def _plus(total: Tensor | None, value: Tensor, coefficient: Coefficient) -> Tensor:
    if isinstance(coefficient, Tensor):
        return value * coefficient if total is None else total + value * coefficient
    if total is None:
        return value if coefficient == 1 else value * coefficient
    return torch.add(total, value, alpha=coefficient)


def _product(table: Tensor, columns: Tensor) -> Tensor:
    """Return table @ columns for each item: bmm on an expanded table copies nothing, which matmul does not promise."""
    return torch.bmm(table.expand(columns.shape[0], *table.shape), columns)


def _corners(field: Tensor) -> Tensor:
    """Return the values at the corners of every element, ``(B, C, 2^D, elements)`` from ``(B, C, *S)``."""
    dim = field.dim() - 2
    for axis in range(dim):
        field = field.unfold(axis + 2, 2, 1)
    order = (0, 1, *range(2 + dim, 2 + 2 * dim), *range(2, 2 + dim))
    return field.permute(order).flatten(2 + dim).flatten(2, 1 + dim)


def scatter(values: Tensor) -> Tensor:
    """Add up the corners of all elements at their nodes, ``(B, C, *S)`` from ``(B, C, 2^D, *E)``."""
    elements = values.shape[3:]
    out = values.new_zeros(*values.shape[:2], *[e + 1 for e in elements])
    for corner, offset in enumerate(product((0, 1), repeat=len(elements))):
        target = out
        for axis, (first, size) in enumerate(zip(offset, elements, strict=True)):
            target = target.narrow(2 + axis, first, size)
        target.add_(values[:, :, corner])
    return out
