"""Whether two images are registered alike in both directions, each found without the other."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchdeform.core.fold_free import where_items
from torchdeform.core.grid import Grid, limit_threads
from torchdeform.core.resampling import with_nodes
from torchdeform.core.warp import warp
from torchdeform.registration.evidence import ROUGH, Views
from torchdeform.registration.objective import forward_objective
from torchdeform.registration.optimise import make_level
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import MetricSettings, RegistrationSettings, SimilaritySettings
from torchdeform.registration.velocity import image_force, normalise_step

# Two maps agree where they do to this many voxels of the rough grid.
_AGREE = 1.0

# Steps, the longest move of the first in voxels, and the share of the last direction that each goes on with. Steps of
# `register`, which keep the map from folding, take three times as long and tell less.
_STEPS, _STEP, _MOMENTUM = 8, 2.0, 0.5

_SETTINGS = RegistrationSettings(
    similarity=SimilaritySettings(measure="lncc", window=7), metric=MetricSettings(length_scale=4.0)
)


@torch.no_grad()
def disagreement(problem: RegistrationProblem, settings: RegistrationSettings) -> Tensor:
    """Return the share of what has contrast where rough maps there and back miss each other by more than a voxel.

    Args:
        problem: two images of one channel, see `to_compare`.
        settings: whose solver and stencil to use.

    Returns:
        ``(B,)`` from 0 to 1.

    Notes:
        Images that show the same pull both maps to the same place; others have many optima, and each direction finds
        its own. Both are items of one batch on a grid of few nodes: 30 ms in 2D, 50 ms in 3D.
    """
    rough = problem.on(with_nodes(problem.grid, ROUGH[problem.grid.dim]))
    grid = Grid(rough.grid.shape)  # in voxels
    both = RegistrationProblem(grid, *_there_and_back(rough.fixed, rough.moving), *_masks(rough), held=rough.held)
    with limit_threads(1, grid):
        quick = replace(_SETTINGS, solver=settings.solver, stencil=settings.stencil)
        there, back = _maps(both, quick).chunk(2)
        far = (there + warp(back, there, grid)).norm(dim=1, keepdim=True) > _AGREE
    seen = Views.of(rough).seen
    return (far * seen).flatten(1).sum(1) / seen.flatten(1).sum(1).clamp(min=1e-9)


def _maps(problem: RegistrationProblem, settings: RegistrationSettings) -> Tensor:
    """Return the best displacements met in some steps of steepest ascent; they may fold."""
    level = make_level(problem, settings, forward_objective, 0, 1)
    best = u = direction = level.zero
    top = u.new_full((len(u),), -math.inf)
    for step in range(_STEPS + 1):
        warped, value, slope = level.objective.similarity.evaluate(u)
        best, top = where_items(value > top, u, best), top.maximum(value)
        velocity = level.metric.velocity(image_force(slope, warped, problem.grid, settings.stencil))
        direction = normalise_step(velocity, problem.grid) + _MOMENTUM * direction
        u = u + _STEP * (1 - step / _STEPS) * normalise_step(direction, problem.grid)
    return best


def _there_and_back(one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    return torch.cat([one, other]), torch.cat([other, one])


def _masks(problem: RegistrationProblem) -> tuple[Tensor | None, Tensor | None]:
    """Return the masks of both directions, None where there are none."""
    if problem.fixed_mask is None and problem.moving_mask is None:
        return None, None
    full = torch.ones_like(problem.fixed)
    masks = (full if mask is None else mask.expand_as(full) for mask in (problem.fixed_mask, problem.moving_mask))
    return _there_and_back(*masks)
