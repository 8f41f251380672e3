"""Maps stay without folds: one guard that shortens a move, and one repair for maps that folded all the same.

Both look at the one-sided determinants of `diagnostics`, whose positivity at every node is the certificate.
"""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant, slab_of
from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.grid import Grid, over_slabs, per_item
from torchdeform.core.resampling import MAX_POOL, least_rows
from torchdeform.errors import ComputationError

Trial = TypeVar("Trial")

# Rounds of smoothing: so many for the floor that is asked for, and for no folds at all. 50 is the most that was seen.
_FLOOR_ROUNDS, _ROUNDS = 100, 1000


def largest_share(accept: Callable[[Tensor], Tensor], like: Tensor, *, halvings: int, refine: bool = False) -> Tensor:
    """Return the largest share t of a move that is accepted, for each item ``(B,)``: 1, or found by halving.

    Args:
        accept: tells which items ``(B,)`` may make their share ``(B,)`` of the move. Called with shares that fall from
            1; those of items that are settled stay as they are, so the last call shows every accepted move at once.
        like: ``(B,)``, for the type and device of the shares.
        halvings: how often the share is halved, at most.
        refine: go on by bisection up to a multiple of 2^−halvings; then the last call shows trials, not the answer.

    Returns:
        ``(B,)``: t = 1, 1/2, .., 2^−halvings, a multiple of the last with ``refine``; 0 where nothing was accepted.

    Notes:
        At most ``halvings`` + 1 calls. What is not finite is never accepted, if ``accept`` compares with ≥ or >. The
        share counts as constant for gradients.
    """
    share = torch.zeros_like(like)
    for halving in range(halvings + 1):
        settled = (share == 1) if refine else (share > 0)
        trial = torch.where(settled, share, share + 0.5**halving)
        share = torch.where(accept(trial), trial, share)
        if bool((share == 1).all() if refine else (share > 0).all()):
            break
    return share


def lowest_determinant(u: Tensor, grid: Grid) -> Tensor:
    """Return at each node the smallest determinant ``(B, 1, *S)``, one-sided or by `jacobian_determinant`.

    Inside Ω the latter is a mean of one-sided ones. On the faces, where it extrapolates, it has to be looked at.
    """
    lowest = one_sided_determinant(u, grid)
    for axis, n in zip(grid.axes, grid.shape, strict=True):
        if n < 3:
            continue
        layers = torch.cat([u.narrow(axis, 0, 3), u.narrow(axis, n - 3, 3)])
        first, last = jacobian_determinant(layers, Grid(tuple(layers.shape[2:]), grid.spacing)).chunk(2)
        for node, det in ((0, first), (n - 1, last)):
            face = lowest.select(axis, node)
            torch.minimum(face, det.select(axis, 0 if node == 0 else 2), out=face)
    return lowest


def repair_folds(u: Tensor, grid: Grid, floor: float = 0.0) -> Tensor:
    """Return u, smoothed around the nodes whose `lowest_determinant` is not above ``floor``, until there are none.

    Sampling a map on another grid, composing two, or a flow that bends within a cell may fold a map at a few nodes.
    All others stay as they are, and so do the components that lead out of the box at its faces.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.
        floor: at least 0; where 100 rounds do not reach it, no folds are enough.

    Returns:
        ``(B, D, *S)``, the same tensor where nothing was folded.

    Raises:
        InputError: shape.
        ComputationError: u is not finite, or there are still folds after 1000 rounds.

    Notes:
        Each round moves the nodes around all folds seen so far towards the mean of their neighbours, by a share that
        fades out over a few cells; continued for ever, that would end in the identity. Differentiable in u for the
        nodes that are moved.
    """
    grid.check_vector(u, "repair_folds: u")
    share, least = torch.zeros_like(u[:, :1]), 16 * torch.finfo(u.dtype).eps  # positive also with other rounding
    for step in range(_ROUNDS):
        folded = ~(lowest_determinant(u.detach(), grid) > max(least, floor if step < _FLOOR_ROUNDS else 0.0))
        if not bool(folded.any()):
            return u
        if step == 0 and not bool(u.isfinite().all()):
            raise ComputationError("the map is not finite; check the images for extreme values, or take smaller steps")
        wider = MAX_POOL[grid.dim](folded.to(u.dtype), 3, stride=1, padding=1)
        share = torch.maximum(share, wider)
        fading = neighbour_mean(share)
        u = keep_faces(torch.lerp(u, neighbour_mean(u), fading.expand_as(u)), u, grid)
    raise ComputationError(
        f"the map still folds after {_ROUNDS} rounds of smoothing: it varies too much for this grid; take smoother "
        "settings or a finer grid (for a monitor: smooth it, or raise f_min)"
    )


def smooth_elastically(u: Tensor, share: Tensor, grid: Grid) -> Tensor:
    """Return u + share (ū − u), ū being its `neighbour_mean`: diffusion ∂u/∂t = Δu for share / 4 squared voxels.

    A step down the elastic energy ½ ∫ |∇u|², which prices the whole displacement as the metric prices the velocity.

    Args:
        u: displacement ``(B, D, *S)``; on the faces of the box the components that lead out of it stay as they are.
        share: from 0 to 1, for each item ``(B,)``, or what broadcasts to ``(B, 1, *S)``.
        grid: its grid.
    """
    share = (per_item(share, u) if share.dim() == 1 else share).expand_as(u)

    def smoothed(rows: slice) -> Tensor:
        mean = slab_of(lambda part, _: neighbour_mean(part), u, grid, rows)
        return torch.lerp(u[:, :, rows], mean, share[:, :, rows])

    return keep_faces(over_slabs(smoothed, grid.shape, u.device, least=least_rows(grid.shape)), u, grid)


def neighbour_mean(field: Tensor) -> Tensor:
    """Return the mean with weights 1, 2, 1 along every axis, the field being mirrored at its first and last nodes."""
    for axis in range(2, field.dim()):
        count = field.shape[axis]
        ends = field.narrow(axis, 1, 1), field.narrow(axis, count - 2, 1)
        wide = torch.cat([ends[0], field, ends[1]], dim=axis)
        field = (wide.narrow(axis, 0, count) + wide.narrow(axis, 2, count)).mul_(1 / 4).add_(field, alpha=1 / 2)
    return field


def keep_faces(u: Tensor, before: Tensor, grid: Grid) -> Tensor:
    """Give the components that lead out of the box at its faces the values they had, in place."""
    for k, axis in enumerate(grid.axes):
        for end in (0, -1):
            u[:, k].select(axis - 1, end).copy_(before[:, k].select(axis - 1, end))
    return u


def where_items(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return the new items that are chosen ``(B,)``, and the old ones in place of the others."""
    return new if bool(chosen.all()) else torch.where(per_item(chosen, new), new, old)
