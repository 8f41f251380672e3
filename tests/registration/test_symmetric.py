"""Symmetric registration: swapping the images inverts the map; nothing else gets worse."""

import math
from dataclasses import replace

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import bend, blobs, disc

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample
from torchdeform.core.transform import Affine, Transform
from torchdeform.core.warp import compose, max_voxels, voxels, warp
from torchdeform.errors import InputError
from torchdeform.registration import symmetric as module
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register
from torchdeform.registration.optimise import optimise_levels
from torchdeform.registration.problem import moved
from torchdeform.registration.symmetric import common_axes, midspace_frame, root

SYMMETRIC = settings_of(steps=(30, 20, 10), step_length=0.5, length_scale=6.0, window=7, symmetric=True, align="none")


@pytest.mark.parametrize("shape", [(64, 80), (28, 26, 32)])
@pytest.mark.parametrize("similarity", ["lncc", "ssd", "mi", "ngf", "mind"])
def test_swapping_the_images_inverts_the_map(shape, similarity):
    grid, moving = Grid(shape), blobs(shape, 1)
    fixed = warp(moving, bend(grid, 3.0), grid)
    settings = changed(SYMMETRIC, similarity=similarity, start="identity")
    there, back = register(fixed, moving, settings), register(moving, fixed, settings)
    assert max_voxels(there.displacement, grid).item() > 1.5
    for apart in (there.inverse - back.displacement, compose(there.displacement, back.displacement, grid)):
        distance = voxels(apart, grid)
        assert distance.mean() < (0.1 if similarity == "mind" else 0.05)  # MIND bends small volumes most
        assert distance.flatten().quantile(0.9) < 0.15
    # Mirrored but for rounding: products of matrices do not give an item the same bits at each place of a batch.
    torch.testing.assert_close(there.levels[0].similarity[1], back.levels[0].similarity[1], rtol=0, atol=1e-5)
    torch.testing.assert_close(there.levels[-1].similarity[-1], back.levels[-1].similarity[-1], rtol=0, atol=1e-4)


def test_swapping_images_that_have_nothing_in_common_swaps_the_halves_of_the_map(monkeypatch):
    """Both halves, that is: where volumes change up to eight times, joining them on a grid is not exact to a voxel."""
    shape, halves = (64, 64), []
    monkeypatch.setattr(module, "optimise_levels", lambda *a: halves.append(optimise_levels(*a)) or halves[-1])
    there, back = (register(blobs(shape, i), blobs(shape, 3 - i), SYMMETRIC) for i in (1, 2))
    assert there.diagnosis.folds.item() == back.diagnosis.folds.item() == 0
    assert voxels(there.displacement, there.grid).max() > 10  # nothing in common
    torch.testing.assert_close(halves[0][0], halves[1][0].roll(1, 0), rtol=0, atol=1e-2)
    assert voxels(there.inverse - back.displacement, there.grid).median() < 0.1


def test_swapping_with_masks_and_landmarks_inverts_the_map():
    shape = (56, 48)
    grid, moving = Grid(shape), blobs(shape, 1)
    fixed = warp(moving, bend(grid, 3.0), grid)
    points, ends = (
        torch.tensor([[[20.0, 30.0, 25.0], [15.0, 20.0, 33.0]]]),
        torch.tensor([[[21.0, 28.0], [14.0, 22.0]]]),
    )
    ends = torch.cat([ends, torch.tensor([[[25.0], [35.0]]])], dim=2)
    masks = disc(shape, (26, 24), 20), disc(shape, (28, 26), 22)
    settings = changed(SYMMETRIC, points_weight=0.1)
    there = register(
        fixed,
        moving,
        settings,
        annotations=Annotations(fixed_mask=masks[0], moving_mask=masks[1], fixed_points=points, moving_points=ends),
    )
    back = register(
        moving,
        fixed,
        settings,
        annotations=Annotations(fixed_mask=masks[1], moving_mask=masks[0], fixed_points=ends, moving_points=points),
    )
    assert voxels(there.inverse - back.displacement, grid).mean() < 0.02
    assert voxels(there.inverse - back.displacement, grid).max() < 0.2


@pytest.mark.parametrize("shape", [(64, 80), (28, 26, 32)])
def test_a_known_map_is_found_as_well_as_without(shape):
    grid, moving = Grid(shape), blobs(shape, 1)
    truth = bend(grid, 3.0)
    fixed = warp(moving, truth, grid)
    inside = (..., *[slice(4, -4)] * grid.dim)
    errors = []
    for both in (False, True):
        u = register(fixed, moving, changed(SYMMETRIC, symmetric=both)).displacement
        errors.append(float((u - truth).square().sum(1).sqrt()[inside].mean()))
    assert errors[1] < 1.2 * errors[0] + 0.02


def tilt(degrees: float) -> tuple[tuple[float, ...], ...]:
    a = math.radians(degrees)
    return ((math.cos(a), -math.sin(a)), (math.sin(a), math.cos(a)))


def test_swapping_images_on_different_grids_inverts_the_map():
    wide = Image(blobs((130, 140), 1), Grid((130, 140), (0.8, 0.8)), (-10.0, -5.0))
    affine = Affine(torch.tensor([[1.05, 0.15], [-0.12, 0.97]]).double(), torch.tensor([7.0, -4.0]).double())
    bent = replace(wide, data=warp(wide.data, bend(wide.grid, 4.0), wide.grid))
    fixed = Image(torch.zeros(1, 1, 64, 72), Grid((64, 72)), (4.0, 14.0), tilt(-6))
    moving = Image(torch.zeros(1, 1, 66, 78), Grid((66, 78), (1.05, 0.9)), (16.0, 10.0), tilt(5))
    fixed = replace(fixed, data=resample(bent, fixed, outside=None).float())
    moving = replace(moving, data=resample(moved(wide, affine), moving, outside=None).float())
    there = register(fixed, moving, SYMMETRIC, affine=affine)
    back = register(moving, fixed, SYMMETRIC, affine=affine.inverse())
    x, y = torch.meshgrid(torch.linspace(25, 60, 9), torch.linspace(26, 60, 9), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten()]).unsqueeze(0).double()
    ends = Transform.from_displacement(there.displacement, fixed, affine=affine).points(points)
    returned = Transform.from_displacement(back.displacement, moving, affine=affine.inverse()).points(ends)
    place = moving.to_grid(ends)
    inside = ((place >= 0) & (place <= moving.grid.along(moving.grid.extent, place))).all(1)
    assert inside.double().mean() > 0.9
    apart = (returned - points).norm(dim=1)[inside]  # elsewhere the moving image says nothing
    assert (ends - affine(points)).norm(dim=1).mean() > 1
    assert apart.mean() < 0.05
    assert apart.quantile(0.9) < 0.1


def test_the_space_between_does_not_depend_on_the_order():
    first = Image(torch.zeros(1, 1, 20, 30), Grid((20, 30), (2.0, 1.0)), (3.0, -4.0), tilt(3))
    second = Image(torch.zeros(1, 1, 40, 25), Grid((40, 25), (0.8, 1.5)), (0.0, 2.0), tilt(-4))
    axes = common_axes(first, second)
    assert axes == common_axes(second, first) == ((1.0, 0.0), (0.0, 1.0))
    one, other = midspace_frame(first, second, axes), midspace_frame(second, first, axes)
    assert one.grid.shape == other.grid.shape
    assert one.grid.spacing == pytest.approx(other.grid.spacing, rel=1e-12)
    assert one.origin == pytest.approx(other.origin, abs=1e-9)
    same = midspace_frame(first, first, common_axes(first, first))
    assert same.grid.shape == first.grid.shape
    assert same.origin == pytest.approx(first.origin, abs=1e-6)
    far = replace(second, origin=(500.0, 0.0))
    with pytest.raises(InputError, match="too little in common"):
        midspace_frame(first, far, axes)


def test_the_root_of_an_affine_map_makes_it_when_it_is_applied_twice():
    generator = torch.Generator().manual_seed(0)
    for dim in (2, 3):
        matrix = torch.eye(dim).double() + 0.3 * torch.randn(dim, dim, generator=generator).double()
        affine = Affine(matrix, torch.randn(dim, generator=generator).double() * 50)
        half, back = root(affine), root(affine.inverse())
        torch.testing.assert_close(half.then(half).matrix, affine.matrix)
        torch.testing.assert_close(half.then(half).offset, affine.offset)
        torch.testing.assert_close(half.inverse().matrix, back.matrix)
        torch.testing.assert_close(half.inverse().offset, back.offset)
    for matrix in (torch.diag(torch.tensor([-1.0, 1.0])), -torch.eye(2)):
        with pytest.raises(InputError, match="mirroring or a turn by 180"):
            root(Affine(matrix.double(), torch.zeros(2).double()))
