"""What is done to a map at the end: its determinants on the grid are set right, folds between nodes taken out."""

import torch
from torch import Tensor

from torchdeform.core.derivatives import determinant, jacobian, map_jacobian
from torchdeform.core.diagnostics import one_sided_determinant, smallest_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp
from torchdeform.deformation.velocity import mode_angles, potential_velocity
from torchdeform.errors import ComputationError
from torchdeform.fem.boundary import fixed_unknowns

# A correction that would fold, or miss by more than before, is shortened to these shares of it; then it is left out.
_SHARES = (1.0, 0.5, 0.25)

# By how much the mean of |J ρ1/ρ0 − 1| may grow while the variance of the quotient falls: a map has the same mean of J
# whatever slides, so errors of the mean are not for a correction to mend.
_SLACK = 1.05

# Nodes are moved to the middle of their neighbours this often at most; 50 times is the most that has been seen.
_MAX_ROUNDS = 1000

# Weight of second differences in `_slide`. Smaller follows finer errors, larger is smoother; see there.
_DAMPING = 0.1


def correct_determinant(u: Tensor, start: Tensor, end: Tensor, grid: Grid) -> Tensor:
    """Return u + ∇φ z, nearer to J(φ) ρ1(φ) = ρ0 by one step of defect correction.

    The derivative of J(φ) ρ1(φ) along ∇φ z, which slides the nodes within the map, is div(J(φ) ρ1(φ) z). With the
    values that shall be, z = w/ρ0 with div w = ρ0 − J(φ) ρ1(φ) and n·w = 0.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing, n·u = 0 on the boundary.
        start: density ρ0 ``(B, 1, *S)`` at the old places of the nodes.
        end: density ρ1 ``(B, 1, *S)``, sampled at the new ones to second order.
        grid: the grid of all.

    Returns:
        ``(B, D, *S)``; an item whose determinants cannot be improved like this without a fold is left as it is.

    Raises:
        InputError: shapes, or fewer than 3 nodes along an axis.

    Notes:
        J is the determinant of central differences, `jacobian_determinant`: the size of the cells around a node, not
        that of a smooth map through the nodes. On smooth monitors one step divides the error of J by ten or more.
        Differentiable.
    """
    gradient = map_jacobian(u, grid)
    defect = start - determinant(gradient) * _moved(end, u, grid)
    slide = _slide(defect, grid) / start
    move = _tangential((gradient * slide.unsqueeze(1)).sum(dim=2), grid)
    return u + _longest_share(u, move, start, end, grid) * move


@torch.no_grad()
def _longest_share(u: Tensor, move: Tensor, start: Tensor, end: Tensor, grid: Grid) -> Tensor:
    """Return the first of `_SHARES` that leaves each item without folds and with a smaller error, else 0."""
    share = u.new_zeros(u.shape[0])
    variance, mean = _errors(u, start, end, grid)
    for trial in _SHARES:
        moved = u + trial * move
        new_variance, new_mean = _errors(moved, start, end, grid)
        better = (new_variance < variance) & (new_mean < _SLACK * mean)
        good = better & (smallest_determinant(moved, grid) > _least(u))
        share = torch.where((share == 0) & good, trial, share)
        if bool((share > 0).all()):
            break
    return share.view(-1, *[1] * (grid.dim + 1))


def _errors(u: Tensor, start: Tensor, end: Tensor, grid: Grid) -> tuple[Tensor, Tensor]:
    """Return for each item the variance of q = J(φ) ρ1(φ)/ρ0 and the mean of |q − 1|."""
    quotient = determinant(map_jacobian(u, grid)) * _moved(end, u, grid) / start
    # One by one: a batch may be summed in another order than an item alone.
    return torch.stack([q.var() for q in quotient]), torch.stack([(q - 1).abs().mean() for q in quotient])


def _slide(div: Tensor, grid: Grid) -> Tensor:
    """Return w = ∇p with the divergence asked for as central differences see it: they turn cos into sin θ/h sin.

    Where θ is near π they see next to nothing, so the divisor Σ sin² θ/h² gets a share of the squared second
    differences, Σ (1 − cos θ)²/h². With the whole of it, it would be −Δ_h.
    """
    angles = mode_angles(grid, div)
    slopes = [theta.sin() / h for theta, h in zip(angles, grid.spacing, strict=True)]
    rests = [2 * (theta / 2).sin() ** 2 / h for theta, h in zip(angles, grid.spacing, strict=True)]
    squares = [slope**2 + _DAMPING * rest**2 for slope, rest in zip(slopes, rests, strict=True)]
    return potential_velocity(div, grid, slopes, torch.stack(torch.broadcast_tensors(*squares)).sum(0))


def _moved(density: Tensor, u: Tensor, grid: Grid) -> Tensor:
    """Return density(p) at p = x + u, exact for quadratics, and never beyond twice its range.

    Linear interpolation Σ w_c ρ(x_c) between corners x_c misses as much on one side as
    Σ w_c [ρ(x_c) + ∇ρ(x_c)·(p − x_c)] does on the other: their mean is taken. With linear interpolation half of the
    error of the map would stay.
    """
    nodes = grid.points(dtype=density.dtype, device=density.device)
    slope = jacobian(density, grid).squeeze(1)
    corners = torch.cat([density, (nodes * slope).sum(1, keepdim=True), slope], dim=1)
    linear, offset, slope = warp(corners, u, grid).split([1, 1, grid.dim], dim=1)
    value = linear + (((nodes + u) * slope).sum(1, keepdim=True) - offset) / 2
    low, high = (bound.view(-1, *[1] * (grid.dim + 1)) for bound in density.detach().flatten(1).aminmax(dim=1))
    return value.clamp(low / 2, high * 2)


def remove_folds(u: Tensor, grid: Grid) -> Tensor:
    """Return u with the nodes around folds moved to the middle of their neighbours until φ = id + u has no folds.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing, n·u = 0 on the boundary.
        grid: its grid.

    Returns:
        ``(B, D, *S)``, a digital diffeomorphism; the same numbers where the nodes within some cells have no folds.

    Raises:
        InputError: shape.
        ComputationError: there are still folds after 1000 rounds, or u is not finite.

    Notes:
        The flow of a velocity does not fold, but where a map bends within a cell the simplices between its nodes may.
        Each round moves the nodes around the folds seen so far by a share that fades out over a few cells towards the
        mean of their neighbours; continued for ever, that would end in the identity. Differentiable in u for the nodes
        that are moved.
    """
    share = torch.zeros_like(u[:, :1])
    for _ in range(_MAX_ROUNDS):
        folded = ~(one_sided_determinant(u, grid) > _least(u))
        if not bool(folded.any()):
            return u
        share = torch.maximum(share, _widen(_widen(folded.to(u.dtype), grid), grid))
        fading = _middle(_middle(share, grid), grid)
        u = u + _tangential(fading * (_middle(u, grid) - u), grid)
    raise ComputationError(
        f"the map still folds after {_MAX_ROUNDS} rounds of smoothing: the monitor varies too much for this grid; "
        "smooth it, raise f_min, or take a finer grid"
    )


def _least(u: Tensor) -> float:
    """What counts as no fold: positive also when it is computed again with other rounding."""
    return 16 * torch.finfo(u.dtype).eps


def _tangential(move: Tensor, grid: Grid) -> Tensor:
    """Return the move with the normal component on the boundary set to exactly zero."""
    return move.masked_fill(fixed_unknowns("slip", grid, move.device), 0)


def _neighbours(x: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the values before and after each node along an axis, the ends being repeated."""
    count = x.shape[axis] - 1
    before = torch.cat([x.narrow(axis, 0, 1), x.narrow(axis, 0, count)], dim=axis)
    return before, torch.cat([x.narrow(axis, 1, count), x.narrow(axis, count, 1)], dim=axis)


def _widen(x: Tensor, grid: Grid) -> Tensor:
    """Return the largest value among each node and its neighbours, diagonal ones included."""
    for axis in grid.axes:
        before, after = _neighbours(x, axis)
        x = torch.maximum(x, torch.maximum(before, after))
    return x


def _middle(x: Tensor, grid: Grid) -> Tensor:
    """Return the mean of the 2·D neighbours of each node."""
    return torch.stack([near for axis in grid.axes for near in _neighbours(x, axis)]).mean(0)
