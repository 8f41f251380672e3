"""Whether two images are registered alike in both directions, each found without the other."""

from dataclasses import replace

import torch
from torch import Tensor

from torchdeform.core.grid import Grid, limit_threads
from torchdeform.core.warp import warp
from torchdeform.registration.evidence import ROUGH, Views, smaller
from torchdeform.registration.optimise import optimise_levels
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import OptimiserSettings, RegistrationSettings, SimilaritySettings

# Two maps agree where they do to this many voxels of the rough grid.
_AGREE = 1.0

_SETTINGS = RegistrationSettings(
    similarity=SimilaritySettings(measure="lncc", window=7),
    optimiser=OptimiserSettings(steps=(10,), step_length=2.0),  # 25 steps of 1 tell no more
)


@torch.no_grad()
def disagreement(problem: RegistrationProblem, settings: RegistrationSettings) -> Tensor:
    """Return the share of what has contrast where rough maps there and back miss each other by more than a voxel.

    Args:
        problem: two images of one channel, see `to_compare`.
        settings: by which solver, flow and stencil.

    Returns:
        ``(B,)`` from 0 to 1.

    Notes:
        Images that show the same pull both maps to the same place; others have many optima, and every way finds
        another. Both directions are the items of one batch, on a grid of few nodes: less than a tenth of a second.
    """
    rough = problem.on(smaller(problem.grid, ROUGH[problem.grid.dim]))
    grid = Grid(rough.grid.shape)  # in voxels
    both = RegistrationProblem(grid, *_there_and_back(rough.fixed, rough.moving), *_masks(rough))
    with limit_threads(1, grid):
        quick = replace(_SETTINGS, solver=settings.solver, flow=settings.flow, stencil=settings.stencil)
        there, back = optimise_levels(both, quick, None, None)[0].chunk(2)
        apart = (there + warp(back, there, grid)).norm(dim=1, keepdim=True)
        far = (apart > _AGREE).to(apart)
    seen = Views.of(rough).seen
    return (far * seen).flatten(1).sum(1) / seen.flatten(1).sum(1).clamp(min=1e-9)


def _there_and_back(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    return torch.cat([one, other]), torch.cat([other, one])


def _masks(problem: RegistrationProblem) -> tuple[Tensor | None, Tensor | None]:
    """Return the masks of both directions, None where there are none."""
    if problem.fixed_mask is None and problem.moving_mask is None:
        return None, None
    full = torch.ones_like(problem.fixed)
    masks = (full if mask is None else mask.expand_as(full) for mask in (problem.fixed_mask, problem.moving_mask))
    return _there_and_back(*masks)
