"""Steps that keep a map open: every one is looked at by the full certificate, and shortened where it is too bold."""

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.grid import Grid, per_item
from torchdeform.core.warp import compose, keep_inside, warp

# Rounds of smoothing that a few folded nodes are given to open.
_SMOOTHINGS = 100

_WIDEN = {2: F.max_pool2d, 3: F.max_pool3d}

# A step that is still too bold at this fraction of itself is not taken.
_SHORTEST = 2.0**-6


def advance(
    state: tuple[Tensor, Tensor], move: Tensor, share: Tensor, grid: Grid, limit: float, sides: int = 1
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Return u ∘ flow(move), relaxed, its `one_sided_determinant`, which pairs moved, and how often a step was halved.

    No determinant falls below ``limit``, or below the smallest one there was if that was less. Along the halvings the
    trial tends to u, so a bold step ends as a short one. The extrapolated determinants on the faces of the box are left
    to `mended`, after the last step: they take as long as all the others and hardly ever fold alone.

    Args:
        state: u ``(sides·B, D, *S)`` in units of spacing, and its `one_sided_determinant`.
        move: velocity, the same shape.
        share: of the way to its `neighbour_mean` that the new u is taken, for each map ``(sides·B,)``, see `relaxed`.
        grid: the grid of both.
        limit: smallest one-sided determinant that may be left.
        sides: maps of one pair, B items apart; they are shortened together.
    """
    u, lowest = state
    floor = lowest.flatten(1).amin(1).clamp(max=limit)
    fraction, halved = torch.ones_like(floor), 0
    while True:
        trial = relaxed(compose(u, _flow(move * per_item(fraction, u), grid), grid), share * fraction, grid)
        trial_lowest = one_sided_determinant(trial, grid)
        low = _any_side(~(trial_lowest.flatten(1).amin(1) >= floor), sides)
        count = int(low.sum()) // sides
        if count == 0:
            return trial, trial_lowest, ~low[: low.numel() // sides], halved
        if bool((fraction[low] <= _SHORTEST).all()):
            u, lowest = keep(~low, trial, u), keep(~low, trial_lowest, lowest)
            return u, lowest, ~low[: low.numel() // sides], halved
        halved += count
        fraction = torch.where(low, fraction / 2, fraction)


def _flow(v: Tensor, grid: Grid) -> Tensor:
    """Return the displacement of the flow of v at t = 1 by one step of the midpoint rule, kept in Ω.

    What `integrate` gives, without the general solver: its import alone takes as long as a pair of small slices.
    """
    return keep_inside(warp(v, v / 2, grid), grid)


def _any_side(per_map: Tensor, sides: int) -> Tensor:
    return per_map if sides == 1 else per_map.view(sides, -1).any(0).repeat(sides)


def lowest_determinant(u: Tensor, grid: Grid) -> Tensor:
    """Return at each node the smallest determinant ``(B, 1, *S)``, one-sided or by `jacobian_determinant`.

    Inside Ω the latter is a mean of one-sided ones. On the faces, where it extrapolates, it has to be looked at.
    """
    lowest = one_sided_determinant(u, grid)
    for axis, n in zip(grid.axes, grid.shape, strict=True):
        layers = torch.cat([u.narrow(axis, 0, 3), u.narrow(axis, n - 3, 3)])
        first, last = jacobian_determinant(layers, Grid(tuple(layers.shape[2:]), grid.spacing)).chunk(2)
        for node, det in ((0, first), (n - 1, last)):
            face = lowest.select(axis, node)
            torch.minimum(face, det.select(axis, 0 if node == 0 else 2), out=face)
    return lowest


def mended(u: Tensor, grid: Grid, limit: float = 0.0) -> Tensor:
    """Return u, smoothed around the nodes whose `lowest_determinant` is not above ``limit``, until there are none.

    Sampling an open map on another grid, or composing two, may fold it at a few nodes. All others stay as they are, and
    so do the faces of the box. Nodes that no smoothing opens draw their whole item towards 0.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.
        limit: at least 0.
    """
    for _ in range(_SMOOTHINGS):
        low = ~(lowest_determinant(u, grid) > limit)
        if not bool(low.any()):
            return u
        near = neighbour_mean(_WIDEN[grid.dim](low.to(u.dtype), 3, stride=1, padding=1))
        u = _keep_faces(torch.lerp(u, neighbour_mean(u), near), u, grid)
    while bool((low := ~(lowest_determinant(u, grid).flatten(1).amin(1) > 0)).any()):
        u = torch.where(per_item(low, u), 0.9 * u, u)
    return u


def relaxed(u: Tensor, share: Tensor, grid: Grid) -> Tensor:
    """Return u + share (ū − u), ū being its `neighbour_mean`: diffusion ∂u/∂t = Δu for share / 4 squared voxels.

    A step down the elastic energy ½ ∫ |∇u|², which prices the whole displacement as the metric prices the velocity.

    Args:
        u: displacement ``(B, D, *S)``; on the faces of the box the components that lead out of it stay as they are.
        share: 0 to 1 for each item ``(B,)``.
        grid: its grid.
    """
    return _keep_faces(torch.lerp(u, neighbour_mean(u), per_item(share, u)), u, grid) if bool(share.any()) else u


def neighbour_mean(field: Tensor) -> Tensor:
    """Return the mean with weights 1, 2, 1 along every axis, the field being mirrored at its first and last nodes."""
    for axis in range(2, field.dim()):
        count = field.shape[axis]
        ends = field.narrow(axis, 1, 1), field.narrow(axis, count - 2, 1)
        wide = torch.cat([ends[0], field, ends[1]], dim=axis)
        field = (wide.narrow(axis, 0, count) + wide.narrow(axis, 2, count)) / 4 + field / 2
    return field


def _keep_faces(u: Tensor, before: Tensor, grid: Grid) -> Tensor:
    """Give the components that lead out of the box at its faces the values they had."""
    for k, axis in enumerate(grid.axes):
        for end in (0, -1):
            u[:, k].select(axis - 1, end).copy_(before[:, k].select(axis - 1, end))
    return u


def keep(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return the new items that are chosen, and the old ones in place of the others."""
    return new if bool(chosen.all()) else torch.where(per_item(chosen, new), new, old)
