"""Finite differences as convolution kernels: derivative, divergence, curl, Jacobian matrix and determinant."""

from itertools import permutations

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.grid import Grid

# order -> (interior kernel, one-sided kernels for the first nodes); the last nodes mirror them with the sign turned.
KERNELS: dict[int, tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]] = {
    2: ((-1 / 2, 0, 1 / 2), ((-3 / 2, 2, -1 / 2),)),
    4: (
        (1 / 12, -8 / 12, 0, 8 / 12, -1 / 12),
        ((-25 / 12, 4, -3, 4 / 3, -1 / 4), (-1 / 4, -5 / 6, 3 / 2, -1 / 2, 1 / 12)),
    ),
}

# The curl in each dimension: component c is ∂_a u_b − ∂_b u_a for the c-th pair (a, b).
CURL_PAIRS: dict[int, tuple[tuple[int, int], ...]] = {2: ((0, 1),), 3: ((1, 2), (2, 0), (0, 1))}

_CONV = {2: F.conv2d, 3: F.conv3d}


def derivative(field: Tensor, grid: Grid, axis: int, *, order: int = 2) -> Tensor:
    """Return ∂_axis of every channel by finite differences, one-sided with the same order at the boundary.

    Args:
        field: ``(B, C, *S)``, any unit.
        grid: the grid it lives on.
        axis: array axis, 0 to D − 1.
        order: 2 or 4.

    Returns:
        ``(B, C, *S)``, the field's unit per unit of spacing.

    Raises:
        InputError: shape, order, or an axis too short for the kernel.

    Notes:
        Exact on polynomials of degree ``order``; error O(h^order). Linear, so differentiable to every degree.
    """
    grid.check(field, "derivative: field")
    if order not in KERNELS:
        raise InputError(f"derivative: order must be 2 or 4, got {order}")
    interior, first = KERNELS[order]
    if grid.shape[axis] < len(interior):
        raise InputError(f"derivative: order {order} needs {len(interior)} nodes along axis {axis}, got {grid.shape}")
    parts = [_edge(field, axis, first, 1.0), _convolve(field, grid, axis, interior), _edge(field, axis, first, -1.0)]
    return torch.cat(parts, dim=axis + 2) / grid.spacing[axis]


def _convolve(field: Tensor, grid: Grid, axis: int, kernel: tuple[float, ...]) -> Tensor:
    weight = torch.tensor(kernel, dtype=field.dtype, device=field.device)
    weight = weight.view(1, 1, *(len(kernel) if k == axis else 1 for k in range(grid.dim)))
    flat = field.reshape(-1, 1, *grid.shape)
    return _CONV[grid.dim](flat, weight).unflatten(0, field.shape[:2]).squeeze(2)


def _edge(field: Tensor, axis: int, kernels: tuple[tuple[float, ...], ...], sign: float) -> Tensor:
    """Apply the one-sided kernels at the first nodes (sign 1), or their mirror images at the last ones (sign −1)."""
    weight = torch.tensor(kernels, dtype=field.dtype, device=field.device) * sign
    start = 0
    if sign < 0:
        weight, start = weight.flip(0, 1), field.shape[axis + 2] - weight.shape[1]
    nodes = field.narrow(axis + 2, start, weight.shape[1]).movedim(axis + 2, -1)
    return (nodes @ weight.T).movedim(-1, axis + 2)


def jacobian(field: Tensor, grid: Grid, *, order: int = 2) -> Tensor:
    """Return the matrix of derivatives G[k, a] = ∂_a field_k as ``(B, C, D, *S)``.

    Args:
        field: ``(B, C, *S)``.
        grid: the grid it lives on.
        order: 2 or 4.

    Raises:
        InputError: as `derivative`.
    """
    return torch.stack([derivative(field, grid, a, order=order) for a in range(grid.dim)], dim=2)


def divergence(field: Tensor, grid: Grid, order: int = 2) -> Tensor:
    """Return div u = Σ_k ∂_k u_k.

    Args:
        field: ``(B, D, *S)``, units of spacing.
        grid: the grid it lives on.
        order: 2 or 4.

    Returns:
        ``(B, 1, *S)``, no unit.

    Raises:
        InputError: as `derivative`.
    """
    grid.check_vector(field, "divergence: field")
    return sum_derivatives([(field[:, k : k + 1], k, 1.0) for k in range(grid.dim)], grid, order)


def curl(field: Tensor, grid: Grid, order: int = 2) -> Tensor:
    """Return curl u: ∂0 u1 − ∂1 u0 in 2D, (∂1 u2 − ∂2 u1, ∂2 u0 − ∂0 u2, ∂0 u1 − ∂1 u0) in 3D.

    Args:
        field: ``(B, D, *S)``, units of spacing.
        grid: the grid it lives on.
        order: 2 or 4.

    Returns:
        ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, no unit. Components follow array axes: in array order z, y, x
        this is minus the curl written in x, y, z.

    Raises:
        InputError: as `derivative`.
    """
    grid.check_vector(field, "curl: field")
    pairs = CURL_PAIRS[grid.dim]
    return torch.cat(
        [sum_derivatives([(field[:, b : b + 1], a, 1.0), (field[:, a : a + 1], b, -1.0)], grid, order) for a, b in pairs],
        dim=1,
    )


def sum_derivatives(terms: list[tuple[Tensor, int, float]], grid: Grid, order: int) -> Tensor:
    """Return Σ sign · ∂_axis field over the ``(field, axis, sign)`` terms."""
    total = None
    for field, axis, sign in terms:
        term = derivative(field, grid, axis, order=order) * sign
        total = term if total is None else total + term
    if total is None:
        raise InputError("sum_derivatives: no terms")
    return total


def determinant(matrix: Tensor) -> Tensor:
    """Return det M of ``(B, D, D, *S)`` as ``(B, 1, *S)`` by Leibniz' formula, D being 2 or 3."""
    dim = matrix.shape[1]
    total = torch.zeros_like(matrix[:, 0, 0])
    for columns in permutations(range(dim)):
        term = matrix[:, 0, columns[0]]
        for row in range(1, dim):
            term = term * matrix[:, row, columns[row]]
        total = total + term * parity(columns)
    return total.unsqueeze(1)


def parity(permutation: tuple[int, ...]) -> int:
    """Return the sign of a permutation, (−1) to the number of its inversions."""
    inversions = sum(a > b for i, a in enumerate(permutation) for b in permutation[i + 1 :])
    return -1 if inversions % 2 else 1


def jacobian_determinant(u: Tensor, grid: Grid, order: int = 2) -> Tensor:
    """Return J = det ∇φ of the map φ = id + u by finite differences.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: the grid it lives on.
        order: 2 or 4.

    Returns:
        ``(B, 1, *S)``; 1 keeps the volume, below 1 shrinks it (fixed to moving), 0 or less folds.

    Raises:
        InputError: as `derivative`.

    Notes:
        J > 0 with central differences is no proof that φ does not fold; `diagnose` has the full certificate.
    """
    grid.check_vector(u, "jacobian_determinant: u")
    eye = torch.eye(grid.dim, dtype=u.dtype, device=u.device).view(1, grid.dim, grid.dim, *([1] * grid.dim))
    return determinant(jacobian(u, grid, order=order) + eye)
