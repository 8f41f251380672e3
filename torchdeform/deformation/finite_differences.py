"""Least squares on finite differences: rows like the divergence and the curl of a field, 0 where the boundary gives it.

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
from torchdeform.core.resampling import box_sum
from torchdeform.fem.boundary import FIXES
from torchdeform.solvers.cg import dots
from torchdeform.solvers.sine_cosine import Kind, Kinds, separable_transform


@dataclass(frozen=True)
class Differences:
    """The rows of a field, and of a map, by finite differences.

    Args:
        grid: the grid.
        order: 2 or 4.
        boundary: which components are given on the boundary: ``dirichlet``, all; ``slip``, those that lead out.
    """

    grid: Grid
    order: int
    boundary: str = "dirichlet"

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
        """Return the transpose of `rows` with the weights of the nodes, 0 where the boundary gives v: Aᵀ W rows.

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
        return clear_boundary(total, self.grid, self.boundary)

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
        """Return the inverse of Aᵀ W A, nearly, for C = I and fields like ``like (B, D, *S)`` by fast transforms.

        Differences along different axes commute, up to the nodes next to the boundary. So for fields that vanish there,
        or whose normal component does, div and curl together give Σ_a ∂_aᵀ ∂_a for each component: sines along the
        axes where it is given, cosines along those where it is free. Of sin(π j i/(n − 1)) the kernel of ∂_a makes
        s_j cos(π j i/(n − 1)), and Σ_a s² is the eigenvalue. It is as small for waves from node to node as for the
        longest ones: nothing but the boundary holds those either, and elements, which see them, are no substitute.
        """
        fixes = FIXES[self.boundary]
        dim = self.grid.dim
        kinds: Kinds = tuple(tuple("sine" if fixes(k, a) else "cosine" for a in range(dim)) for k in range(dim))
        inverse = torch.stack([self._inverse_squares(along, like) for along in kinds])
        return lambda r: separable_transform(separable_transform(r, kinds) * inverse, kinds)

    def _inverse_squares(self, kinds: tuple[Kind, ...], like: Tensor) -> Tensor:
        """Return 1/Σ_a s² over the squared lengths of the modes of one component, ``(*S)``."""
        total, length = like.new_zeros(self.grid.shape), like.new_ones(self.grid.shape)
        for a, (kind, n) in enumerate(zip(kinds, self.grid.shape, strict=True)):
            shape = [n if b == a else 1 for b in range(self.grid.dim)]
            squares = like.new_full((n,), (n - 1) / 2)
            if kind == "cosine":
                squares[[0, -1]] = n - 1
            total += _symbol(self.grid, a, self.order, kind, like).square().view(shape)
            length *= squares.view(shape)
        return 1 / (total * length)


def _symbol(grid: Grid, axis: int, order: int, kind: Kind, like: Tensor) -> Tensor:
    """Return s_j of the inner kernel, ``(n,)``; at both ends 0 for cosines, and 1 for sines, which vanish there."""
    interior, n = KERNELS[order][0], grid.shape[axis]
    theta = torch.arange(n, dtype=torch.float64, device="cpu") * (math.pi / (n - 1))
    half = len(interior) // 2
    symbol = sum((2 * interior[half + k] * torch.sin(k * theta) for k in range(1, half + 1)), torch.zeros_like(theta))
    symbol = symbol / grid.spacing[axis]
    symbol[[0, -1]] = 1.0 if kind == "sine" else 0.0
    return symbol.to(like)


def clear_boundary(field: Tensor, grid: Grid, boundary: str = "dirichlet") -> Tensor:
    """Set a field ``(B, D, *S)`` to 0 in place where the boundary gives it, and return it."""
    for (k, axis), end in product(product(range(field.shape[1]), range(grid.dim)), (0, -1)):
        if FIXES[boundary](k, axis):
            field[:, k].select(axis + 1, end).zero_()
    return field


def continued(field: Tensor, known: Tensor) -> Tensor:
    """Return a field with numbers where it is not known, smooth ones next to where it is.

    Args:
        field: ``(B, C, *S)``, anything where it is not known.
        known: ``(B, C, *S)`` of bool; a channel without a known node becomes 0.

    Returns:
        ``(B, C, *S)``: layer by layer the mean of the parabolas through three known nodes in a row along an axis, as
        many layers as there are axes, so that the edges of the box follow its faces; beyond, the mean of the known
        neighbours. No number lies beyond the known ones by more than half of their range.
    """
    field, dims = field.masked_fill(~known, 0), tuple(range(2, field.dim()))
    low = field.masked_fill(~known, math.inf).amin(dims, keepdim=True)
    high = field.masked_fill(~known, -math.inf).amax(dims, keepdim=True)
    low, high = low - (high - low) / 2, high + (high - low) / 2
    layers = 0
    while True:
        value, weight = _parabolas(field, known) if layers < len(dims) else _neighbours(field, known)
        new = (weight > 0) & ~known
        if not bool(new.any()) and layers >= len(dims):
            return field
        value = torch.minimum(torch.maximum(value / weight.clamp(min=1e-6), low), high)
        field, known, layers = torch.where(new, value, field), known | new, layers + 1


def _parabolas(field: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum of 3 a − 3 b + c over the directions in which the next three nodes are known, and their number."""
    total, number = torch.zeros_like(field), torch.zeros_like(field)
    for axis in range(2, field.dim()):
        count = field.shape[axis] - 3
        for to, first, step in ((0, 1, 1), (3, 2, -1)):
            if count < 1:
                continue
            places = [first + k * step for k in range(3)]
            a, b, c = (field.narrow(axis, place, count) for place in places)
            p, q, r = (known.narrow(axis, place, count) for place in places)
            there = p & q & r
            total.narrow(axis, to, count).add_((3 * a - 3 * b + c) * there)
            number.narrow(axis, to, count).add_(there)
    return total, number


def _neighbours(field: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return the sum over the known neighbours, and how many there are."""
    return box_sum(field * known, 3), box_sum(known.to(field), 3)
