"""What weights by element cost beyond constant ones, on the elements where they differ: K = A + Cᵀ e C.

A is the matrix of constant weights, the base, e ≠ 0 on few elements in most maps of tissue. On the corners of an
element each kind of row (divergence exactly, at the centre, ..) is a constant symmetric matrix; its eigenvectors,
scaled, are the rows of C. So a product takes one small matrix there and one back, for those elements alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.elements import element_matrices
from torchdeform.fem.form import Form, curl_form, div_form, strain_form, value_form
from torchdeform.fem.weights import Weight, Weights

# Divergence exactly and at the centres, curl likewise, change of shape, velocity.
KINDS = ("div", "div_centre", "curl", "curl_centre", "strain", "zero")

# Elements worked on at once: on a CPU what is known of them stays near, elsewhere few launches matter.
_SLAB, _LARGE_SLAB = 1 << 12, 1 << 20


class Excess:
    """C and e of K = A + Cᵀ e C, as tensors like ``like``.

    Args:
        grid: the grid.
        weights: the weights of K.
        base: those of A, constant over space.
        like: a tensor with the type and device of the fields.

    Attributes:
        kinds: which kinds of row there are, of `KINDS`.
        excess: e, one ``(B or 1, 1, M)`` for each of them, M elements.
        rows: how many rows each has.
    """

    def __init__(self, grid: Grid, weights: Weights, base: Weights, like: Tensor) -> None:
        self.grid = grid
        over = excesses(weights, base, grid, like)
        active = torch.stack([(o != 0).flatten(0, 1).any(0) for o in over]).any(0)
        self.excess, self.kinds, tables = [], [], []
        for kind, some, form in zip(KINDS, over, _unit_forms(grid.dim), strict=True):
            if bool(some.any()):
                self.kinds.append(kind)
                self.excess.append(some[:, :, active])
                tables.append(_modes(form, grid))
        self.rows = [len(t) for t in tables]
        self._table = torch.cat(tables).to(like) if tables else like.new_zeros(0, grid.dim * 2**grid.dim)
        self.corners = _corner_numbers(grid, active)
        self._slab = _SLAB if like.device.type == "cpu" else _LARGE_SLAB

    def apply(self, v: Tensor) -> Tensor:
        """Return Cᵀ e C v ``(B, D, *S)``."""
        flat = v.flatten(2)
        out = torch.zeros_like(flat)
        for start in range(0, self.corners.shape[1], self._slab):
            part = slice(start, start + self._slab)
            rows = self._table @ _gather(flat, self.corners[:, part])
            for some, e in zip(rows.split(self.rows, dim=1), self.excess, strict=True):
                some *= e[:, :, part]
            _scatter(out, self._table.T @ rows, self.corners[:, part])
        return out.view_as(v)

    def of(self, v: Tensor) -> Tensor:
        """Return C v ``(B, R, M)``."""
        return self._table @ _gather(v.flatten(2), self.corners)

    def transposed(self, p: Tensor) -> Tensor:
        """Return Cᵀ p ``(B, D, *S)``."""
        out = p.new_zeros(p.shape[0], self.grid.dim, self.grid.strides[0] * self.grid.shape[0])
        _scatter(out, self._table.T @ p, self.corners)
        return out.unflatten(2, self.grid.shape)

    def by_row(self, values: Sequence[Tensor]) -> Tensor:
        """Return values of each kind ``(B or 1, 1, M)`` for each of its rows, ``(B or 1, R, M)``."""
        batch = max((len(v) for v in values), default=1)
        return torch.cat([v.expand(batch, n, -1) for v, n in zip(values, self.rows, strict=True)], dim=1)


def _gather(flat: Tensor, corners: Tensor) -> Tensor:
    """Return the values at the corners of elements, ``(B, D 2^D, M)`` from ``(B, D, N)``."""
    return flat[:, :, corners].flatten(1, 2)


def _scatter(out: Tensor, values: Tensor, corners: Tensor) -> None:
    """Add values at the corners of elements to ``out (B, D, N)``, corner by corner: no node has two sums at once."""
    values = values.unflatten(1, (out.shape[1], -1))
    for corner, numbers in enumerate(corners):
        out.scatter_add_(2, numbers.expand(*out.shape[:2], -1), values[:, :, corner])


def _unit_forms(dim: int) -> list[Form]:
    """The rows of each kind for a weight of 1: divergence exactly and at the centres, curl likewise, strain, values."""
    both = [form for rows in (div_form(dim, Weights()), curl_form(dim, Weights())) for form in _by_place(rows)]
    return [*both, strain_form(dim, 1.0), value_form(dim)]


def _by_place(form: Form) -> list[Form]:
    return [tuple(replace(row, weight=1.0) for row in form if row.centre == centre) for centre in (False, True)]


def _kinds(weights: Weights) -> list[Weight]:
    (div, div_centre), (curl, curl_centre) = weights.parts
    return [div, div_centre, curl, curl_centre, weights.strain, weights.zero]


def excesses(weights: Weights, base: Weights, grid: Grid, like: Tensor) -> list[Tensor]:
    """Return by how much each kind of row is dearer than in the base, ``(B or 1, 1, *E)`` each."""
    over = [torch.as_tensor(w - b).to(like) for w, b in zip(_kinds(weights), _kinds(base), strict=True)]
    elements = [n - 1 for n in grid.shape]
    return [(o if o.dim() > 2 else o.reshape(-1, 1, *[1] * grid.dim)).expand(-1, -1, *elements) for o in over]


def _modes(form: Form, grid: Grid) -> Tensor:
    """Return the rows whose squares add up to the form on one element, ``(rank, D 2^D)``."""
    matrix = element_matrices(form, grid).flatten(3)[0, :, :, 0]
    values, vectors = torch.linalg.eigh(matrix)
    there = values > 1e-10 * values[-1]
    return (vectors[:, there] * values[there].sqrt()).T


def _corner_numbers(grid: Grid, active: Tensor) -> Tensor:
    """Return the numbers of the nodes at the corners of the active elements, ``(2^D, M)``."""
    first = (active.nonzero() * torch.tensor(grid.strides, device=active.device)).sum(1)
    offsets = [
        sum(o * s for o, s in zip(offset, grid.strides, strict=True)) for offset in product((0, 1), repeat=grid.dim)
    ]
    return first + torch.tensor(offsets, device=active.device).unsqueeze(1)
