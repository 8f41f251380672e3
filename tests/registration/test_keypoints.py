"""Keypoints on motion that is known, several times larger than what moves."""

import math
from dataclasses import replace

import pytest
import torch
from nested_settings import settings_of
from pictures import blobs, swell
from skimage.feature import corner_foerstner
from torch import Tensor

import torchdeform as td
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.warp import sample, voxels, warp
from torchdeform.errors import InputError
from torchdeform.registration.keypoints import (
    Keypoints,
    anchors_of,
    common_shift,
    corners,
    distinctiveness,
    keypoint_start,
    map_of,
    match_keypoints,
)
from torchdeform.registration.landmarks import ForwardLandmarks
from torchdeform.registration.objective import forward_objective
from torchdeform.registration.optimise import make_level
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import KeypointSettings

SETTINGS = KeypointSettings()
CASES = [
    pytest.param((128, 144), (1.0, 1.0), id="2D"),
    pytest.param((48, 56, 52), (1.0, 1.0, 1.0), id="3D"),
    pytest.param((30, 56, 52), (2.0, 1.2, 1.2), id="thick slices"),
]


def structures(grid: Grid, width: float, seed: int = 0) -> Tensor:
    """Return noise of wavelengths around twice the width in voxels: that far away are others that look much alike."""
    noise = torch.randn(1, 1, *grid.shape, generator=torch.Generator().manual_seed(seed))
    axes = [torch.fft.fftfreq(n) * min(grid.spacing) / h for n, h in zip(grid.shape, grid.spacing, strict=True)]
    frequency = torch.stack(torch.meshgrid(*axes, indexing="ij")).square().sum(0).sqrt()
    ring = torch.exp(-(((frequency * 2 * width - 1) / 0.3) ** 2))
    image = torch.fft.ifftn(torch.fft.fftn(noise, dim=grid.axes) * ring, dim=grid.axes).real
    return image / image.std()


def moved_pair(shape, spacing=None, largest: float = 10.0, width: float = 5.0, seed: int = 0):
    """Return fixed, moving, grid and the displacement: fixed(x) = moving(x + u(x))."""
    grid = Grid(shape, spacing or (1.0,) * len(shape))
    moving, u = structures(grid, width, seed), swell(grid, largest)
    return warp(moving, u, grid), moving, grid, u


def mean_error(u: Tensor, truth: Tensor, grid: Grid) -> float:
    return float((u - truth).square().sum(1).sqrt().mean() / min(grid.spacing))


def off(points: Keypoints, truth: Tensor, grid: Grid) -> Tensor:
    """How many voxels the matches are from where the truth takes their points, ``(n,)``."""
    wanted = points.fixed + sample(truth, points.fixed.unsqueeze(0), grid)[0]
    return (points.moving - wanted).norm(dim=0) / min(grid.spacing)


def test_distinctiveness_is_that_of_foerstner():
    image = structures(Grid((60, 72)), 5.0).double()
    found = distinctiveness(image, Grid((60, 72)), sigma=1.5)[0, 0]
    # There from Sobel's derivatives, which smooth a little, and in units of half of det / tr.
    wanted = torch.from_numpy(corner_foerstner(image[0, 0].numpy(), sigma=1.5)[0])
    inner = slice(4, -4)
    pair = torch.stack([found[inner, inner].flatten(), wanted[inner, inner].flatten()])
    assert torch.corrcoef(pair)[0, 1] > 0.97


@pytest.mark.parametrize("dim", [2, 3])
def test_corners_are_found_and_edges_are_not(dim):
    shape = (32, 36, 40)[:dim]
    box = torch.zeros(1, 1, *shape)
    box[(..., *[slice(10, 22)] * dim)] = 1.0
    strength = distinctiveness(box, Grid(shape))
    ends, middle = slice(7, 14), slice(15, 17)
    corner = strength[(..., *[ends] * dim)].max()
    for axis in range(dim):
        edge = strength[(..., *[middle if a == axis else ends for a in range(dim)])].max()
        assert edge < 0.02 * corner
    places = corners(box, Grid(shape), 1000)
    apart = torch.cdist(torch.cartesian_prod(*[torch.tensor([9.5, 21.5])] * dim), places.T)
    assert apart.amin(1).max() < 4  # each is found


def test_the_strongest_corners_are_taken_where_the_weight_allows():
    grid = Grid((64, 64))
    image = structures(grid, 5.0)
    weight = torch.zeros_like(image)
    weight[..., :32] = 1
    every, few = corners(image, grid, 1000, weight), corners(image, grid, 5, weight)
    assert every[1].max() < 32
    assert few.shape == (2, 5)
    at = sample(distinctiveness(image, grid), few.unsqueeze(0), grid)
    assert at.min() >= sample(distinctiveness(image, grid), every.unsqueeze(0), grid).flatten().sort().values[-5] - 1e-6


@pytest.mark.parametrize(("shape", "spacing"), CASES)
def test_points_and_map_are_where_the_truth_takes_them(shape, spacing):
    fixed, moving, grid, truth = moved_pair(shape, spacing)
    settings = SETTINGS if grid.dim == 2 else replace(SETTINGS, count=600, reach=(12.0, 4.0))
    u, (points,) = keypoint_start(fixed, moving, grid, settings=settings)
    assert points.count > 0.5 * points.looked_for > 30
    assert off(points, truth, grid).mean() < 1.2
    assert mean_error(u, truth, grid) < 0.35 * mean_error(torch.zeros_like(truth), truth, grid)
    found = diagnose(u, grid)
    assert found.folds.item() == 0


def test_a_motion_of_25_voxels_of_structures_8_wide_is_found_to_a_fraction_of_a_voxel():
    fixed, moving, grid, truth = moved_pair((192, 208), largest=25.0, width=8.0)
    plain, started = (td.register(fixed, moving, td.RegistrationSettings(start=s)) for s in ("identity", "keypoints"))
    assert mean_error(plain.displacement, truth, grid) > 5
    assert mean_error(started.displacement, truth, grid) < 0.2
    assert started.diagnosis.folds.item() == 0
    assert started.keypoints[0].count > 100


@pytest.mark.slow
def test_a_motion_of_25_voxels_is_found_in_a_volume():
    grid = Grid((96, 112, 96))
    moving = structures(grid, 8.0)
    inside = grid.points() / grid.along(grid.extent, grid.points())
    plateau = ((0.5 - (inside - 0.5).abs()) * 4).clamp(max=1).prod(1, keepdim=True)
    truth = grid.along([12.0, -18.0, 12.0], plateau) * (3 - 2 * plateau) * plateau**2
    fixed = warp(moving, truth, grid)
    plain, started = (td.register(fixed, moving, td.RegistrationSettings(start=s)) for s in ("identity", "keypoints"))
    assert mean_error(plain.displacement, truth, grid) > 4
    assert mean_error(started.displacement, truth, grid) < 1
    assert started.diagnosis.folds.item() == 0


def test_contrast_does_not_matter():
    fixed, moving, grid, truth = moved_pair((128, 144))
    u, (points,) = keypoint_start(4 - 3 * fixed, moving, grid)
    assert off(points, truth, grid).mean() < 1.2
    assert mean_error(u, truth, grid) < 1


def test_pairs_that_do_not_belong_together_are_left_out():
    grid, points = Grid((64, 64)), 63 * torch.rand(2, 200, generator=torch.Generator().manual_seed(1))
    wrong = torch.arange(200) % 20 == 0
    moved = (points + torch.tensor([[6.0], [-4.0]]) * torch.sin(math.pi * points / 63).prod(0)).clamp(0, 63)
    moved = torch.where(wrong, moved + 9, moved).clamp(0, 63)
    far = wrong & (moved < 63).all(0)
    u, kept = map_of(Keypoints(points, moved, 200), grid, SETTINGS)
    assert 185 < kept.count < 200
    place = points + sample(u, points.unsqueeze(0), grid)[0]
    assert (place - moved).norm(dim=0)[~wrong].mean() < 0.5
    assert (place - moved).norm(dim=0)[far].min() > 4
    assert diagnose(u, grid).folds.item() == 0


@pytest.mark.parametrize("shape", [(40, 44), (20, 24, 22)])
def test_images_without_texture_or_relation_begin_with_the_identity_and_say_so(shape):
    generator = torch.Generator().manual_seed(0)
    flat = torch.zeros(1, 1, *shape)
    flat[(..., *[slice(8, 14)] * len(shape))] = 1  # some corners, too few
    u, (points,) = keypoint_start(flat, flat, Grid(shape))
    assert not points.enough or voxels(u, Grid(shape)).max() < 0.1
    noise = [torch.randn(1, 1, *shape, generator=generator) for _ in range(2)]
    assert diagnose(keypoint_start(*noise, Grid(shape))[0], Grid(shape)).folds.item() == 0
    ramp = torch.linspace(0, 1, shape[-1]).expand(1, 1, *shape).contiguous()
    found = td.register(ramp, ramp**2, td.RegistrationSettings(start="keypoints"))
    assert not found.keypoints[0].enough
    assert "fewer than 8 pairs of points that agree, so" in " ".join(found.warnings)
    constant = torch.full_like(flat, 0.3)
    u, (points,) = keypoint_start(constant, constant, Grid(shape))
    assert points.count == 0
    assert not bool(u.any())


@pytest.mark.parametrize("shape", [(67, 81), (40, 44, 36)])
@pytest.mark.parametrize("value", [0.1, 0.7, -300.0])
def test_the_rounding_of_a_constant_image_has_no_corners(shape, value):
    image = torch.full((1, 1, *shape), value)
    _, (points,) = keypoint_start(image, 1.3 * image, Grid(shape))
    assert points.looked_for == 0


def test_a_warning_counts_the_items_of_a_batch():
    good, ramp = moved_pair((96, 96)), torch.linspace(0, 1, 96).expand(1, 1, 96, 96)
    fixed, moving = torch.cat([good[0], ramp]), torch.cat([good[1], ramp**2])
    found = td.register(fixed, moving, td.RegistrationSettings(start="keypoints"))
    assert "in 1 of 2 items" in found.warnings[0]
    assert [points.enough for points in found.keypoints] == [True, False]


def test_a_batch_equals_its_items_and_runs_repeat():
    pairs = [moved_pair((96, 112), largest=largest, seed=seed) for seed, largest in enumerate((0.0, 12.0))]
    fixed, moving = (torch.cat([pair[i] for pair in pairs]) for i in range(2))
    grid = pairs[0][2]
    together, points = keypoint_start(fixed, moving, grid)
    for k in range(2):
        alone, (single,) = keypoint_start(fixed[k : k + 1], moving[k : k + 1], grid)
        assert torch.equal(single.moving, points[k].moving)
        torch.testing.assert_close(together[k : k + 1], alone, rtol=0, atol=1e-3)
        assert torch.equal(alone, keypoint_start(fixed[k : k + 1], moving[k : k + 1], grid)[0])


def test_points_lie_in_the_masks_of_both_images():
    fixed, moving, grid, truth = moved_pair((128, 144))
    mask, moving_mask = torch.zeros_like(fixed), torch.zeros_like(fixed)
    mask[..., 40:, :] = 1
    moving_mask[..., :100] = 1
    misleading = torch.where(mask > 0, fixed, structures(grid, 5.0, seed=9))
    u, (points,) = keypoint_start(misleading, moving, grid, mask=mask, moving_mask=moving_mask)
    assert points.fixed[0].min() >= 39
    assert points.moving[1].max() <= 100
    assert off(points, truth, grid).mean() < 1.2
    inside = voxels(u - truth, grid)[..., 44:, :90]
    assert inside.mean() < 1


def test_a_shift_of_the_whole_is_found_and_a_short_one_is_not_far():
    grid = Grid((128, 144), (1.0, 1.5))
    image = structures(grid, 6.0)
    moved = image.roll((20, -14), dims=(2, 3))
    shift = common_shift(image, moved, grid, settings=SETTINGS)
    torch.testing.assert_close(shift, torch.tensor([20.0, -21.0]), rtol=0, atol=1.5)
    assert common_shift(image, image.roll(3, dims=2), grid, settings=SETTINGS) is None
    assert common_shift(torch.zeros_like(image), image, grid, settings=SETTINGS) is None


def test_images_far_apart_in_the_world_are_brought_together_without_alignment():
    grid = Grid((128, 144))
    texture = structures(Grid((180, 180)), 6.0)
    fixed = td.Image(texture[..., 20:148, 20:164].contiguous(), grid, (20.0, 20.0))
    moving = replace(fixed, origin=(50.0, 2.0))
    found = td.register(fixed, moving, td.RegistrationSettings(align="none", start="keypoints"))
    torch.testing.assert_close(found.affine.offset, torch.tensor([30.0, -18.0]).double(), rtol=0, atol=2.5)
    inner = (..., slice(8, -8), slice(8, -8))
    assert float((found.warped - fixed.data)[inner].abs().mean()) < 0.05
    assert found.similarity_before.item() < 0.5 < 0.9 < found.similarity_aligned.item()
    near = td.register(fixed, fixed, td.RegistrationSettings(align="none", start="keypoints"))
    assert near.affine is None
    assert near.similarity_aligned is None


def test_axes_that_are_held_stay_and_symmetric_mode_starts_as_well():
    fixed, moving, grid, truth = moved_pair((128, 144), largest=14.0, width=6.0)
    settings = td.RegistrationSettings(start="keypoints", symmetric=True)
    assert mean_error(td.register(fixed, moving, settings).displacement, truth, grid) < 0.5
    thin, other = (x.unsqueeze(2).repeat(1, 1, 5, 1, 1) for x in (fixed, moving))
    found = td.register(thin, other, replace(settings, symmetric=False))
    assert not bool(found.displacement[:, 0].any())
    assert mean_error(found.displacement[:, 1:, 2], truth, grid) < 0.5


def test_units_are_those_of_the_spacing_and_types_are_kept():
    fixed, moving, grid, _ = moved_pair((96, 112))
    wide = Grid(grid.shape, (3.0, 3.0))
    (points,), (scaled,) = (keypoint_start(fixed, moving, g)[1] for g in (grid, wide))
    torch.testing.assert_close(scaled.moving, 3 * points.moving)
    u, (points,) = keypoint_start(fixed.double(), moving.double(), grid)
    assert u.dtype == points.moving.dtype == torch.float64


IMAGE = torch.rand(2, 1, 16, 18)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fixed": IMAGE[:, :, :10]}, "keypoint_start: fixed must have shape"),
        ({"moving": IMAGE[:1]}, "keypoint_start: fixed and moving must agree in batch size"),
        ({"moving": torch.full_like(IMAGE, math.nan)}, "moving has values that are NaN or infinite"),
        ({"mask": torch.ones(2, 2, 16, 18)}, "keypoint_start: mask must have shape"),
        ({"moving_mask": torch.ones(3, 1, 16, 18)}, "keypoint_start: moving_mask must have shape"),
    ],
)
def test_bad_input_is_named(change, message):
    given = {"fixed": IMAGE, "moving": IMAGE} | change
    with pytest.raises(InputError, match=message):
        keypoint_start(given.pop("fixed"), given.pop("moving"), Grid((16, 18)), **given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": (2,)}, "keypoints.levels and keypoints.reach must have one entry each"),
        ({"levels": (1, 2)}, "from coarse to fine"),
        ({"reach": (20.0, 0.0)}, "keypoints.reach must be positive"),
        ({"coupling": ()}, "at least one price"),
        ({"count": 7}, "keypoints.count must be a whole number from 8 to 5000"),
        ({"neighbours": 0}, "keypoints.neighbours must be a whole number from 1 to 64"),
        ({"agreement": 0.0}, "keypoints.agreement must be positive"),
        ({"length_scale": -1.0}, "keypoints.length_scale must be positive"),
        ({"min_determinant": 1.0}, "between 0 and 1"),
    ],
)
def test_settings_out_of_range_are_named(change, message):
    with pytest.raises(InputError, match=message):
        KeypointSettings(**change)


def test_few_points_have_few_neighbours():
    fixed, moving, grid, truth = moved_pair((128, 144))
    points = match_keypoints(fixed, moving, grid, settings=replace(SETTINGS, count=9, neighbours=16))
    assert points.looked_for == 9
    assert off(points, truth, grid).shape == (points.count,)


def test_anchors_of_items_weigh_alike_whatever_their_number():
    like = torch.zeros(3, 1, 8, 8)
    few, many = (Keypoints(torch.rand(2, n), torch.rand(2, n), 100) for n in (10, 40))
    none = Keypoints(torch.rand(2, 3), torch.rand(2, 3), 100)
    fixed, moving, counted = anchors_of((few, none, many), like)
    assert fixed.shape == moving.shape == (3, 2, 40)
    landmarks = ForwardLandmarks(fixed, moving, Grid((8, 8)), counted)
    found = landmarks.evaluate(torch.zeros(3, 2, 8, 8)).distance
    alone = [(one.moving - one.fixed).square().sum(0).mean() for one in (few, many)]
    torch.testing.assert_close(found, torch.stack([alone[0], torch.zeros(()), alone[1]]))
    assert anchors_of((none, none), like) is None
    assert anchors_of((), like) is None


def test_points_hold_the_map_on_coarse_levels_and_let_go_on_the_finest():
    grid = Grid((64, 64))
    image = blobs((64, 64), 1)
    points = torch.rand(1, 2, 20) * 40 + 10
    problem = RegistrationProblem(grid, image, image, anchors=(points, points + 3.0, torch.ones(1, 1, 20)))
    settings = settings_of(measure="lncc")
    goals = [make_level(problem, settings, forward_objective, index, 3).objective for index in range(3)]
    assert goals[0].points_weight > goals[1].points_weight > goals[2].points_weight == 0
    assert goals[2].landmarks is None
    given = replace(problem, fixed_points=points, moving_points=points)  # landmarks of the user come before
    own = make_level(given, settings_of(measure="lncc", points_weight=2.0), forward_objective, 0, 3).objective
    assert own.points_weight == 2.0
