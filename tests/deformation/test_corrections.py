"""What is done to a map at the end: folds are removed where they are, determinants corrected, nothing made worse."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid
from torchdeform.deformation import versions
from torchdeform.deformation.corrections import correct_determinant
from torchdeform.deformation.monitors import MonitorSettings, mean_value, ring_monitor
from torchdeform.deformation.versions import DeformationSettings, grid_from_initial_monitor
from torchdeform.errors import ComputationError

FLOW_ONLY = DeformationSettings(corrections=0, remove_folds=False)


def stays_on_faces(u: Tensor) -> bool:
    dim = u.dim() - 2
    return all(not u[:, k].select(k + 1, end).any() for k in range(dim) for end in (0, -1))


def ring(grid: Grid, f_min: float, width: float) -> Tensor:
    centre = [side / 2 for side in grid.extent]
    return ring_monitor(grid, centre, 0.3 * grid.extent[0], width, MonitorSettings(f_min=f_min, dtype=torch.float64))


def test_a_flow_that_is_not_finite_is_an_error(monkeypatch):
    grid = Grid((8, 8))
    monkeypatch.setattr(versions, "_follow", lambda u, *_: u + math.nan)
    with pytest.raises(ComputationError, match="the flow is not finite: the monitor spans too many orders"):
        grid_from_initial_monitor(ring(grid, 0.5, 2.0), grid)


@pytest.mark.parametrize("grid", [Grid((33, 33), (0.5, 0.5)), Grid((33, 33, 33))])
def test_a_correction_never_makes_it_worse(grid):
    """On a monitor too sharp for the grid, where it must be shortened or left out, item by item."""
    side = grid.extent[0]
    f = torch.cat([ring(grid, 0.7, 0.15 * side), ring(grid, 0.01, 0.06 * side)])
    start = f / mean_value(f, grid)
    end = torch.ones_like(start)
    u = grid_from_initial_monitor(f, grid, settings=replace(FLOW_ONLY, remove_folds=True))
    better = correct_determinant(u, start, end, grid)
    before, after = ((jacobian_determinant(w, grid) / start).flatten(1).var(1) for w in (u, better))
    assert after[0] < 0.05 * before[0]
    assert after[1] <= before[1]
    assert diagnose(better, grid).diffeomorphic.all()
    assert stays_on_faces(better)


def test_gradients():
    grid = Grid((6, 7), (0.5, 1.0))
    f = ring(grid, 0.7, 1.0)
    start = (f / mean_value(f, grid)).requires_grad_()
    end = torch.rand(f.shape, dtype=f.dtype, generator=torch.manual_seed(0)).mul_(0.1).add_(1).requires_grad_()
    inner = 0.05 + 0.1 * torch.rand(1, 2, 4, 5, dtype=f.dtype, generator=torch.manual_seed(1))

    def moved(part: Tensor) -> Tensor:
        """Boundary nodes stay where they are: there the interpolation of the density has a kink."""
        return torch.nn.functional.pad(part, (1, 1, 1, 1))

    assert gradcheck(
        lambda part, s, e: correct_determinant(moved(part), s, e, grid), (inner.requires_grad_(), start, end)
    )
    bent = moved(inner).detach()
    bent[0, 0, 3, 3] = 0.8
    assert not diagnose(bent, grid).diffeomorphic.all()
    assert gradcheck(lambda u: repair_folds(u, grid), bent.requires_grad_())
