"""A velocity with a given divergence that does not cross the boundary: three ways to get it."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.deformation.monitors import mean_value
from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.fem import solve_div_curl
from torchdeform.solvers.sine_cosine import Kinds, inverse_transform, separable_transform

VelocityName = Literal["direct", "poisson", "div_curl"]


def find_velocity(
    div: Tensor, grid: Grid, velocity: VelocityName = "div_curl", *, curl: Tensor | None = None
) -> Tensor:
    """Return v with div v = α − (∫ α)/|Ω| in Ω and n·v = 0 on its boundary.

    Args:
        div: α ``(B, 1, *S)``, units of v per unit of spacing.
        grid: the grid.
        velocity: ``direct`` (integrals along the axes), ``poisson`` (v = ∇w by cosine transforms) or ``div_curl``
            (least squares for the divergence and the curl).
        curl: β ``(B or 1, 1, *S)`` in 2D, ``(B or 1, 3, *S)`` in 3D, the curl of v, for ``div_curl``; 0 by default.

    Returns:
        v ``(B, D, *S)``; its normal component on the boundary is zero to the last bit.

    Raises:
        InputError: shapes, types, an unknown way, a curl with another way than ``div_curl`` or one that is not finite.
        ComputationError: the least squares could not be solved.

    Notes:
        Second order in the spacing, all three. ``direct`` is the cheapest, but moves what lies far from where α lives.
        Linear, differentiable in div and curl to every degree. Liu, Liao & Xue 2007, eq. (2.15) and section 2.1.
    """
    require_choice(velocity, _WAYS, "velocity")
    grid.check_scalar(div, "find_velocity: div")
    if div.dtype not in (torch.float32, torch.float64):
        raise InputError(f"find_velocity: div must be float32 or float64, got {div.dtype}")
    alpha = div - mean_value(div, grid)
    if curl is None:
        return _WAYS[velocity](alpha, grid)
    if velocity != "div_curl":
        raise InputError(f"velocity {velocity!r} leaves the curl free; take velocity='div_curl' to prescribe it")
    if not bool(curl.isfinite().all()):
        raise InputError("find_velocity: curl must be finite, got NaN or infinity")
    return _div_curl(alpha, grid, curl)


def _div_curl(alpha: Tensor, grid: Grid, curl: Tensor | None = None) -> Tensor:
    solution = solve_div_curl(alpha, curl, grid)
    if not solution.ok:
        reason = next(status.value for status in solution.status if not status.ok)
        raise ComputationError(f"find_velocity: the div-curl system was not solved: {reason}")
    return solution.value


def _direct(alpha: Tensor, grid: Grid) -> Tensor:
    """Return v_k = h'(x_0) .. h'(x_k−1) [∫_0^{x_k} a_k − h(x_k) ∫ a_k], a_k being α integrated over the axes before k.

    The divergence of v_k leaves h'(x_0) .. h'(x_k) ∫ a_k over for the next axis; after the last one that is ∫ α = 0.
    The integral over all of the axis is the last of the running integrals and h is 1 there, so v_k ends in 0 exactly.
    """
    rest, slopes, parts = alpha, alpha.new_ones(()), []
    for axis, spacing in zip(grid.axes, grid.spacing, strict=True):
        running = _running_integral(rest, axis, spacing)
        total = running.narrow(axis, running.shape[axis] - 1, 1)
        share, slope = _profile(grid, axis - 2, alpha)
        parts.append((slopes * (running - share * total)).expand_as(alpha))
        rest, slopes = total, slopes * slope
    return torch.cat(parts, dim=1)


def _running_integral(field: Tensor, axis: int, spacing: float) -> Tensor:
    """Return ∫_0^x field along one axis by the trapezoidal rule, 0 at the first node."""
    count = field.shape[axis] - 1
    cells = (field.narrow(axis, 0, count) + field.narrow(axis, 1, count)) * (spacing / 2)
    return torch.cat([torch.zeros_like(field.narrow(axis, 0, 1)), cells.cumsum(axis)], dim=axis)


def _profile(grid: Grid, axis: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return h and h' along one axis, h(t) = (1 − cos πt)/2 over its length.

    h is the running integral of h' by the rule that integrates α, scaled to end in 1: the two fit exactly.
    """
    size, spacing = grid.shape[axis], grid.spacing[axis]
    place = torch.arange(size, dtype=torch.float64, device=like.device) / (size - 1)
    column = (1, 1, *(size if a == axis else 1 for a in range(grid.dim)))
    slope = torch.sin(math.pi * place)
    slope[-1] = 0.0  # not 1e-16
    if size == 2:
        slope.fill_(1.0)  # one cell: h is linear, as its sine vanishes at both nodes
    share = _running_integral(slope, 0, spacing)
    return (share / share[-1]).view(column).to(like), (slope / share[-1]).view(column).to(like)


def _poisson(alpha: Tensor, grid: Grid) -> Tensor:
    """Return v = ∇w with Δw = α and n·∇w = 0, exact for the cosines that α is made of at the nodes.

    With ξ_k = π j_k / length_k, α = Σ a Π cos ξ_k x_k gives w = −Σ a/|ξ|² Π cos ξ_k x_k.
    """
    frequencies = [angle / h for angle, h in zip(mode_angles(grid, alpha), grid.spacing, strict=True)]
    squares = torch.stack(torch.broadcast_tensors(*[xi**2 for xi in frequencies])).sum(0)
    return potential_velocity(alpha, grid, frequencies, squares)


def potential_velocity(alpha: Tensor, grid: Grid, slopes: Sequence[Tensor], squares: Tensor) -> Tensor:
    """Return v = ∇w, every mode of α = Δw having been divided by what Δ does to it.

    Args:
        alpha: ``(B, 1, *S)``; its mean is left out.
        grid: the grid.
        slopes: what ∂_k does to a cosine along axis k, which becomes a sine, for each axis; broadcast over modes.
        squares: what −Δ does to a product of cosines, ``(1, 1, *S)``, positive but for the constant.

    Returns:
        v ``(B, D, *S)``, n·v = 0 on the boundary.
    """
    modes = alpha
    for axis in grid.axes:
        modes = inverse_transform(modes, axis, "cosine")
    divisor = squares.clone()
    divisor.view(-1)[0] = math.inf  # w has no constant
    potential = modes / divisor
    kinds: Kinds = tuple(tuple("sine" if axis == k else "cosine" for axis in range(grid.dim)) for k in range(grid.dim))
    return separable_transform(torch.cat([potential * slope for slope in slopes], dim=1), kinds)


def mode_angles(grid: Grid, like: Tensor) -> list[Tensor]:
    """Return θ_k = π j/(n_k − 1), by how much a mode turns from node to node, for each axis; broadcast over modes."""
    angles = [torch.arange(n, dtype=torch.float64, device=like.device) * (math.pi / (n - 1)) for n in grid.shape]
    return [
        theta.view(1, 1, *(-1 if a == k else 1 for a in range(grid.dim))).to(like) for k, theta in enumerate(angles)
    ]


_WAYS = {"direct": _direct, "poisson": _poisson, "div_curl": _div_curl}
