"""BFGS on a group of maps: many starts at once, each step in coordinates that move with the map."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchdeform.registration.affine.lie import exponential

# Longest step, in voxels of the level.
_LONGEST = 2.0


class Objective(Protocol):
    """What is maximised: value and derivative for every map, and the metric in which the first step is taken."""

    def evaluate(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Return S ``(B,)`` and ∂S/∂ξ ``(B, D, D + 1)`` for maps ``(B, D + 1, D + 1)`` followed by x + ξ [x; 1]."""
        ...

    def metric(self, maps: Tensor) -> Tensor:
        """Return the matrix ``(B, D(D + 1), D(D + 1))`` whose quadratic form says what a move ξ does to the image."""
        ...

    def longest_move(self, moves: Tensor) -> Tensor:
        """Return the longest displacement ``(B,)`` in voxels that moves ξ ``(B, D, D + 1)`` cause."""
        ...


@dataclass
class _State:
    """Maps, values, slopes, inverse Hessians of −S, and whether those are still unscaled; the batch comes first."""

    maps: Tensor
    value: Tensor
    slope: Tensor
    inverse: Tensor
    fresh: Tensor


@torch.no_grad()
def maximise(
    objective: Objective, maps: Tensor, moves: Tensor, *, steps: int, shortest: float = 0.005
) -> tuple[Tensor, Tensor]:
    """Return the maps after at most ``steps`` steps H ← H exp(Σ p_k L_k) that raise the objective, and its values.

    Args:
        objective: the similarity of one level.
        maps: starts ``(B, D + 1, D + 1)``, float64.
        moves: the moves allowed ``(P, D, D + 1)``, see `generators`.
        steps: evaluations at most.
        shortest: step in voxels of the level; an item is done when its step is shorter.

    Notes:
        Quasi-Newton: −S is modelled by κ·metric at first, with κ from the first step, then corrected by BFGS. A step
        that does not raise S is cut to a third. Items do not influence each other.
    """
    flat = moves.flatten(1)
    value, slope = objective.evaluate(maps)
    inverse = torch.linalg.inv(flat @ objective.metric(maps) @ flat.T)
    state = _State(maps, value, _project(slope, flat), inverse, torch.ones_like(value, dtype=torch.bool))
    fraction = torch.ones_like(value)
    for _ in range(steps):
        step = _direction(objective, state, moves) * fraction.unsqueeze(1)
        active = objective.longest_move(torch.einsum("bp,pij->bij", step, moves)) > shortest
        if not bool(active.any()):
            break
        trial = state.maps @ exponential(step, moves)
        value, slope = torch.full_like(state.value, -torch.inf), torch.zeros_like(slope)
        value[active], slope[active] = objective.evaluate(trial[active])
        better = active & (value > state.value)
        state = _advance(state, better, (trial, value, _project(slope, flat)), step)
        fraction = torch.where(better, 1.0, fraction / 3)
    return state.maps, state.value


def _project(slope: Tensor, flat: Tensor) -> Tensor:
    return slope.flatten(1) @ flat.T


def _direction(objective: Objective, state: _State, moves: Tensor) -> Tensor:
    """Return the quasi-Newton step; the first step of an item moves one voxel, since its scale is not known yet."""
    step = (state.inverse @ state.slope.unsqueeze(2)).squeeze(2)
    longest = objective.longest_move(torch.einsum("bp,pij->bij", step, moves)).clamp(min=1e-12)
    scale = torch.where(state.fresh, 1 / longest, (_LONGEST / longest).clamp(max=1.0))
    return step * scale.unsqueeze(1)


def _advance(state: _State, better: Tensor, trial: tuple[Tensor, Tensor, Tensor], step: Tensor) -> _State:
    """Return the state with the better items moved and their inverse Hessians of −S updated."""
    maps, value, slope = trial
    change = state.slope - slope
    inverse = _updated(state, step, change)
    useful = better & ((step * change).sum(1) > 0)
    return _State(
        torch.where(better.view(-1, 1, 1), maps, state.maps),
        torch.where(better, value, state.value),
        torch.where(better.unsqueeze(1), slope, state.slope),
        torch.where(useful.view(-1, 1, 1), inverse, state.inverse),
        state.fresh & ~useful,
    )


def _updated(state: _State, step: Tensor, change: Tensor) -> Tensor:
    """Return the BFGS update of the inverse Hessian; a fresh one is first scaled by sᵀy / yᵀ B y."""
    product = (step * change).sum(1).clamp(min=1e-30).view(-1, 1, 1)
    bent = (state.inverse @ change.unsqueeze(2)).squeeze(2)
    ratio = product / (change * bent).sum(1).clamp(min=1e-30).view(-1, 1, 1)
    inverse = torch.where(state.fresh.view(-1, 1, 1), ratio * state.inverse, state.inverse)
    left = torch.eye(step.shape[1], dtype=step.dtype, device="cpu") - step.unsqueeze(2) * change.unsqueeze(1) / product
    return left @ inverse @ left.transpose(1, 2) + step.unsqueeze(2) * step.unsqueeze(1) / product
