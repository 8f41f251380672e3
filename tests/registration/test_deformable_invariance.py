"""What a registration must not depend on, and what no settings may do to it."""

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import bend, blobs, disc
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import max_voxels, warp
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register

SHAPES = [(40, 52), (18, 24, 20)]
SETTINGS = settings_of(steps=(12, 8), window=7, start="identity", similarity="ssd")


def pair(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    moving = blobs(shape, 1)
    return warp(moving, bend(Grid(shape), 3.0), Grid(shape)), moving


def farthest(u: Tensor, other: Tensor) -> float:
    return max_voxels(u - other, Grid(tuple(u.shape[2:]))).max().item()


@pytest.mark.parametrize("shape", SHAPES)
def test_mirrored_and_turned_images_have_mirrored_and_turned_maps(shape):
    fixed, moving = pair(shape)
    u = register(fixed, moving, SETTINGS).displacement
    for axis in range(len(shape)):
        mirrored = register(fixed.flip(axis + 2), moving.flip(axis + 2), SETTINGS).displacement.flip(axis + 2)
        mirrored[:, axis] *= -1
        assert farthest(u, mirrored) < 0.01
    turned = register(*(x.transpose(2, 3).contiguous() for x in (fixed, moving)), SETTINGS).displacement
    assert farthest(u, turned.transpose(2, 3)[:, [1, 0, *range(2, len(shape))]]) < 0.01


@pytest.mark.parametrize("similarity", ["lncc", "ssd", "mind"])
@pytest.mark.parametrize("shape", SHAPES)
def test_units_and_types_of_intensities_do_not_matter(shape, similarity):
    settings, images = changed(SETTINGS, similarity=similarity), pair(shape)
    u = register(*images, settings).displacement
    for change in (lambda x: 1000 * x - 20000, lambda x: -1e-4 * x, Tensor.double):
        assert farthest(u, register(*map(change, images), settings).displacement.float()) < 0.05


@pytest.mark.parametrize("points_weight", [0.0, 0.02, 1.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_three_equal_channels_are_one(shape, points_weight):
    """Beside landmarks, too, which weigh against the similarity and not against the channels."""
    images, settings = pair(shape), changed(SETTINGS, points_weight=points_weight)
    ends = torch.tensor([[0.3, 0.6, 0.45]]) * torch.tensor(shape).unsqueeze(1)
    points = Annotations(fixed_points=ends[None], moving_points=ends[None] + torch.tensor([1.0, -1.5, 2.0]))
    grey = register(*images, settings, annotations=points).displacement
    colour = register(*(x.repeat(1, 3, *[1] * len(shape)) for x in images), settings, annotations=points).displacement
    assert farthest(grey, colour) < 0.01


@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_items_as_different_as_can_be_do_not_influence_each_other(shape, symmetric):
    """One moves a little, one nearly folds, one is noise, one an object on nothing; all have units of their own."""
    (fixed, moving), ball = pair(shape), disc(shape, tuple(n / 2 for n in shape), min(shape) / 3)
    noise = torch.rand(2, 1, *shape, generator=torch.Generator().manual_seed(0))
    fixed = torch.cat([fixed, 1000 * blobs(shape, 2), noise[:1], -fixed * ball])
    moving = torch.cat([moving, 1000 * blobs(shape, 3), noise[1:], -moving * ball])
    settings = changed(SETTINGS, symmetric=symmetric)
    together = register(fixed, moving, settings).displacement
    for k in range(4):
        alone = register(fixed[k : k + 1], moving[k : k + 1], settings).displacement
        assert farthest(together[k : k + 1], alone) < 0.02


@pytest.mark.parametrize("shape", SHAPES)
def test_what_masks_leave_out_may_be_anything(shape):
    mask = disc(shape, tuple(n / 2 for n in shape), min(shape) / 2.5)
    masks, found = Annotations(fixed_mask=mask, moving_mask=mask), []
    for values in ((torch.nan, torch.inf), (7.0, -300.0)):
        images = (torch.where(mask > 0, image, value) for image, value in zip(pair(shape), values, strict=True))
        found.append(register(*images, SETTINGS, annotations=masks).displacement)
    assert torch.equal(*found)


EXTREMES = [
    {"step_length": 5.0, "limit": 0.1, "evenness": 1e-6, "momentum": 0.95, "elasticity": 0.0},
    {"step_length": 5.0, "limit": 100.0, "evenness": 1e6, "tolerance": 0.0},
    {"limit": None, "evenness": None, "elasticity": 1.0},
    {"steps": (0, 0, 0)},
    {"steps": (6,), "map_spacing": 8.0},
    {"symmetric": True, "step_length": 5.0, "momentum": 0.95},
    {"start": "keypoints", "map_spacing": 1.0},
]


@pytest.mark.parametrize("changes", EXTREMES, ids=str)
@pytest.mark.parametrize("shape", [(36, 40), (4, 40), (5, 5), (14, 16, 18), (2, 14, 16), (5, 5, 5)])
def test_no_settings_fold_or_make_it_worse(shape, changes):
    """Noise, images that have nothing in common, and two voxels in the dark."""
    noise, one = torch.rand(2, 1, *shape, generator=torch.Generator().manual_seed(1)), torch.zeros(2, 1, *shape)
    for k in range(2):
        one[(k, 0, *((n - 1) // 2 + k for n in shape))] = 1
    fixed, moving = torch.cat([noise[:1], one[:1]]), torch.cat([noise[1:], one[1:]])
    result = register(fixed, moving, changed(SETTINGS, similarity="lncc", **changes))
    assert not result.diagnosis.folds.any()
    assert result.displacement.isfinite().all()
    assert (result.objective_after >= result.objective_before - 1e-5).all()
