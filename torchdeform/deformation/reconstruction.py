"""A map from the divergence and the curl of its displacement and from its boundary values."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, KERNELS
from torchdeform.core.grid import Grid, magnitude
from torchdeform.deformation.finite_differences import Differences
from torchdeform.errors import InputError, require_choice
from torchdeform.fem.div_curl import DivCurlSolution, solve_div_curl
from torchdeform.solvers.base import Solution
from torchdeform.solvers.cg import conjugate_gradient


@dataclass(frozen=True)
class Reconstruction(Solution):
    """A map from its divergence and curl.

    Attributes:
        value: displacement u ``(B, D, *S)`` in units of spacing.
        residual: of the linear system that was solved last, relative.
        misfit: ‖(div, curl) − (div u, curl u)‖ / ‖(div, curl)‖ in the L2 norm, with the finite differences of u,
            ``(B,)``.
        trajectory: u at the time steps 1 to ``steps``, ``(steps, B, D, *S)``, the last one being ``value``; None unless
            asked for.
    """

    misfit: Tensor
    trajectory: Tensor | None


def reconstruct(
    div: Tensor,
    curl: Tensor,
    grid: Grid,
    boundary_displacement: Tensor,
    *,
    order: int = 2,
    refine: bool = False,
    steps: int | None = None,
) -> Reconstruction:
    """Return the displacement u with div u = α and curl u = β in Ω that is given on its boundary.

    Args:
        div: α ``(B, 1, *S)``, no unit. It is that of the displacement: div φ = α + D for the map φ = id + u.
        curl: β ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, components as in `stencil.curl`; u and φ have the same.
        grid: the grid.
        boundary_displacement: u ``(B, D, *S)`` in units of spacing, only its boundary nodes matter.
        order: order of the finite differences that made α and β, 2 or 4; for ``refine``.
        refine: correct u by what its own finite differences still miss of α and β.
        steps: number of time steps of a `Reconstruction.trajectory` from the identity to φ.

    Returns:
        `Reconstruction`.

    Raises:
        InputError: shapes, types, order, steps below 1, or too few nodes for the order.

    Notes:
        Elements alone: one direct solve by sine transforms, error O(h²) in maps that are smooth on the grid, from
        either order. Refined: least squares of div u − α and curl u − β on the finite differences themselves, by
        conjugate gradients from there, which gives back any u to solver precision. At time step k of n the data are k/n
        of α, β and the boundary values, and u, which is linear in them, k/n of the last one. Differentiable in all
        data, to every degree. Liu, Liao & Xue 2007, section 3.
    """
    require_choice(order, KERNELS, "reconstruct: order")
    if steps is not None and (not isinstance(steps, int) or steps < 1):
        raise InputError(f"reconstruct: steps must be a whole number, at least 1, got {steps!r}")
    for name, field, components in (
        ("div", div, 1),
        ("curl", curl, len(CURL_PAIRS[grid.dim])),
        ("boundary_displacement", boundary_displacement, grid.dim),
    ):
        grid.check(field, f"reconstruct: {name}", components=components)
    differences = Differences(grid, order)
    first = solve_div_curl(div, curl, grid, "dirichlet", boundary_values=boundary_displacement)
    data = torch.cat([part.expand(first.value.shape[0], -1, *grid.shape) for part in (div, curl)], dim=1)
    solution: Solution = _refine(first, data, differences) if refine else first
    u = solution.value
    return Reconstruction(
        value=u,
        status=solution.status,
        steps=solution.steps,
        residual=solution.residual,
        misfit=_misfit(u, data, differences),
        trajectory=None if steps is None else torch.stack([u * (k / steps) for k in range(1, steps)] + [u]),
    )


def _refine(first: DivCurlSolution, data: Tensor, differences: Differences) -> Solution:
    """Add the v, zero on the boundary, for which the squares of what is still missing are least: Aᵀ W A v = Aᵀ W r."""
    missing = differences.adjoint(data - differences.rows(first.value))
    step = conjugate_gradient(
        lambda v: differences.adjoint(differences.rows(v)),
        missing,
        preconditioner=differences.preconditioner(missing),
    )
    return Solution(first.value + step.value, step.status, step.steps, step.residual)


@torch.no_grad()
def _misfit(u: Tensor, data: Tensor, differences: Differences) -> Tensor:
    scale = magnitude(data)
    size = differences.norm(data / scale)
    return torch.where(size > 0, differences.norm((data - differences.rows(u)) / scale) / size, 0)
