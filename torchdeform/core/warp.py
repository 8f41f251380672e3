"""Sampling images and fields at moved points: warp, compose, invert. The only file that calls grid_sample."""

from collections.abc import Sequence
from functools import partial
from typing import Literal, overload

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.derivatives import LEAST_ROWS, cofactors, derivative, determinant, map_jacobian, slab_of
from torchdeform.core.grid import Grid, on_threads, over_slabs, parts_of, require_float
from torchdeform.core.resampling import Rows, box_sum, least_rows, prolong
from torchdeform.core.tables import numbers_are_real
from torchdeform.errors import InputError, require_choice

_MODES = {"linear": "bilinear", "nearest": "nearest"}

# Fewer points than this are not worth more than one thread.
_POINTS_PER_THREAD = 2**13

# Points that `_gathered` takes at once: a core's cache holds what belongs to them.
_POINTS_AT_ONCE = 2**15

# Newton's method in `invert`: a smaller determinant counts as this one, and a node is left where it is when no step
# down to this fraction brings it nearer.
_SMALLEST_DETERMINANT = 0.01
_SMALLEST_STEP = 2.0**-7

# The start of `invert` comes from a grid of half as many nodes an axis, down to these; there this error, in voxels,
# will do. Then so many steps are taken at all nodes at once.
_FEWEST_NODES = 8
_START_ERROR = 0.01
_COMMON_STEPS = 2

# Steps for which the D² entries of ∇φ⁻¹, the dearest part of a step, are kept.
_REFRESH = 3

# Nodes that are taken further at once, where they are not all of a slab.
_NODES_AT_ONCE = 2**20

# How often nodes that Newton's method lost start again from their neighbours.
_RESTARTS = 8


def sample(
    image: Tensor, points: Tensor, grid: Grid, *, mode: str = "linear", outside: float | Tensor | None = None
) -> Tensor:
    """Return image(p) at points p.

    Args:
        image: ``(B or 1, C, *S)`` on ``grid``.
        points: ``(B or 1, D, *T)`` in units of spacing, array-axis order, node 0 of ``grid`` at the origin; T is any
            shape.
        grid: the grid of the image.
        mode: ``linear`` (multilinear) or ``nearest``.
        outside: value given to points more than half a voxel outside Ω, a number or one per channel ``(C,)``;
            None clamps points to Ω.

    Returns:
        ``(B, C, *T)``.

    Raises:
        InputError: shapes, mode.

    Notes:
        Linear mode is second order, differentiable in image and points (almost everywhere).
    """
    grid.check(image, "sample: image")
    require_float(points, "sample: points")
    if points.dim() < 3 or points.shape[1] != grid.dim:
        raise InputError(f"sample: points must have shape (B, {grid.dim}, *T), got {tuple(points.shape)}")
    values = _sample(image, _normalise([-1.0] * grid.dim, points, grid), mode)
    return with_outside(values, points, grid, outside)


def with_outside(values: Tensor, points: Tensor, grid: Grid, outside: float | Tensor | None) -> Tensor:
    """Return values ``(B, C, *T)`` with ``outside`` where the nearest node, were the grid continued, is not of it."""
    if outside is None:
        return values
    if isinstance(outside, Tensor):
        outside = outside.to(values).view(-1, *[1] * (values.dim() - 2))
    return torch.where(inside_box(points, grid), values, outside)


def warp(image: Tensor, u: Tensor, grid: Grid, *, mode: str = "linear", outside: float | None = None) -> Tensor:
    """Return warped(x) = image(x + u(x)), the pull-back of the image by φ = id + u.

    Args:
        image: ``(B or 1, C, *S)``.
        u: displacement ``(B or 1, D, *S)`` in units of spacing. φ takes points of the fixed space to the moving space.
        grid: the grid of both.
        mode: ``linear`` or ``nearest`` (labels).
        outside: value for points more than half a voxel outside Ω; None clamps them to Ω.

    Returns:
        ``(B, C, *S)``.

    Raises:
        InputError: shapes, mode.

    Notes:
        Differentiable in image and u in linear mode.
    """
    grid.check(image, "warp: image")
    grid.check_vector(u, "warp: u")
    values = _pulled(image, u, grid, slice(None), mode)
    if outside is None:
        return values
    return torch.where(inside_box(grid.points(dtype=u.dtype, device=u.device) + u, grid), values, outside)


def warp_by_rows(image: Tensor, u: Rows, grid: Grid) -> Tensor:
    """Return `warp` of an image by a displacement that is made slab by slab."""
    return over_slabs(
        lambda rows: _pulled(image, u(rows), grid, rows), grid.shape, image.device, least=least_rows(grid.shape)
    )


def _pulled(image: Tensor, u: Tensor, grid: Grid, rows: slice, mode: str = "linear") -> Tensor:
    """Return image(x + u(x)) for the nodes x in some rows of the first axis, u being given there."""
    first, *others = _lines(grid, u)
    return _sample(image, _normalise([first[rows], *others], u, grid), mode)


def _lines(grid: Grid, like: Tensor) -> list[Tensor]:
    """Return the nodes of each axis in grid_sample's box, to be broadcast along the others."""
    return [
        torch.linspace(-1, 1, n, dtype=like.dtype, device=like.device).view(-1, *([1] * (grid.dim - 1 - k)))
        for k, n in enumerate(grid.shape)
    ]


def _normalise(start: Sequence[Tensor | float], moved: Tensor, grid: Grid) -> Tensor:
    """Return start_k + 2 moved_k / extent_k with the components in the order x, y, z: grid_sample's box [−1, 1].

    The one place where array order is turned around. One pass of fresh memory, the rest in place.
    """
    box = moved.flip(1)
    for k, length in enumerate(grid.extent):
        box[:, grid.dim - 1 - k].mul_(2 / length).add_(start[k])
    return box


def inside_box(points: Tensor, grid: Grid, margin: float = 0.5) -> Tensor:
    """Return ``(B, 1, *T)``, True in the box of the nodes and up to ``margin`` voxels around it.

    With half a voxel, as in ITK, the nearest node, were the grid continued, belongs to the grid.
    """
    inside = torch.ones((), dtype=torch.bool, device=points.device)
    for k, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        index = points[:, k : k + 1] / h
        inside = inside & (index >= -margin) & (index < n - 1 + margin)
    return inside


def _sample(image: Tensor, normalised: Tensor, mode: str) -> Tensor:
    """Return the image at positions ``(B or 1, D, *T)`` of grid_sample's box."""
    require_choice(mode, _MODES, "sample: mode")
    items, dim, *shape = normalised.shape
    if 1 not in (items, image.shape[0]) and items != image.shape[0]:
        raise InputError(f"sample: image has {image.shape[0]} batch items but the points have {items}")
    if normalised.numel() == 0:  # no points, which grid_sample refuses
        return image.new_zeros(max(items, image.shape[0]), image.shape[1], *shape)
    if mode == "linear" and _is_plain_volume(image, normalised):
        return _gathered(image, normalised.to(image.dtype))
    parts = _parts(image, normalised)
    batch = max(items, image.shape[0]) * parts
    where = normalised.to(image.dtype).reshape(items, dim, parts, -1).permute(0, 2, 3, 1).flatten(0, 1)
    where = where.expand(batch, -1, -1).view(batch, *([1] * (dim - 1)), -1, dim)
    image = image.expand(batch, *image.shape[1:])
    values = F.grid_sample(image, where, _MODES[mode], padding_mode="border", align_corners=True)
    return (
        values.reshape(-1, parts, image.shape[1], where.shape[-2]).transpose(1, 2).reshape(-1, image.shape[1], *shape)
    )


def _is_plain_volume(image: Tensor, normalised: Tensor) -> bool:
    """Whether `_gathered` will do: a volume on the CPU, while nothing looks on."""
    wanted = torch.is_grad_enabled() and (image.requires_grad or normalised.requires_grad)
    return image.dim() == 5 and image.device.type == "cpu" and not wanted and numbers_are_real()


def _gathered(image: Tensor, normalised: Tensor) -> Tensor:
    """Return what grid_sample does with volumes, where it takes one point after the other, in two thirds of the time.

    Args:
        image: ``(B or 1, C, *S)``.
        normalised: ``(B or 1, 3, *T)``, of the same type.
    """
    batch, sizes, shape = max(len(image), len(normalised)), image.shape[2:], normalised.shape[2:]
    volumes, places = (field.flatten(2).expand(batch, -1, -1) for field in (image, normalised))
    values = image.new_empty(batch, image.shape[1], places.shape[2])
    for one in zip(volumes, places, values, strict=True):
        on_threads(partial(_gather, sizes, *one), parts_of(places.shape[2], _POINTS_AT_ONCE), image.device)
    return values.view(batch, -1, *shape)


def _gather(sizes: Sequence[int], volume: Tensor, places: Tensor, values: Tensor, some: slice) -> None:
    """Write some of the values ``(C, N)`` of a flat volume ``(C, n)`` at places ``(3, N)`` of grid_sample's box."""
    places, values = places[:, some], values[:, some]
    kind, count = torch.int32 if volume.shape[1] < 2**31 else torch.int64, places.shape[1]
    index, shares, offsets = places.new_zeros(count, dtype=kind), [], [0]
    for size, place in zip(sizes, reversed(places.unbind()), strict=True):
        at = place.add(1).mul_((size - 1) / 2).clamp_(0, size - 1)
        low = at.floor().clamp_(max=size - 2)
        index.mul_(size).add_(low.to(kind).clamp_(0))  # NaN, too, has to be somewhere
        offsets = [o * size + k for o in offsets for k in (0, 1)]
        shares.append(at.sub_(low))
    corners = volume.new_empty(8, count)
    for channel, value in zip(volume, values, strict=True):
        for offset, corner in zip(offsets, corners, strict=True):
            torch.index_select(channel[offset:], 0, index, out=corner)
        edges = corners[::2].lerp_(corners[1::2], shares[2])
        faces = edges[::2].lerp_(edges[1::2], shares[1])
        torch.lerp(faces[0], faces[1], shares[0], out=value)


def _parts(image: Tensor, normalised: Tensor) -> int:
    """Return into how many equal parts to deal out the points of one image as a batch.

    On the CPU grid_sample uses one thread per batch item. Where the image wants a gradient the points stay together,
    because the sum over the parts would depend on the number of threads. torch.compile cannot ask for that number.
    """
    if torch.compiler.is_compiling():
        return 1
    threads, points = torch.get_num_threads(), normalised[0, 0].numel()
    alone = image.shape[0] == normalised.shape[0] == 1 and image.device.type == "cpu" and not image.requires_grad
    if not alone or points < threads * _POINTS_PER_THREAD:
        return 1
    return next((parts for parts in range(threads, 4 * threads) if points % parts == 0), 1)


def compose(u: Tensor, w: Tensor, grid: Grid) -> Tensor:
    """Return the displacement w(x) + u(x + w(x)) of (id + u) ∘ (id + w): first w, then u.

    Args:
        u: displacement applied second, ``(B, D, *S)`` in units of spacing.
        w: displacement applied first, the same shape.
        grid: the grid of both.

    Returns:
        ``(B, D, *S)`` in units of spacing.

    Raises:
        InputError: shapes.

    Notes:
        Differentiable in u and w. Where x + w(x) lies outside Ω, u is that of the nearest boundary point.
    """
    grid.check_vector(u, "compose: u")
    grid.check_vector(w, "compose: w")
    return w + warp(u, w, grid)


@overload
def invert(
    u: Tensor, grid: Grid, *, atol: float = ..., max_steps: int = ..., return_error: Literal[False] = ...
) -> Tensor: ...
@overload
def invert(
    u: Tensor, grid: Grid, *, atol: float = ..., max_steps: int = ..., return_error: Literal[True]
) -> tuple[Tensor, Tensor]: ...
def invert(
    u: Tensor, grid: Grid, *, atol: float = 1e-4, max_steps: int = 50, return_error: bool = False
) -> Tensor | tuple[Tensor, Tensor]:
    """Return w with (id + u) ∘ (id + w) = id, that is w(x) + u(x + w(x)) = 0, by Newton's method at every node.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing, of a map from Ω onto Ω.
        grid: its grid, at least 3 nodes an axis.
        atol: stops when every |w + u(x + w)| is at most this many voxels.
        max_steps: steps at most.
        return_error: return the error reached as well.

    Returns:
        w ``(B, D, *S)``, or ``(w, error)`` with error ``(B,)`` = max_x |w + u(x + w)| in voxels.

    Raises:
        InputError: shapes.

    Notes:
        Starts from the inverse on a coarser grid; two steps at all nodes, then more where they are needed, up to 30 of
        strong but fold-free maps. A step costs a sampling of u, every third one 2·D more. Where u folds there is no
        inverse: w is finite and the error says how far it got. Differentiable once in u by the implicit function
        theorem, with ∇φ⁻¹ from finite differences; no step is kept in memory.
    """
    grid.check_vector(u, "invert: u")
    with torch.no_grad():
        w = _find_inverse(u, grid, atol, max_steps)
    if u.requires_grad:
        with torch.no_grad():
            inverse = inverse_matrix(map_jacobian(u, grid))
            inverse = warp(inverse.flatten(1, 2), w, grid).view(inverse.shape)
        moved = warp(u, w, grid)
        w = w - matrix_times(inverse, moved - moved.detach())  # w as it is, with δw = −∇φ⁻¹ δu(x + w)
    return (w, max_voxels(compose(u, w, grid), grid)) if return_error else w


def inverse_matrix(matrix: Tensor) -> Tensor:
    """Return the inverse of ``(B, D, D, *T)``, finite: a small determinant counts as one a little larger."""
    return cofactors(matrix).transpose(1, 2) / determinant(matrix).clamp(min=_SMALLEST_DETERMINANT).unsqueeze(1)


def matrix_times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the products of ``(B, D, D, *T)`` with ``(B, D, *T)``."""
    return (matrix * vector.unsqueeze(1)).sum(dim=2)


def _find_inverse(u: Tensor, grid: Grid, atol: float, max_steps: int) -> Tensor:
    """Solve w + u(x + w) = 0 at every node: first everywhere at once, then at the nodes that are not there yet.

    The start is the inverse on a grid of half as many nodes an axis, and so on down: one step from it most are there.
    """
    halves = tuple(max(_FEWEST_NODES, (n + 1) // 2) if n > _FEWEST_NODES else n for n in grid.shape)
    if halves == grid.shape:
        start = -u
    else:
        coarse = grid.with_shape(halves)
        start = prolong(_find_inverse(prolong(u, coarse), coarse, max(atol, _START_ERROR), max_steps), grid)
    w = _approach(u, keep_inside(start, grid), grid, atol)  # outside Ω, where u is continued, w may lose its way
    items = zip(u.split(1), w.split(1), strict=True)
    return torch.cat([_finished(one, found, grid, atol, max_steps) for one, found in items])


def _approach(u: Tensor, w: Tensor, grid: Grid, atol: float) -> Tensor:
    """Take a few steps δw = −(I + ∇w) d of Newton's method, d being the defect and I + ∇w = ∇φ⁻¹ once w is near."""

    def start(rows: slice) -> Tensor:
        part = w[:, :, rows]
        return torch.cat([part, part + _pulled(u, part, grid, rows)], dim=1)

    state = over_slabs(start, grid.shape, w.device)
    for _ in range(_COMMON_STEPS):
        state = over_slabs(partial(_nearer, u, state, grid, atol), grid.shape, w.device, least=LEAST_ROWS)
    return state[:, : grid.dim]


def _nearer(u: Tensor, state: Tensor, grid: Grid, atol: float, rows: slice) -> Tensor:
    """Return w and its defect ``(B, 2D, *T)`` in some rows after a step, where that brings them nearer."""
    w, defect = state[:, :, rows].chunk(2, dim=1)
    slopes = (slab_of(partial(derivative, axis=k), state[:, : grid.dim], grid, rows) for k in range(grid.dim))
    trial = w - defect
    for axis, slope in enumerate(slopes):
        trial.addcmul_(slope, defect[:, axis : axis + 1], value=-1)
    trial_defect = trial + _pulled(u, trial, grid, rows)
    error = voxels(defect, grid)
    nearer = (error > atol) & (voxels(trial_defect, grid) < error)
    return torch.where(nearer, torch.cat([trial, trial_defect], dim=1), state[:, :, rows])


def _finished(u: Tensor, w: Tensor, grid: Grid, atol: float, max_steps: int) -> Tensor:
    """Return w of one item after Newton's method where it is needed; lost nodes start again from their neighbours."""
    w = w.clone()

    def miss(rows: slice) -> Tensor:
        return voxels(w[:, :, rows] + _pulled(u, w[:, :, rows], grid, rows), grid)

    error = over_slabs(miss, grid.shape, w.device)
    for attempt in range(1 + _RESTARTS):
        lost = error > atol
        places = lost.flatten().nonzero()[:, 0]
        if len(places) == 0 or (attempt and len(places) == lost.numel()):
            break
        start = _mean_of_neighbours(w, ~lost) if attempt else w
        parts = [
            _newton(u, grid, _nodes_at(some, grid, w), start.flatten(2)[..., some], atol, max_steps)
            for some in places.split(_NODES_AT_ONCE)
        ]
        found, reached = (torch.cat(part, dim=2) for part in zip(*parts, strict=True))
        nearer = reached < error.flatten(2)[..., places]
        if not bool(nearer.any()):
            break
        w.flatten(2)[..., places] = torch.where(nearer, found, w.flatten(2)[..., places])
        error.flatten(2)[..., places] = torch.where(nearer, reached, error.flatten(2)[..., places])
    return w


def _nodes_at(places: Tensor, grid: Grid, like: Tensor) -> Tensor:
    """Return nodes of grid_sample's box ``(1, D, N)`` by their places in the flattened grid."""
    lines = zip(_lines(grid, like), grid.strides, grid.shape, strict=True)
    return torch.stack([line.flatten()[places // stride % n] for line, stride, n in lines]).unsqueeze(0)


def _newton(u: Tensor, grid: Grid, nodes: Tensor, w: Tensor, atol: float, max_steps: int) -> tuple[Tensor, Tensor]:
    """Return w ``(1, D, N)`` after Newton's steps at some nodes, each on its own, and the errors in voxels.

    A step that brings a point no nearer is undone and halved; one below the tolerance, or halved too often, is left
    alone.
    """
    defect = w + _from_nodes(u, nodes, w, grid)
    error = voxels(defect, grid)
    state = w, defect, error, torch.ones_like(error)
    for _ in range(0, max_steps, _REFRESH):
        w, _, error, fraction = state
        going = ((error > atol) & (fraction >= _SMALLEST_STEP))[0, 0].nonzero()[:, 0]
        if len(going) == 0:
            break
        moved = _few_steps(u, grid, nodes[..., going], tuple(t[..., going] for t in state), atol)
        for whole, part in zip(state, moved, strict=True):
            whole[..., going] = part
    return state[0], state[2]


def _few_steps(u: Tensor, grid: Grid, nodes: Tensor, state: tuple[Tensor, ...], atol: float) -> tuple[Tensor, ...]:
    """Return w, its defect, its error and the fraction of a step to try, after steps with one ∇φ⁻¹."""
    w, defect, error, fraction = state
    inverse = inverse_matrix(jacobian_at(u, (nodes + 1) * (grid.along(grid.extent, w) / 2) + w, grid))
    for _ in range(_REFRESH):
        trial = w - fraction * matrix_times(inverse, defect)
        trial_defect = trial + _from_nodes(u, nodes, trial, grid)
        trial_error = voxels(trial_defect, grid)
        active = error > atol
        nearer = active & (trial_error < error)
        w, defect = torch.where(nearer, trial, w), torch.where(nearer, trial_defect, defect)
        error = torch.where(nearer, trial_error, error)
        fraction = torch.where(nearer, (2 * fraction).clamp(max=1.0), torch.where(active, fraction / 2, fraction))
    return w, defect, error, fraction


def jacobian_at(u: Tensor, points: Tensor, grid: Grid) -> Tensor:
    """Return ∇φ ``(B, D, D, *T)`` at points ``(B, D, *T)`` of Ω from differences over one voxel to either side."""
    columns = []
    for axis, (h, length) in enumerate(zip(grid.spacing, grid.extent, strict=True)):
        ends = [points.clone(), points.clone()]
        ends[0][:, axis] = (points[:, axis] - h).clamp(0, length - h)
        ends[1][:, axis] = (points[:, axis] + h).clamp(h, length)
        moved = [end + sample(u, end, grid) for end in ends]
        columns.append((moved[1] - moved[0]) / (ends[1] - ends[0])[:, axis : axis + 1])
    return torch.stack(columns, dim=2)


def _from_nodes(u: Tensor, nodes: Tensor, w: Tensor, grid: Grid) -> Tensor:
    """Return u(x + w) at nodes ``(1, D, N)`` of grid_sample's box, rounded as `warp` does."""
    return _sample(u, _normalise(nodes.unbind(1), w, grid), "linear")


def _mean_of_neighbours(w: Tensor, known: Tensor) -> Tensor:
    """Return at each node the mean of w over the known ones among it and its neighbours, or w if there is none."""
    count = box_sum(known.to(w), 3)
    return torch.where(count > 0.5, box_sum(w * known, 3) / count.clamp(min=1), w)


def keep_inside(u: Tensor, grid: Grid) -> Tensor:
    """Return u with every x + u(x) that lies outside Ω moved to the nearest point of Ω.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``(B, D, *S)`` in units of spacing. The gradient of a component that was cut is 0.
    """
    inside = u.clone()
    for k, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        x = (torch.arange(n, dtype=u.dtype, device=u.device) * h).view(-1, *([1] * (grid.dim - 1 - k)))
        inside[:, k].clamp_(min=-x, max=x[-1] - x)
    return inside


@torch.no_grad()
def voxels(u: Tensor, grid: Grid) -> Tensor:
    """Return |u| in voxels ``(B, 1, *T)`` of vectors ``(B, D, *T)``; not differentiable."""
    squares = (u / grid.along(grid.spacing, u)).square_()
    return squares.sum(dim=1, keepdim=True).sqrt_()  # ten times faster than norm(dim=1)


def max_voxels(u: Tensor, grid: Grid) -> Tensor:
    """Return max_x |u(x)| in voxels for each item, ``(B,)``; not differentiable."""
    return voxels(u, grid).flatten(1).amax(dim=1)
