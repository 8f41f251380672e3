"""Two maps found independently agree where images show the same, and only there."""

import pytest
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp
from torchdeform.registration.agreement import disagreement
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import RegistrationSettings


def texture(seed: int, *shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    field = torch.rand(1, 1, *[n // 4 for n in shape], generator=generator)
    mode = {2: "bicubic", 3: "trilinear"}[len(shape)]
    return torch.nn.functional.interpolate(field, size=shape, mode=mode, align_corners=True).clamp(0, 1)


@pytest.mark.parametrize("shape", [(40, 40), (16, 18, 16)])
def test_maps_of_one_scene_agree_and_those_of_two_do_not(shape, make_displacement):
    grid = Grid(shape)
    fixed = texture(0, *shape)
    moved = warp(fixed, make_displacement(grid, 0.05), grid)
    pair = RegistrationProblem(grid, torch.cat([fixed, fixed, fixed]), torch.cat([fixed, moved, texture(7, *shape)]))
    same, near, other = disagreement(pair, RegistrationSettings()).tolist()
    assert same == 0
    assert near < 0.05
    assert other > 0.2


def test_masks_go_along():
    grid = Grid((40, 40))
    fixed, other = texture(0, 40, 40), texture(7, 40, 40)
    mask = torch.zeros_like(fixed)
    mask[..., :20] = 1
    mixed = torch.where(mask > 0, fixed, other)
    assert float(disagreement(RegistrationProblem(grid, fixed, mixed, mask, mask), RegistrationSettings())) < 0.05
    assert float(disagreement(RegistrationProblem(grid, fixed, mixed), RegistrationSettings())) > 0.05
