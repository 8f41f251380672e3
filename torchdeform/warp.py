"""Sampling images and fields at moved points: warp, compose, invert. The only file that calls grid_sample."""

from typing import Literal, overload

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.errors import InputError, require_choice
from torchdeform.grid import Grid

_MODES = {"linear": "bilinear", "nearest": "nearest"}


def sample(image: Tensor, points: Tensor, grid: Grid, *, mode: str = "linear", outside: float | None = None) -> Tensor:
    """Return image(p) at points p.

    Args:
        image: ``(B, C, *S)`` on ``grid``.
        points: ``(B or 1, D, *T)`` in units of spacing, array-axis order, node 0 of ``grid`` at the origin.
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
    require_choice(mode, _MODES, "sample: mode")
    if points.dim() != grid.dim + 2 or points.shape[1] != grid.dim:
        raise InputError(f"sample: points must have shape (B, {grid.dim}, *T), got {tuple(points.shape)}")
    index = points / grid.along(grid.spacing, points)
    values = _sample_index(image, index, mode)
    if outside is None:
        return values
    last = grid.along([n - 1 for n in grid.shape], points)
    inside = ((index >= -0.5) & (index < last + 0.5)).all(dim=1, keepdim=True)
    return torch.where(inside, values, torch.as_tensor(outside, dtype=values.dtype, device=values.device))


def _sample_index(image: Tensor, index: Tensor, mode: str) -> Tensor:
    """Sample at voxel indices; the one place where array order (z, y, x) becomes grid_sample's x, y, z in [−1, 1]."""
    half = torch.tensor([(n - 1) / 2 for n in image.shape[2:]], dtype=index.dtype, device=index.device)
    normalised = (index.movedim(1, -1) / half - 1).flip(-1)
    if normalised.shape[0] != image.shape[0]:
        normalised = normalised.expand(image.shape[0], *normalised.shape[1:])
    return F.grid_sample(image, normalised.to(image.dtype), _MODES[mode], padding_mode="border", align_corners=True)


def warp(image: Tensor, u: Tensor, grid: Grid, *, mode: str = "linear", outside: float | None = None) -> Tensor:
    """Return warped(x) = image(x + u(x)), the pull-back of the image by φ = id + u.

    Args:
        image: ``(B, C, *S)``.
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
    grid.check_vector(u, "warp: u")
    return sample(image, grid.points(dtype=u.dtype, device=u.device) + u, grid, mode=mode, outside=outside)


def compose(u: Tensor, w: Tensor, grid: Grid) -> Tensor:
    """Return the displacement w(x) + u(x + w(x)) of (id + u) ∘ (id + w): first w, then u.

    Args:
        u: displacement applied second, ``(B, D, *S)`` in units of spacing.
        w: displacement applied first, the same shape.
        grid: the grid of both.

    Raises:
        InputError: shapes.
    """
    grid.check_vector(u, "compose: u")
    grid.check_vector(w, "compose: w")
    return w + warp(u, w, grid)


@overload
def invert(u: Tensor, grid: Grid, *, atol: float = ..., max_steps: int = ..., return_error: Literal[False] = ...) -> Tensor: ...
@overload
def invert(u: Tensor, grid: Grid, *, atol: float = ..., max_steps: int = ..., return_error: Literal[True]) -> tuple[Tensor, Tensor]: ...
def invert(
    u: Tensor, grid: Grid, *, atol: float = 1e-5, max_steps: int = 100, return_error: bool = False
) -> Tensor | tuple[Tensor, Tensor]:
    """Return w with (id + u) ∘ (id + w) = id by the fixed point w ← −u(x + w).

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing, of a map from Ω onto Ω.
        grid: its grid.
        atol: stops when every item's max_x |w + u(x + w)| is at most this many voxels.
        max_steps: steps at most.
        return_error: return the error reached as well.

    Returns:
        w ``(B, D, *S)``, or ``(w, error)`` with error ``(B,)`` = max_x |w + u(x + w)| in voxels.

    Raises:
        InputError: shapes.

    Notes:
        A step that does not bring an item nearer is halved for that item, so strong but fold-free maps converge
        too; the error says how far it got. Differentiable through the steps.
    """
    grid.check_vector(u, "invert: u")
    w, relaxation = -u, torch.ones(u.shape[0], dtype=u.dtype, device=u.device)
    defect = compose(u, w, grid)
    error = max_voxels(defect, grid)
    for _ in range(max_steps):
        if bool((error <= atol).all()):
            break
        trial = w - defect * relaxation.view(-1, *([1] * (grid.dim + 1)))
        trial_defect = compose(u, trial, grid)
        trial_error = max_voxels(trial_defect, grid)
        better = trial_error < error
        keep = better.view(-1, *([1] * (grid.dim + 1)))
        w, defect = torch.where(keep, trial, w), torch.where(keep, trial_defect, defect)
        error = torch.where(better, trial_error, error)
        relaxation = torch.where(better, relaxation.mul(1.5).clamp(max=1.0), relaxation / 2)
    return (w, error.detach()) if return_error else w


def max_voxels(u: Tensor, grid: Grid) -> Tensor:
    """Return max_x |u(x)| in voxels for each item, ``(B,)``."""
    return (u / grid.along(grid.spacing, u)).norm(dim=1).flatten(1).amax(dim=1)
