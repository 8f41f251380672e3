"""The average of maps: by their Jacobian determinants and curls, not by their displacements."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdeform.core.derivatives import curl, jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.deformation.prescribed import NewtonSettings, PrescribedSolution, from_jacobian_and_curl
from torchdeform.errors import InputError

_DEFAULT = NewtonSettings()


def average_maps(
    displacements: Sequence[Tensor],
    grid: Grid,
    weights: Sequence[float] | None = None,
    *,
    order: int = 2,
    least: float = 0.0,
    settings: NewtonSettings = _DEFAULT,
) -> PrescribedSolution:
    """Return u of the map with det ∇φ = Π (det ∇φ_i)^w_i and curl φ = Σ w_i curl φ_i, and boundary values Σ w_i u_i.

    Args:
        displacements: u_i ``(B, D, *S)`` in units of spacing, one or more, of maps φ_i = id + u_i with positive
            determinants.
        grid: the grid of all.
        weights: w_i, not negative; divided by their sum; equal by default.
        order: order of the finite differences, 2 or 4.
        least: determinants below this count as this; 0 refuses maps with a determinant that is not positive.
        settings: tolerance and steps of `from_jacobian_and_curl`.

    Returns:
        `PrescribedSolution`. As a rule no map has just that determinant and curl: the status is then ``STAGNATED`` and
        the value the least-squares answer.

    Raises:
        InputError: no maps, shapes, types, weights, or a map whose determinant is not positive.

    Notes:
        The mean of the displacements shrinks where the maps rotate in different ways, by the cosine of half the angle
        between two of them; the geometric mean of determinants does not. It starts there. Differentiable once in the
        displacements.
    """
    shares = _shares(displacements, weights)
    log_det = rotation = mean = torch.zeros((), dtype=torch.float32, device="cpu")
    for index, (u, share) in enumerate(zip(displacements, shares, strict=True)):
        det = jacobian_determinant(u, grid, order)
        det = det.clamp(min=least) if least > 0 else det
        if not bool((det > 0).all()):
            raise InputError(f"average_maps: map {index} folds, its determinant falls to {float(det.min()):g}")
        log_det, rotation, mean = log_det + share * det.log(), rotation + share * curl(u, grid, order), mean + share * u
    return from_jacobian_and_curl(
        log_det.exp(),
        rotation,
        grid,
        boundary_displacement=mean,
        start=mean.detach(),
        order=order,
        settings=settings,
    )


def _shares(displacements: Sequence[Tensor], weights: Sequence[float] | None) -> list[float]:
    """Return the weights with sum 1, one per map."""
    weights = [1.0] * len(displacements) if weights is None else [float(w) for w in weights]
    if not displacements or len(weights) != len(displacements):
        raise InputError(f"average_maps: got {len(displacements)} maps and {len(weights)} weights; give one for each")
    if not all(0 <= w < float("inf") for w in weights) or sum(weights) == 0:
        raise InputError(f"average_maps: weights must be finite, not negative and not all zero, got {weights}")
    return [w / sum(weights) for w in weights]
