"""Least squares on finite differences: rows like the divergence and the curl of a field that is 0 on the boundary.

The rows are Σ C_ka ∂_a v_k and the components of curl v at all nodes, by the kernels of `derivatives`, one-sided at the
boundary. With C = I the first is the divergence, with the cofactors of ∇φ the linearised determinant. Their squares are
summed with trapezoidal weights. So a field is found again from its own differences to rounding, which elements allow
only up to the square of the spacing.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.derivatives import (
    CURL_PAIRS,
    KERNELS,
    add_adjoint_derivative,
    derivative,
    determinant,
    map_jacobian,
)
from torchdeform.core.grid import Grid
from torchdeform.solvers.cg import dots
from torchdeform.solvers.sine_cosine import Kind, separable_transform


@dataclass(frozen=True)
class Differences:
    """The rows of a field, and of a map, by finite differences.

    Args:
        grid: the grid.
        order: 2 or 4.
    """

    grid: Grid
    order: int

    def rows(self, v: Tensor, factors: Tensor | None = None) -> Tensor:
        """Return (Σ C_ka ∂_a v_k, curl v) at the nodes.

        Args:
            v: ``(B, D, *S)``.
            factors: C ``(B, D, D, *S)``; the identity when None.

        Returns:
            ``(B, 1 + curls, *S)``; one curl in 2D, three in 3D.
        """
        slopes = [derivative(v, self.grid, a, order=self.order) for a in range(self.grid.dim)]
        first = torch.zeros_like(v[:, :1])
        for a, slope in enumerate(slopes):
            if factors is None:
                first = first.add_(slope[:, a : a + 1])
                continue
            for k in range(self.grid.dim):
                first = first.addcmul_(factors[:, k, a : a + 1], slope[:, k : k + 1])
        return torch.cat([first, *self._curls(lambda k, a: slopes[a][:, k : k + 1])], dim=1)

    def of_map(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return ∇φ ``(B, D, D, *S)`` of φ = id + u and its rows (det ∇φ, curl φ) ``(B, 1 + curls, *S)``."""
        matrix = map_jacobian(u, self.grid, order=self.order)
        curls = self._curls(lambda k, a: matrix[:, k, a : a + 1])
        return matrix, torch.cat([determinant(matrix), *curls], dim=1)

    def _curls(self, slope: Callable[[int, int], Tensor]) -> list[Tensor]:
        """Return ∂_a v_b − ∂_b v_a from slope(k, a) = ∂_a v_k."""
        return [slope(b, a) - slope(a, b) for a, b in CURL_PAIRS[self.grid.dim]]

    def adjoint(self, rows: Tensor, factors: Tensor | None = None) -> Tensor:
        """Return the transpose of `rows` with the weights of the nodes, 0 on the boundary: Aᵀ W rows.

        Args:
            rows: ``(B, 1 + curls, *S)``.
            factors: as in `rows`.

        Returns:
            ``(B, D, *S)``.
        """
        rows = self._weighted(rows)
        total = rows.new_zeros(rows.shape[0], self.grid.dim, *self.grid.shape)
        for a in range(self.grid.dim):
            add_adjoint_derivative(total, self._along(a, rows, factors), self.grid, a, order=self.order)
        return clear_boundary(total, self.grid)

    def _along(self, axis: int, rows: Tensor, factors: Tensor | None) -> Tensor:
        """Return what the rows say about ∂_axis of each component, ``(B, D, *S)``."""
        first = rows[:, :1]
        if factors is None:
            total = rows.new_zeros(rows.shape[0], self.grid.dim, *self.grid.shape)
            total[:, axis : axis + 1] += first
        else:
            total = factors[:, :, axis] * first
        for c, (a, b) in enumerate(CURL_PAIRS[self.grid.dim], start=1):
            if axis in (a, b):
                total[:, b if axis == a else a].add_(rows[:, c], alpha=1.0 if axis == a else -1.0)
        return total

    def _weighted(self, rows: Tensor) -> Tensor:
        """Return the rows times what their node counts: 1 inside, 1/2 on faces, 1/4 on edges and so on."""
        rows = rows.clone()
        for axis, end in product(self.grid.axes, (0, -1)):
            rows.select(axis, end).mul_(0.5)
        return rows

    def norm(self, rows: Tensor) -> Tensor:
        """Return √Σ w |rows|² of each item ``(B,)``."""
        return dots(rows, self._weighted(rows)).sqrt()

    def preconditioner(self, like: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the inverse of Aᵀ W A, nearly, for C = I and fields like ``like (B, D, *S)`` by sine transforms.

        For fields that vanish on the boundary differences along different axes commute, up to the nodes next to it, so
        div and curl together give Σ_a ∂_aᵀ ∂_a for each component. Of sin(π j i/(n − 1)) the kernel of ∂_a makes
        s_j cos(π j i/(n − 1)), and Σ_a s² is the eigenvalue. It is as small for waves from node to node as for the
        longest ones: nothing but the boundary holds those either, and elements, which see them, are no substitute.
        """
        squares, scale = [], 1.0
        for a, n in enumerate(self.grid.shape):
            symbol = _symbol(self.grid, a, self.order, like)
            squares.append(symbol.square().view([n if b == a else 1 for b in range(self.grid.dim)]))
            scale *= 2 / (n - 1)  # twice the sine sums of unit length give this back
        inverse = scale / sum(squares[1:], start=squares[0])
        sines: tuple[Kind, ...] = tuple("sine" for _ in self.grid.shape)
        kinds = (sines,) * self.grid.dim
        return lambda r: separable_transform(separable_transform(r, kinds) * inverse, kinds)


def _symbol(grid: Grid, axis: int, order: int, like: Tensor) -> Tensor:
    """Return s_j of the inner kernel, ``(n,)``; 1 at both ends, where sines vanish."""
    interior, n = KERNELS[order][0], grid.shape[axis]
    theta = torch.arange(n, dtype=torch.float64, device="cpu") * (math.pi / (n - 1))
    half = len(interior) // 2
    symbol = sum((2 * interior[half + k] * torch.sin(k * theta) for k in range(1, half + 1)), torch.zeros_like(theta))
    symbol = symbol / grid.spacing[axis]
    symbol[[0, -1]] = 1.0
    return symbol.to(like)


def clear_boundary(field: Tensor, grid: Grid) -> Tensor:
    """Set ``field (B, C, *S)`` to 0 on the boundary, in place, and return it."""
    for axis in grid.axes:
        field.select(axis, 0).zero_()
        field.select(axis, -1).zero_()
    return field
