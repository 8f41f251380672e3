"""Where the search starts: principal axes, mirror images."""

import pytest
import torch
from affine_pairs import make_pair, make_true, turn

from torchdeform.registration.affine.align import align
from torchdeform.registration.affine.lie import angle
from torchdeform.registration.affine.objective import MaskedImage, NormalisedFrame
from torchdeform.registration.affine.search import image_moments, make_starts


@pytest.mark.parametrize("dim", [2, 3])
def test_a_mirror_image_is_told_and_not_taken(dim):
    mirror = torch.eye(dim, dtype=torch.float64)
    mirror[0, 0] = -1
    fixed, moving = make_pair(make_true(turn(dim, 20) @ mirror))
    found = align(fixed, moving)
    assert torch.linalg.det(found.affine.matrix) > 0
    assert any("mirror image" in sentence for sentence in found.warnings)


@pytest.mark.parametrize("dim", [2, 3])
def test_principal_axes_give_the_rotation_of_an_elongated_body(dim):
    parts = []
    for place, back in zip(make_pair(make_true(turn(dim, 50))), (turn(dim, 0), turn(dim, -50)), strict=True):
        own = make_true(back, 0.0, 0.0, 0.0)(place.to_world(place.grid.points(dtype=torch.float64)))
        lengths = place.grid.along((10.0, 6.0, 3.0)[:dim], own)
        parts.append(MaskedImage(place, torch.exp(-(own / lengths).square().sum(1, keepdim=True))))
    frame = NormalisedFrame.of(parts[0].image)
    starts = make_starts(image_moments(parts[0], frame), image_moments(parts[1], frame), turn=True)
    axes = [s.map[:dim, :dim] for s in starts if s.name.startswith("moments")]
    assert len(axes) == 2 ** (dim - 1)
    assert min(float(angle(a @ turn(dim, -50))) for a in axes) < 5
