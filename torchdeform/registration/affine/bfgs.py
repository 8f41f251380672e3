"""Climbing a similarity over a group of maps: BFGS in the frame that moves along, many starts at once."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchdeform.registration.affine.lie import exponential

# Longest step, in voxels of the level.
_LONGEST = 2.0


class Hill(Protocol):
    """What is climbed: a value and its slope for every map, the metric in which the first step is taken."""

    def evaluate(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Return S ``(B,)`` and ∂S/∂ξ ``(B, D, D + 1)`` for maps ``(B, D + 1, D + 1)`` followed by x + ξ [x; 1]."""
        ...

    def metric(self, maps: Tensor) -> Tensor:
        """Return the matrix ``(B, D(D + 1), D(D + 1))`` whose quadratic form says what a move ξ does to the image."""
        ...

    def reach(self, moves: Tensor) -> Tensor:
        """Return the longest displacement ``(B,)`` in voxels that moves ξ ``(B, D, D + 1)`` cause."""
        ...


@dataclass
class _State:
    """Where every item stands. All tensors have the batch first."""

    maps: Tensor
    value: Tensor
    slope: Tensor
    inverse: Tensor
    fresh: Tensor


@torch.no_grad()
def climb(hill: Hill, maps: Tensor, moves: Tensor, *, steps: int, shortest: float = 0.005) -> tuple[Tensor, Tensor]:
    """Return the maps after at most ``steps`` evaluations uphill, H ← H exp(Σ p_k L_k), and their values.

    Args:
        hill: the similarity of one level.
        maps: starts ``(B, D + 1, D + 1)``, float64.
        moves: the moves allowed ``(P, D, D + 1)``, see `generators`.
        steps: evaluations at most.
        shortest: step, in voxels of the level, below which an item stands still.

    Notes:
        Quasi-Newton: −S is modelled by κ·metric at first, with κ from the first step, then corrected by BFGS. A step
        that does not raise S is cut to a third. Items do not influence each other.
    """
    flat = moves.flatten(1)
    value, slope = hill.evaluate(maps)
    inverse = torch.linalg.inv(flat @ hill.metric(maps) @ flat.T)
    state = _State(maps, value, _project(slope, flat), inverse, torch.ones_like(value, dtype=torch.bool))
    fraction = torch.ones_like(value)
    for _ in range(steps):
        step = _direction(hill, state, moves) * fraction.unsqueeze(1)
        active = hill.reach(torch.einsum("bp,pij->bij", step, moves)) > shortest
        if not bool(active.any()):
            break
        trial = state.maps @ exponential(step, moves)
        value, slope = torch.full_like(state.value, -torch.inf), torch.zeros_like(slope)
        value[active], slope[active] = hill.evaluate(trial[active])
        better = active & (value > state.value)
        state = _advance(state, better, (trial, value, _project(slope, flat)), step)
        fraction = torch.where(better, 1.0, fraction / 3)
    return state.maps, state.value


def _project(slope: Tensor, flat: Tensor) -> Tensor:
    return slope.flatten(1) @ flat.T


def _direction(hill: Hill, state: _State, moves: Tensor) -> Tensor:
    """Return the quasi-Newton step; the first one of an item, whose scale is not known yet, moves one voxel."""
    step = (state.inverse @ state.slope.unsqueeze(2)).squeeze(2)
    reach = hill.reach(torch.einsum("bp,pij->bij", step, moves)).clamp(min=1e-12)
    scale = torch.where(state.fresh, 1 / reach, (_LONGEST / reach).clamp(max=1.0))
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
    left = torch.eye(step.shape[1], dtype=step.dtype) - step.unsqueeze(2) * change.unsqueeze(1) / product
    return left @ inverse @ left.transpose(1, 2) + step.unsqueeze(2) * step.unsqueeze(1) / product
