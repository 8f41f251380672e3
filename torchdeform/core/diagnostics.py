"""What a map did: determinants, folds by the full certificate, and how well two maps invert each other."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, product
from operator import itemgetter

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, LEAST_ROWS, by_slabs, jacobian_determinant
from torchdeform.core.grid import Grid, slabs
from torchdeform.core.warp import compose, voxels

# The frames of steps that span the simplices around a node: (steps, ends, determinant). A step goes along one or two
# axes; each tuple of ends is a frame whose k-th step is forward (0) or backward (1). Edges of cells combine in any
# mixture: 4 frames in 2D, 8 in 3D. In 3D the face diagonals, all forward or all backward, span the inner tetrahedra
# that the edges leave out. The determinant is that of the steps themselves, so the identity gives 1 everywhere.
_FRAMES = {
    2: ((((1, 0), (0, 1)), tuple(product((0, 1), repeat=2)), 1.0),),
    3: (
        (((1, 0, 0), (0, 1, 0), (0, 0, 1)), tuple(product((0, 1), repeat=3)), 1.0),
        (((1, 1, 0), (0, 1, 1), (1, 0, 1)), ((0, 0, 0), (1, 1, 1)), 2.0),
    ),
}

# Determinants are raised to this before their logarithm is taken.
LOG_FLOOR = 1e-9


@dataclass(frozen=True)
class Diagnosis:
    """What the map φ = id + u did to the grid; every field has one entry per batch item ``(B,)``.

    Attributes:
        det_min: smallest J = det ∇φ over the nodes, central differences, one-sided of second order at the boundary.
        det_max: largest J.
        det_mean: mean of J.
        det_log_std: standard deviation of log J; J below 1e-9, folds among them, counts as 1e-9.
        smallest: smallest of all one-sided determinants, see `one_sided_determinant`.
        folds: nodes where any one-sided determinant is not positive; 0 certifies a digital diffeomorphism.
        central_folds: nodes where the determinant of central differences is not positive, u being continued by its
            boundary values. It misses folds that alternate from node to node; for comparison with the literature.
    """

    det_min: Tensor
    det_max: Tensor
    det_mean: Tensor
    det_log_std: Tensor
    smallest: Tensor
    folds: Tensor
    central_folds: Tensor

    @property
    def diffeomorphic(self) -> Tensor:
        """True for the items without a fold by the full certificate, ``(B,)``."""
        return self.folds == 0


@torch.no_grad()
def diagnose(u: Tensor, grid: Grid) -> Diagnosis:
    """Return determinants and folds of φ = id + u.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        A `Diagnosis`, each field ``(B,)``.

    Raises:
        InputError: shape, or fewer than 3 nodes along an axis.

    Notes:
        NaN counts as a fold. Not differentiable. ``folds`` and ``central_folds`` are the counts of Liu et al., "On
        Finite Difference Jacobian Computation in Deformable Image Registration", IJCV 2024.
    """
    det = by_slabs(jacobian_determinant, u, grid).flatten(1)
    lowest = one_sided_determinant(u, grid).flatten(1)
    return Diagnosis(
        det_min=det.amin(1),
        det_max=det.amax(1),
        det_mean=det.mean(1),
        det_log_std=det.clamp(min=LOG_FLOOR).log().std(1),
        smallest=lowest.amin(1),
        folds=_count_folds(lowest),
        central_folds=_count_folds(by_slabs(_central_determinant, u, grid).flatten(1)),
    )


def _count_folds(det: Tensor) -> Tensor:
    return (~(det > 0)).sum(1)  # not (det <= 0), which NaN would pass


def _central_determinant(u: Tensor, grid: Grid) -> Tensor:
    """Return det ∇φ by central differences at every node, u being continued by its boundary values."""
    wider = Grid(tuple(n + 2 for n in grid.shape), grid.spacing)
    det = jacobian_determinant(F.pad(u, (1, 1) * grid.dim, mode="replicate"), wider)
    for axis, n in zip(grid.axes, grid.shape, strict=True):
        det = det.narrow(axis, 1, n)
    return det


def smallest_determinant(u: Tensor, grid: Grid) -> Tensor:
    """Return the smallest of all one-sided determinants of φ = id + u over the nodes.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``(B,)``, no unit: positive if and only if φ is a digital diffeomorphism; NaN where u is NaN.

    Raises:
        InputError: shape.

    Notes:
        Made for the inner loop of a registration: takes about as long as sampling u once in 3D. Not differentiable.
    """
    grid.check_vector(u, "smallest_determinant: u")
    return torch.stack([slab.flatten(1).amin(1) for slab in _lowest_by_slab(u, grid)]).amin(0)


def one_sided_determinant(u: Tensor, grid: Grid) -> Tensor:
    """Return at each node the smallest of its one-sided determinants det[φ(x + s_k) − φ(x)] / det[s_k].

    The steps s_1, .., s_D from the node x are forward or backward edges of the grid's cells in any mixture (4 frames in
    2D, 8 in 3D), in 3D also the three forward or the three backward face diagonals (10 frames in all). Each value is
    the signed volume of a moved simplex over its volume before. Beyond the boundary u keeps its boundary values.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``(B, 1, *S)``, no unit: positive everywhere if and only if φ is a digital diffeomorphism.

    Raises:
        InputError: shape.

    Notes:
        Liu et al., IJCV 2024. Unlike the central differences these see every node, and where all are positive the
        interpolation of φ on the simplices keeps its orientation. Not differentiable.
    """
    grid.check_vector(u, "one_sided_determinant: u")
    return torch.cat([slab.clone() for slab in _lowest_by_slab(u, grid)], dim=1).unsqueeze(1)


_Vector = tuple[Tensor, ...]  # D components, each ``(B, length)``


class _Buffers:
    """Memory that is asked for by name again and again, with the type and device of one tensor."""

    def __init__(self, like: Tensor) -> None:
        self._like = like
        self._memory: dict[str, Tensor] = {}

    def get(self, name: str, *shape: int) -> Tensor:
        """Return an uninitialised tensor of this shape in the memory of that name."""
        size = math.prod(shape)
        if name not in self._memory or self._memory[name].numel() < size:
            self._memory[name] = self._like.new_empty(size)
        return self._memory[name][:size].view(shape)


@torch.no_grad()
def _lowest_by_slab(u: Tensor, grid: Grid) -> Iterator[Tensor]:
    """Yield the smallest determinant of each node as ``(B, rows, *S[1:])``, slab after slab along the first axis.

    A slab is valid until the next one is asked for: all use the same memory, because the page faults of fresh
    temporaries take longer than the arithmetic.
    """
    buffers = _Buffers(u)
    for rows in slabs((grid.shape[0], u[:, 0, 0].numel()), u.device, least=LEAST_ROWS):
        yield _lowest(_padded_slab(u, grid, rows.start, rows.stop, buffers), buffers)


def _padded_slab(u: Tensor, grid: Grid, start: int, stop: int, buffers: _Buffers) -> Tensor:
    """Return rows start − 1 to stop of u in voxels, with one more node on every side that repeats the boundary."""
    low, high = max(start - 1, 0), min(stop + 1, grid.shape[0])
    padded = buffers.get("padded", *u.shape[:2], stop - start + 2, *(n + 2 for n in grid.shape[1:]))
    inside = padded.narrow(2, low - start + 1, high - low)
    for axis in grid.axes[1:]:
        inside = inside.narrow(axis, 1, u.shape[axis])
    torch.div(u.narrow(2, low, high - low), grid.along(grid.spacing, u), out=inside)
    for axis in grid.axes:
        last = padded.shape[axis] - 1
        if axis > 2 or low == start:
            padded.select(axis, 0).copy_(padded.select(axis, 1))
        if axis > 2 or high == stop:
            padded.select(axis, last).copy_(padded.select(axis, last - 1))
    return padded


def _lowest(padded: Tensor, buffers: _Buffers) -> Tensor:
    """Return the smallest determinant over all frames at the inner nodes of a padded slab.

    The slab is read as one long row of nodes in which a step is a constant stride, so everything runs over contiguous
    memory. What comes out at the padding, where the row wraps around, means nothing and is left out at the end.
    """
    (items, dim, *shape), strides = padded.shape, padded.stride()[2:]
    length = math.prod(shape) - 2 * sum(strides)
    lowest = buffers.get("lowest", items, length).fill_(math.inf)
    for steps, frames, volume in _FRAMES[dim]:
        moved = [_moved_step(padded, step, buffers.get(f"step {k}", *padded.shape)) for k, step in enumerate(steps)]
        for det in _determinants(moved, frames, buffers):
            torch.minimum(lowest, det if volume == 1 else det.div_(volume), out=lowest)
    return lowest.as_strided((items, *(n - 2 for n in shape)), (length, *strides))


def _moved_step(padded: Tensor, step: tuple[int, ...], memory: Tensor) -> tuple[_Vector, _Vector]:
    """Return φ(x + s) − φ(x) and φ(x) − φ(x − s) in voxels over the row of nodes."""
    row, moved, strides = padded.flatten(2), memory.flatten(2), padded.stride()[2:]
    stride, margin = sum(s * n for s, n in zip(step, strides, strict=True)), sum(strides)
    count, length = row.shape[2] - stride, row.shape[2] - 2 * margin
    torch.sub(row[..., stride:], row[..., :count], out=moved[..., :count])
    for component, moves in enumerate(step):
        if moves:
            moved[:, component].add_(1)
    return moved.narrow(2, margin, length).unbind(1), moved.narrow(2, margin - stride, length).unbind(1)


def _determinants(
    moved: list[tuple[_Vector, _Vector]], frames: tuple[tuple[int, ...], ...], buffers: _Buffers
) -> Iterator[Tensor]:
    """Yield det[moved steps] = x · n for each frame; n, the normal of all steps but the first, is shared by frames."""
    dim, shape = len(moved), moved[0][0][0].shape
    normal, det = buffers.get("normal", dim, *shape).unbind(0), buffers.get("det", *shape)
    ends_of_others = itemgetter(slice(1, None))
    for ends, group in groupby(sorted(frames, key=ends_of_others), key=ends_of_others):
        _NORMAL[dim](*(ways[end] for ways, end in zip(moved[1:], ends, strict=True)), out=normal)
        for first, *_ in group:
            yield _dot(moved[0][first], normal, out=det)


def _dot(a: _Vector, b: _Vector, *, out: Tensor) -> Tensor:
    torch.mul(a[0], b[0], out=out)
    for x, y in zip(a[1:], b[1:], strict=True):
        out.addcmul_(x, y)
    return out


def _perpendicular(a: _Vector, *, out: _Vector) -> None:
    out[0].copy_(a[1])
    torch.neg(a[0], out=out[1])


def _cross(a: _Vector, b: _Vector, *, out: _Vector) -> None:
    for component, (i, j) in zip(out, CURL_PAIRS[3], strict=True):
        torch.mul(a[i], b[j], out=component).addcmul_(a[j], b[i], value=-1)


# The vector n with x · n = det[x, others].
_NORMAL = {2: _perpendicular, 3: _cross}


@torch.no_grad()
def inverse_error(u: Tensor, w: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Return mean and maximum over the nodes x of |φ(ψ(x)) − x| for φ = id + u and ψ = id + w.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        w: displacement of the map that should be its inverse, the same shape.
        grid: the grid of both.

    Returns:
        Mean and maximum per item, each ``(B,)``, in voxels.

    Raises:
        InputError: shapes.

    Notes:
        Points that ψ takes out of Ω see φ's displacement at the nearest boundary point. Not differentiable.
    """
    grid.check_vector(u, "inverse_error: u")
    grid.check_vector(w, "inverse_error: w")
    distance = voxels(compose(u, w, grid), grid).flatten(1)
    return distance.mean(1), distance.amax(1)
