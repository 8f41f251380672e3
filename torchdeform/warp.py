"""Sampling images and fields at moved points: warp, compose, invert. The only file that calls grid_sample."""

from collections.abc import Sequence
from typing import Literal, overload

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.errors import InputError, require_choice
from torchdeform.grid import Grid
from torchdeform.stencil import cofactors, determinant, map_jacobian

_MODES = {"linear": "bilinear", "nearest": "nearest"}

# Fewer points than this are not worth more than one thread.
_POINTS_PER_THREAD = 2**13

# Newton's method in `invert`: a smaller determinant counts as this one, and a node is left where it is when no step
# down to this fraction brings it nearer.
_SMALLEST_DETERMINANT = 0.01
_SMALLEST_STEP = 2.0**-7

# Steps for which the D² entries of ∇φ⁻¹, the dearest part of a step, are kept.
_REFRESH = 3

# How often nodes that Newton's method lost start again from their neighbours.
_RESTARTS = 8


def sample(image: Tensor, points: Tensor, grid: Grid, *, mode: str = "linear", outside: float | None = None) -> Tensor:
    """Return image(p) at points p.

    Args:
        image: ``(B or 1, C, *S)`` on ``grid``.
        points: ``(B or 1, D, *T)`` in units of spacing, array-axis order, node 0 of ``grid`` at the origin; T is any
            shape.
        grid: the grid of the image.
        mode: ``linear`` (multilinear) or ``nearest``.
        outside: value given to points more than half a voxel outside Ω; None clamps points to Ω.

    Returns:
        ``(B, C, *T)``.

    Raises:
        InputError: shapes, mode.

    Notes:
        Linear mode is second order, differentiable in image and points (almost everywhere).
    """
    grid.check(image, "sample: image")
    if points.dim() < 3 or points.shape[1] != grid.dim or not points.is_floating_point():
        given = f"{tuple(points.shape)} of {points.dtype}"
        raise InputError(f"sample: points must be floating-point of shape (B, {grid.dim}, *T), got {given}")
    values = _sample(image, _normalise([-1.0] * grid.dim, points, grid), mode)
    return values if outside is None else torch.where(_inside(points, grid), values, outside)


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
    lines = [
        torch.linspace(-1, 1, n, dtype=u.dtype, device=u.device).view(-1, *([1] * (grid.dim - 1 - k)))
        for k, n in enumerate(grid.shape)
    ]
    values = _sample(image, _normalise(lines, u, grid), mode)
    if outside is None:
        return values
    return torch.where(_inside(grid.points(dtype=u.dtype, device=u.device) + u, grid), values, outside)


def _normalise(start: Sequence[Tensor | float], moved: Tensor, grid: Grid) -> Tensor:
    """Return start_k + 2 moved_k / extent_k with the components in the order x, y, z: grid_sample's box [−1, 1].

    The one place where array order is turned around. One pass of fresh memory, the rest in place.
    """
    box = moved.flip(1)
    for k, length in enumerate(grid.extent):
        box[:, grid.dim - 1 - k].mul_(2 / length).add_(start[k])
    return box


def _inside(points: Tensor, grid: Grid) -> Tensor:
    """Return ``(B, 1, *T)``, True where the nearest node, were the grid continued, belongs to the grid (as in ITK)."""
    inside = torch.ones((), dtype=torch.bool, device=points.device)
    for k, (n, h) in enumerate(zip(grid.shape, grid.spacing, strict=True)):
        index = points[:, k : k + 1] / h
        inside = inside & (index >= -0.5) & (index < n - 0.5)
    return inside


def _sample(image: Tensor, normalised: Tensor, mode: str) -> Tensor:
    """Return the image at positions ``(B or 1, D, *T)`` of grid_sample's box."""
    require_choice(mode, _MODES, "sample: mode")
    items, dim, *shape = normalised.shape
    if 1 not in (items, image.shape[0]) and items != image.shape[0]:
        raise InputError(f"sample: image has {image.shape[0]} batch items but the points have {items}")
    parts = _parts(image, normalised)
    batch = max(items, image.shape[0]) * parts
    where = normalised.to(image.dtype).reshape(items, dim, parts, -1).permute(0, 2, 3, 1).flatten(0, 1)
    where = where.expand(batch, -1, -1).view(batch, *([1] * (dim - 1)), -1, dim)
    image = image.expand(batch, *image.shape[1:])
    values = F.grid_sample(image, where, _MODES[mode], padding_mode="border", align_corners=True)
    return (
        values.reshape(-1, parts, image.shape[1], where.shape[-2]).transpose(1, 2).reshape(-1, image.shape[1], *shape)
    )


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
        Mild maps take about 4 steps, strong but fold-free ones up to 30; a step costs D + 1 samplings of u. Where u
        folds there is no inverse: w is finite and the error says how far it got. Differentiable once in u by the
        implicit function theorem, with ∇φ⁻¹ from finite differences; no step is kept in memory.
    """
    grid.check_vector(u, "invert: u")
    with torch.no_grad():
        inverse = _inverse_jacobian(u, grid)
        w = _find_inverse(u, inverse, grid, atol, max_steps)
    if u.requires_grad:
        moved = warp(u, w, grid)
        w = w - _times(warp(inverse, w, grid), moved - moved.detach())  # w as it is, with δw = −∇φ⁻¹ δu(x + w)
    return (w, max_voxels(compose(u, w, grid), grid)) if return_error else w


def _inverse_jacobian(u: Tensor, grid: Grid) -> Tensor:
    """Return (∇φ)⁻¹ at the nodes, row after row, as ``(B, D·D, *S)``; finite also where φ folds."""
    matrix = map_jacobian(u, grid)
    inverse = cofactors(matrix).transpose(1, 2) / determinant(matrix).clamp(min=_SMALLEST_DETERMINANT).unsqueeze(1)
    return inverse.flatten(1, 2)


def _times(rows: Tensor, vector: Tensor) -> Tensor:
    return (rows.unflatten(1, (-1, vector.shape[1])) * vector.unsqueeze(1)).sum(dim=2)


def _find_inverse(u: Tensor, inverse: Tensor, grid: Grid, atol: float, max_steps: int) -> Tensor:
    """Solve w + u(x + w) = 0 at every node; nodes that got lost start again where their neighbours ended."""
    w = keep_inside(-u, grid)  # a start outside Ω, where u is continued, may never find its way back
    w, error = _newton(u, inverse, w, grid, atol, max_steps)
    for _ in range(_RESTARTS):
        lost = error > atol
        if not bool(lost.any()) or bool(lost.all()):
            break
        again = torch.where(lost, _mean_of_neighbours(w, ~lost), w)
        again, again_error = _newton(u, inverse, again, grid, atol, max_steps)
        nearer = again_error < error
        if not bool(nearer.any()):
            break
        w, error = torch.where(nearer, again, w), torch.where(nearer, again_error, error)
    return w


def _newton(u: Tensor, inverse: Tensor, w: Tensor, grid: Grid, atol: float, max_steps: int) -> tuple[Tensor, Tensor]:
    """Return w after Newton's steps at every node on its own, so that batches do not matter, and the error in voxels.

    A step that brings a node no nearer is undone and halved; a node below atol, or halved too often, is left alone.
    """
    defect, rows = compose(u, w, grid), inverse
    error = voxels(defect, grid)
    fraction = torch.ones_like(error)
    for step in range(max_steps):
        active = (error > atol) & (fraction >= _SMALLEST_STEP)
        if not bool(active.any()):
            break
        if step % _REFRESH == 0:
            rows = warp(inverse, w, grid)
        trial = w - fraction * _times(rows, defect)
        trial_defect = compose(u, trial, grid)
        trial_error = voxels(trial_defect, grid)
        nearer = active & (trial_error < error)
        w, defect = torch.where(nearer, trial, w), torch.where(nearer, trial_defect, defect)
        error = torch.where(nearer, trial_error, error)
        fraction = torch.where(nearer, (2 * fraction).clamp(max=1.0), torch.where(active, fraction / 2, fraction))
    return w, error


def _mean_of_neighbours(w: Tensor, known: Tensor) -> Tensor:
    """Return at each node the mean of w over the known ones among it and its neighbours, or w if there is none."""
    pool = {2: F.avg_pool2d, 3: F.avg_pool3d}[w.shape[1]]
    share = pool(known.to(w.dtype), 3, stride=1, padding=1)
    mean = pool(w * known, 3, stride=1, padding=1) / share.clamp(min=torch.finfo(w.dtype).tiny)
    return torch.where(share > 0, mean, w)


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
    """Return |u(x)| in voxels, ``(B, 1, *S)``; not differentiable."""
    squares = (u / grid.along(grid.spacing, u)).square_()
    return squares.sum(dim=1, keepdim=True).sqrt_()  # ten times faster than norm(dim=1)


def max_voxels(u: Tensor, grid: Grid) -> Tensor:
    """Return max_x |u(x)| in voxels for each item, ``(B,)``; not differentiable."""
    return voxels(u, grid).flatten(1).amax(dim=1)
