"""Groups of affine maps: rotations without gaps, and the exponential."""

import math

import pytest
import torch
from affine_pairs import turn

from torchdeform.registration.affine.lie import angle, exponential, generators, homogeneous, rotations


@pytest.mark.parametrize("dim", [2, 3])
def test_rotations_are_a_group_that_leaves_no_gaps(dim):
    every = rotations(dim)
    eye = torch.eye(dim, dtype=torch.float64)
    assert len(every) == {2: 36, 3: 60}[dim]
    torch.testing.assert_close(every[0], eye)
    torch.testing.assert_close(every @ every.transpose(1, 2), eye.expand_as(every))
    assert (torch.linalg.det(every) > 0).all()
    products = (every[:, None] @ every).flatten(0, 1)
    nearest = (products[:, None] - every).flatten(2).norm(dim=2).amin(1)
    assert nearest.max() < 1e-12
    others = torch.linalg.qr(torch.randn(500, dim, dim, generator=torch.Generator().manual_seed(0)).double()).Q
    others[:, :, 0] *= torch.linalg.det(others).view(-1, 1)
    gaps = angle(others[:, None] @ every.transpose(1, 2)).amin(1)
    assert gaps.max() < {2: 5.01, 3: 44.5}[dim]


def test_exponential_is_the_flow_of_a_move():
    spin = generators("rigid", 2)[2:]
    map_ = exponential(torch.tensor([[0.3]], dtype=torch.float64), spin)[0]
    torch.testing.assert_close(map_, homogeneous(turn(2, math.degrees(0.3)), torch.zeros(2, dtype=torch.float64)))
