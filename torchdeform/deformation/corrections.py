"""Defect correction: the determinants of a map on its grid are brought nearer to those that were prescribed."""

import torch
from torch import Tensor

from torchdeform.core.derivatives import determinant, jacobian, map_jacobian
from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.fold_free import largest_share
from torchdeform.core.grid import Grid, per_item
from torchdeform.core.warp import matrix_times, warp
from torchdeform.deformation.velocity import mode_angles, potential_velocity
from torchdeform.fem.boundary import fixed_unknowns

# A correction that would fold, or miss by more than before, is halved so often; then it is left out.
_HALVINGS = 2

# By how much the mean of |J ρ1/ρ0 − 1| may grow while the variance of the quotient falls: a map has the same mean of J
# whatever slides, so errors of the mean are not for a correction to mend.
_SLACK = 1.05

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
    move = matrix_times(gradient, slide).masked_fill(fixed_unknowns("slip", grid, u.device), 0)
    return u + _open_share(u, move, start, end, grid) * move


def _open_share(u: Tensor, move: Tensor, start: Tensor, end: Tensor, grid: Grid) -> Tensor:
    """Return the share of the move, halved twice at most, that folds nowhere and makes the error smaller, else 0."""
    variance, mean = _errors(u, start, end, grid)
    least = 16 * torch.finfo(u.dtype).eps  # positive also when it is computed again with other rounding

    def accept(share: Tensor) -> Tensor:
        moved = u + per_item(share, u) * move
        new_variance, new_mean = _errors(moved, start, end, grid)
        better = (new_variance < variance) & (new_mean < _SLACK * mean)
        return better & (smallest_determinant(moved, grid) > least)

    return per_item(largest_share(accept, variance, halvings=_HALVINGS), u)


@torch.no_grad()
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
    low, high = (per_item(bound, density) for bound in density.detach().flatten(1).aminmax(dim=1))
    return value.clamp(low / 2, high * 2)
