"""Finite differences as kernels: derivative, divergence, curl, Jacobian matrix, determinant and cofactors."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.grid import Grid, over_slabs
from torchdeform.errors import InputError, require_choice

# order -> (interior kernel, one-sided kernels for the first nodes); the last nodes mirror them with the sign turned.
KERNELS: dict[int, tuple[tuple[float, ...], tuple[tuple[float, ...], ...]]] = {
    2: ((-1 / 2, 0, 1 / 2), ((-3 / 2, 2, -1 / 2),)),
    4: (
        (1 / 12, -8 / 12, 0, 8 / 12, -1 / 12),
        ((-25 / 12, 4, -3, 4 / 3, -1 / 4), (-1 / 4, -5 / 6, 3 / 2, -1 / 2, 1 / 12)),
    ),
}

# Rows of a slab at least, because the two next to it are computed with it.
LEAST_ROWS = 4

# The curl in each dimension: component c is ∂_a u_b − ∂_b u_a for the c-th pair (a, b).
CURL_PAIRS: dict[int, tuple[tuple[int, int], ...]] = {2: ((0, 1),), 3: ((1, 2), (2, 0), (0, 1))}


def derivative(field: Tensor, grid: Grid, axis: int, *, order: int = 2, by: str = "auto") -> Tensor:
    """Return ∂_axis of every channel by finite differences, one-sided with the same order at the boundary.

    Args:
        field: ``(B, C, *S)``, any unit.
        grid: the grid it lives on.
        axis: array axis, 0 to D − 1.
        order: 2 or 4.
        by: ``convolution`` (`conv2d` or `conv3d` with `kernel_weights`), ``shifts`` (sums of shifted fields), or
            ``auto``, whichever is faster on the device; they agree to rounding.

    Returns:
        ``(B, C, *S)``, the field's unit per unit of spacing.

    Raises:
        InputError: shape, axis, order, way, or an axis too short for the kernel.

    Notes:
        Exact on polynomials of degree ``order``; error O(h^order). Linear, so differentiable to every degree. With
        order 2 an axis of only two nodes has their difference at both.
    """
    grid.check(field, "derivative: field")
    require_choice(axis, range(grid.dim), "derivative: axis")
    require_choice(order, KERNELS, "derivative: order")
    require_choice(by, _WAYS, "derivative: by")
    (interior, first), apply = KERNELS[order], _WAYS[by]
    if grid.shape[axis] == order == 2:
        difference = field.diff(dim=axis + 2) / grid.spacing[axis]
        return torch.cat([difference, difference], dim=axis + 2)
    if grid.shape[axis] < len(interior):
        raise InputError(f"derivative: order {order} needs {len(interior)} nodes along axis {axis}, got {grid.shape}")
    step, dim = grid.spacing[axis], axis + 2
    last = tuple(tuple(-w for w in reversed(kernel)) for kernel in reversed(first))
    width = len(interior)
    head, tail = field.narrow(dim, 0, width), field.narrow(dim, field.shape[dim] - width, width)
    parts = [
        *(_by_shifts(head, dim, kernel, step) for kernel in first),
        apply(field, dim, interior, step),
        *(_by_shifts(tail, dim, kernel, step) for kernel in last),
    ]
    return torch.cat(parts, dim=dim)


def add_adjoint_derivative(total: Tensor, field: Tensor, grid: Grid, axis: int, *, order: int = 2) -> None:
    """Add D_aᵀ field to ``total``, in place, D_a being `derivative`: Σ y D_a x = Σ x D_aᵀ y for all x and y.

    Args:
        total: ``(B, C, *S)``.
        field: the same shape.
        grid: the grid of both.
        axis: spatial axis of the derivative, from 0.
        order: 2 or 4.
    """
    (interior, first), dim, n = KERNELS[order], axis + 2, grid.shape[axis]
    if n == order == 2:
        both = field.sum(dim) / grid.spacing[axis]
        total.select(dim, 0).sub_(both)
        total.select(dim, 1).add_(both)
        return
    step, count = grid.spacing[axis], grid.shape[axis] - len(KERNELS[order][0]) + 1
    inner = field.narrow(dim, len(first), count)
    for k, weight in enumerate(interior):
        if weight:
            total.narrow(dim, k, count).add_(inner, alpha=weight / step)
    for row, kernel in enumerate(first):
        for k, weight in enumerate(kernel):
            total.select(dim, k).add_(field.select(dim, row), alpha=weight / step)
            total.select(dim, n - 1 - k).sub_(field.select(dim, n - 1 - row), alpha=weight / step)


def kernel_weights(kernel: Sequence[float], axis: int, dim: int, like: Tensor, step: float = 1.0) -> Tensor:
    """Return a kernel as the weights ``(1, 1, *k)`` of `conv2d` or `conv3d`, along one of ``dim`` array axes.

    Args:
        kernel: weights of neighbouring nodes, as in `KERNELS`.
        axis: array axis, 0 to D − 1.
        dim: D.
        like: a tensor with the type and device wanted.
        step: spacing along the axis.
    """
    shape = [1, 1, *(len(kernel) if a == axis else 1 for a in range(dim))]
    return torch.tensor([w / step for w in kernel], dtype=torch.float64, device="cpu").view(shape).to(like)


def _by_convolution(field: Tensor, dim: int, kernel: tuple[float, ...], step: float) -> Tensor:
    """Return Σ_k kernel_k field(x + k h) / h where the kernel fits, each channel by itself."""
    axes = field.dim() - 2
    weights = kernel_weights(kernel, dim - 2, axes, field, step)
    cudnn = torch.backends.cudnn
    # TF32, which cuDNN takes by itself, would leave 10 bits.
    with cudnn.flags(enabled=cudnn.enabled, allow_tf32=False) if field.is_cuda else nullcontext():
        inner = _CONVOLVE[axes](field.flatten(0, 1).unsqueeze(1), weights)
    return inner.view(*field.shape[:2], *_kept(field, dim, kernel))


def _kept(field: Tensor, dim: int, kernel: tuple[float, ...]) -> list[int]:
    """Return the spatial shape that is left where a kernel fits."""
    return [n - len(kernel) + 1 if a == dim else n for a, n in enumerate(field.shape) if a > 1]


def _by_shifts(field: Tensor, dim: int, kernel: tuple[float, ...], step: float) -> Tensor:
    """Return the same by shifted sums."""
    count = field.shape[dim] - len(kernel) + 1
    (weight, start), *others = [(w / step, k) for k, w in enumerate(kernel) if w]
    total = field.narrow(dim, start, count) * weight
    for weight, start in others:
        total = total.add(field.narrow(dim, start, count), alpha=weight)
    return total


_CONVOLVE = {2: F.conv2d, 3: F.conv3d}

# ``auto`` is by shifts: convolution takes 1.4 to 8 times as long on one thread of a CPU (64² to 1024², 32³ to 128³) and
# 1.6 to 11 times on an H100 (512² to 160×192×224); see ``scripts/benchmarks/kernels.py``.
_WAYS = {"auto": _by_shifts, "shifts": _by_shifts, "convolution": _by_convolution}


def jacobian(field: Tensor, grid: Grid, *, order: int = 2) -> Tensor:
    """Return the matrix of derivatives G[k, a] = ∂_a field_k.

    Args:
        field: ``(B, C, *S)``, any unit.
        grid: the grid it lives on.
        order: 2 or 4.

    Returns:
        ``(B, C, D, *S)``, the field's unit per unit of spacing.

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

    Notes:
        As `derivative`, which it is made of.
    """
    grid.check_vector(field, "divergence: field")
    first, *others = [derivative(field[:, k : k + 1], grid, k, order=order) for k in range(grid.dim)]
    return sum(others, start=first)


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

    Notes:
        As `derivative`, which it is made of. div curl u = 0 to rounding: derivatives along different axes commute.
    """
    grid.check_vector(field, "curl: field")

    def partial(axis: int, component: int) -> Tensor:
        return derivative(field[:, component : component + 1], grid, axis, order=order)

    return torch.cat([partial(a, b) - partial(b, a) for a, b in CURL_PAIRS[grid.dim]], dim=1)


def determinant(matrix: Tensor) -> Tensor:
    """Return det M of ``(B, D, D, *S)`` as ``(B, 1, *S)`` by Laplace's expansion; differentiable."""
    return _expand([list(row.unbind(1)) for row in matrix.unbind(1)]).unsqueeze(1)


def cofactors(matrix: Tensor) -> Tensor:
    """Return C = ∂ det M / ∂M of ``(B, D, D, *S)``, the same shape, so that M⁻¹ = Cᵀ / det M; differentiable."""
    rows, dim = [list(row.unbind(1)) for row in matrix.unbind(1)], matrix.shape[1]
    flat = [(-1) ** (k + a) * _expand(_minor(rows, k, a)) for k, a in product(range(dim), repeat=2)]
    return torch.stack(flat, dim=1).unflatten(1, (dim, dim))


def _expand(rows: list[list[Tensor]]) -> Tensor:
    """Return the determinant of a matrix of tensors, expanded along its first row."""
    if len(rows) == 1:
        return rows[0][0]
    total = rows[0][0] * _expand(_minor(rows, 0, 0))
    for column in range(1, len(rows)):
        total = torch.addcmul(total, rows[0][column], _expand(_minor(rows, 0, column)), value=(-1) ** column)
    return total


def _minor(rows: list[list[Tensor]], row: int, column: int) -> list[list[Tensor]]:
    return [r[:column] + r[column + 1 :] for k, r in enumerate(rows) if k != row]


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
    return determinant(map_jacobian(u, grid, order=order))


def map_jacobian(u: Tensor, grid: Grid, *, order: int = 2) -> Tensor:
    """Return ∇φ = I + ∇u of the map φ = id + u as ``(B, D, D, *S)``; arguments and errors as `jacobian_determinant`."""
    grid.check_vector(u, "jacobian: u")
    eye = torch.eye(grid.dim, dtype=u.dtype, device=u.device).view(1, grid.dim, grid.dim, *([1] * grid.dim))
    return jacobian(u, grid, order=order) + eye


@torch.no_grad()
def by_slabs(function: Callable[[Tensor, Grid], Tensor], u: Tensor, grid: Grid) -> Tensor:
    """Return function(u, grid) ``(B, C, *S)``, computed by slabs of rows so that what it needs on the way is small.

    Args:
        function: of a field and its grid; looks no farther than one node inside, three at the faces.
        u: ``(B, D, *S)``.
        grid: its grid.
    """
    return over_slabs(lambda rows: slab_of(function, u, grid, rows), grid.shape, u.device, least=LEAST_ROWS)


def slab_of(function: Callable[[Tensor, Grid], Tensor], u: Tensor, grid: Grid, rows: slice) -> Tensor:
    """Return some rows of function(u, grid), computed from them and those next to them; see `by_slabs`."""
    last = grid.shape[0]
    low, high = max(min(rows.start - 1, last - 3), 0), min(max(rows.stop + 1, 3), last)
    part = Grid((high - low, *grid.shape[1:]), grid.spacing)
    return function(u.narrow(2, low, high - low), part)[:, :, rows.start - low : rows.stop - low]
