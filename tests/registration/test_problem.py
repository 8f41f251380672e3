"""Annotations: masks hide, landmarks pull, channels add up, a start is gone on from; what does not fit is named."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nested_settings import changed, settings_of
from pictures import bend, blobs, disc
from tissues import BARS, turning_bars
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample
from torchdeform.core.transform import Affine
from torchdeform.core.warp import sample, warp
from torchdeform.errors import InputError
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register
from torchdeform.registration.objective import compared, forward_similarity
from torchdeform.registration.problem import RegistrationProblem, moved, placed_images, resample_pair
from torchdeform.registration.tissue import Tissue

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


QUICK = settings_of(steps=(30, 20, 10), weight_div=1.0, length_scale=6.0, window=7, align="none")


@pytest.mark.parametrize("similarity", ["lncc", "ssd", {"lncc": 1.0, "ncc": 1.0}])
@pytest.mark.parametrize("symmetric", [False, True])
def test_garbage_outside_the_masks_does_not_change_anything(similarity, symmetric):
    shape = (48, 40)
    settings = changed(QUICK, similarity=similarity, symmetric=symmetric)
    masks = disc(shape, (24, 18), 15), disc(shape, (22, 20), 16)
    annotations = Annotations(fixed_mask=masks[0], moving_mask=masks[1])
    images = blobs(shape, 1), blobs(shape, 2)
    garbage = torch.full(shape, torch.nan), torch.randn(shape) * 1e4
    spoilt = [torch.where(m > 0, i, g) for m, i, g in zip(masks, images, garbage, strict=True)]
    clean, dirty = (
        register(*images, settings, annotations=annotations),
        register(*spoilt, settings, annotations=annotations),
    )
    assert torch.equal(clean.displacement, dirty.displacement)
    assert torch.equal(clean.similarity_after, dirty.similarity_after)


@pytest.mark.parametrize("side", ["fixed_mask", "moving_mask"])
def test_a_lesion_that_is_masked_out_is_ignored(side):
    shape, centre = (64, 64), (30, 34)
    grid, moving = Grid(shape), blobs(shape, 1)
    truth = bend(grid, 2.0)
    fixed, lesion = warp(moving, truth, grid), disc(shape, centre, 9)
    texture = blobs(shape, 7) * 4
    if side == "fixed_mask":
        fixed = torch.where(lesion > 0, texture, fixed)
    else:
        moving = torch.where(lesion > 0, texture, moving)
    errors = []
    for annotations in (Annotations(), Annotations(**{side: 1 - lesion})):
        u = register(fixed, moving, QUICK, annotations=annotations).displacement
        errors.append((u - truth).square().sum(1).sqrt()[:, 3:-3, 3:-3].mean().item())
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < 0.4


def test_boolean_masks_and_masks_of_ones_mean_what_they_say():
    shape = (40, 40)
    images, mask = (blobs(shape, 1), blobs(shape, 2)), disc(shape, (20, 20), 14)
    as_float, as_bool = (register(*images, QUICK, annotations=Annotations(fixed_mask=m)) for m in (mask, mask > 0))
    assert torch.equal(as_float.displacement, as_bool.displacement)
    plain = register(*images, changed(QUICK, steps=(5,)))
    ones = register(*images, changed(QUICK, steps=(5,)), annotations=Annotations(fixed_mask=torch.ones(1, 1, *shape)))
    torch.testing.assert_close(plain.displacement, ones.displacement, rtol=0, atol=1e-3)


def test_every_channel_counts():
    """The halves of the truth that one channel cannot see, the other does."""
    shape = (64, 64)
    grid, truth = Grid(shape), bend(Grid(shape), 2.5)
    half = (grid.points()[:, :1] < 32).float()
    both = torch.cat([blobs(shape, 1) * half, 1000 * blobs(shape, 2) * (1 - half)], dim=1)
    fixed = warp(both, truth, grid)
    inside = (..., slice(4, -4), slice(4, -4))
    errors = []
    for channels in (slice(0, 1), slice(1, 2), slice(0, 2)):
        u = register(fixed[:, channels], both[:, channels], QUICK).displacement
        errors.append((u - truth).square().sum(1).sqrt()[inside].mean().item())
    assert errors[2] < 0.6 * min(errors[:2])


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_start_is_gone_on_from(symmetric):
    shape = (64, 64)
    grid = Grid(shape)
    truth = bend(grid, 4.0)
    waves = torch.sin(grid.points().sum(1, keepdim=True)) + blobs(shape, 1)  # period 4.4: local optima everywhere
    settings = changed(QUICK, steps=(0, 0, 10), symmetric=symmetric)
    given = register(warp(waves, truth, grid), waves, settings, start=truth)
    without = register(warp(waves, truth, grid), waves, settings)
    assert given.similarity_after > without.similarity_after + 0.1
    assert (given.displacement - truth).abs().max() < 1.0
    still = register(warp(waves, truth, grid), waves, changed(settings, steps=(0,)), start=truth)
    torch.testing.assert_close(still.displacement, truth, rtol=0, atol=0.05 if symmetric else 1e-6)
    back = register(waves, waves, changed(settings, steps=(0,)), start=truth)
    assert not back.displacement.any()  # no map is better than this start


def test_a_batch_with_guidance_equals_its_items():
    shape = (40, 48)
    grid = Grid(shape)
    moving = blobs(shape, 3, items=2).double()
    fixed = warp(moving, bend(grid, 2.0).double(), grid)
    fixed[1] = blobs(shape, 9)[0]
    masks = torch.cat([disc(shape, (20, 20), 15), disc(shape, (24, 30), 12)]).double()
    points = torch.tensor([[[12.0, 25.0], [15.0, 30.0]], [[20.0, 30.0], [22.0, 36.0]]]).double()
    settings = changed(QUICK, points_weight=0.1)
    whole = Annotations(fixed_mask=masks, fixed_points=points, moving_points=points + 1)
    for symmetric in (False, True):
        settings = changed(settings, symmetric=symmetric)
        together = register(fixed, moving, settings, annotations=whole)
        for item in range(2):
            part = slice(item, item + 1)
            own = Annotations(fixed_mask=masks[part], fixed_points=points[part], moving_points=points[part] + 1)
            alone = register(fixed[part], moving[part], settings, annotations=own)
            torch.testing.assert_close(together.displacement[part], alone.displacement, rtol=0, atol=2e-3)
            torch.testing.assert_close(
                together.evaluation.after.distances[part], alone.evaluation.after.distances, rtol=0, atol=2e-3
            )


def oblique_pair(truth_size: float = 3.0) -> tuple[Image, Image, Affine, Image, Tensor]:
    """Fixed and moving cut from one wide image on tilted grids; the affine map, the wide image, its displacement."""
    wide = Image(blobs((130, 140), 1), Grid((130, 140), (0.8, 0.8)), (-10.0, -5.0))
    truth = bend(wide.grid, truth_size / 0.8)
    affine = Affine(torch.tensor([[1.05, 0.15], [-0.12, 0.97]]).double(), torch.tensor([7.0, -4.0]).double())
    tilts = [((math.cos(a), -math.sin(a)), (math.sin(a), math.cos(a))) for a in (-0.1, 0.08)]
    frames = (
        Image(torch.zeros(1, 1, 64, 72), Grid((64, 72)), (4.0, 14.0), tilts[0], "fixed"),
        Image(torch.zeros(1, 1, 66, 78), Grid((66, 78), (1.05, 0.9)), (16.0, 10.0), tilts[1], "moving"),
    )
    bent = replace(wide, data=warp(wide.data, truth, wide.grid))
    fixed = replace(frames[0], data=resample(bent, frames[0], outside=None).float())
    moving = replace(frames[1], data=resample(moved(wide, affine), frames[1], outside=None).float())
    return fixed, moving, affine, wide, truth


def world_landmarks(wide: Image, truth: Tensor, affine: Affine) -> tuple[Tensor, Tensor]:
    x, y = torch.meshgrid(torch.linspace(25, 62, 5), torch.linspace(28, 60, 5), indexing="ij")
    points = torch.stack([x.flatten(), y.flatten()]).unsqueeze(0).double()
    place = wide.to_grid(points)
    return points, affine(wide.to_world(place + sample(truth.double(), place, wide.grid)))


@pytest.mark.parametrize("symmetric", [False, True])
def test_an_affine_map_comes_after_the_displacement(symmetric):
    fixed, moving, affine, wide, truth = oblique_pair()
    points, ends = world_landmarks(wide, truth, affine)
    annotations = Annotations(fixed_points=points, moving_points=ends)
    settings = changed(QUICK, symmetric=symmetric, outside=0.0)
    result = register(fixed, moving, settings, annotations=annotations, affine=affine)
    found = result.evaluation
    assert found.before.distances.mean() > found.aligned.distances.mean() > 1
    assert found.after.distances.mean() < 0.3
    assert result.diagnosis.folds.item() == 0
    nodes = fixed.grid.points(dtype=torch.float64) + result.displacement
    seen = sample(moving.data, moving.to_grid(affine(fixed.to_world(nodes))), moving.grid, outside=0.0)
    torch.testing.assert_close(result.warped, seen.float(), rtol=0, atol=1e-4)


def test_masks_of_images_may_lie_on_grids_of_their_own():
    fixed, moving, affine, wide, truth = oblique_pair()
    points, ends = world_landmarks(wide, truth, affine)
    coarse = Image(torch.zeros(1, 1, 50, 50), Grid((50, 50), (2.5, 2.5)), (-20.0, -20.0), name="mask")
    near = [
        ((coarse.to_world(coarse.grid.points()) - p.mean(2).view(1, 2, 1, 1)).square().sum(1, keepdim=True) < 27**2)
        for p in (points, ends)
    ]
    masks = [replace(coarse, data=255 * region.float()) for region in near]
    garbage = Image(1e4 * torch.randn(fixed.data.shape), fixed.grid, fixed.origin, fixed.direction)
    inside = resample(masks[0], fixed, mode="nearest") > 0
    spoilt = replace(fixed, data=torch.where(inside, fixed.data, garbage.data))
    annotations = Annotations(fixed_mask=masks[0], moving_mask=masks[1], fixed_points=points, moving_points=ends)
    result = register(spoilt, moving, QUICK, annotations=annotations, affine=affine)
    assert result.evaluation.after.distances.mean() < 0.5 * result.evaluation.aligned.distances.mean()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("symmetric", [False, True])
def test_everything_together_on_every_device(symmetric, device):
    fixed, moving, affine, wide, truth = oblique_pair()
    points, ends = world_landmarks(wide, truth, affine)
    ones = [replace(i, data=torch.ones_like(i.data)) for i in (fixed, moving)]
    annotations = Annotations(fixed_points=points, moving_points=ends, fixed_mask=ones[0], moving_mask=ones[1])
    settings = changed(QUICK, symmetric=symmetric, points_weight=0.1)
    start = torch.zeros(1, 2, *fixed.grid.shape).to(device)
    pair = fixed.to(device), moving.to(device)
    result = register(*pair, settings, annotations=annotations.to(device), affine=affine, start=start)
    assert result.warped.device.type == device
    assert result.evaluation.after.distances.mean() < 0.2
    assert result.diagnosis.folds.item() == 0


def image(data: Tensor, name: str = "image") -> Image:
    return Image(data, Grid(tuple(data.shape[2:])), name=name)


PAIR = torch.rand(1, 1, 16, 16), torch.rand(1, 1, 16, 16)


POINTS = torch.rand(1, 2, 3)


def test_starts_and_affine_maps_that_do_not_fit_are_named():
    fold = torch.zeros(1, 2, 16, 16)
    fold[:, 0, 8] = 3.0
    for start, message in (
        (fold, "start folds"),
        (torch.zeros(2, 2, 16, 16), "batch items"),
        (torch.zeros(1, 3, 16, 16), "start must have shape"),
        (torch.full((1, 2, 16, 16), torch.nan), "start folds or is not finite"),
    ):
        with pytest.raises(InputError, match=message):
            register(*PAIR, QUICK, start=start)
    with pytest.raises(InputError, match="must be Images"):
        register(*PAIR, QUICK, affine=Affine.identity(2))


@pytest.mark.parametrize("similarity", ["lncc", "ncc", "ssd", "mi"])
def test_where_the_moving_image_does_not_reach_nothing_is_compared(similarity):
    """Whatever the fixed image shows there, similarity and forces are the same; the map carries the end with it."""
    grid = Grid((40, 44))
    fixed, u = blobs(grid.shape) / 6, bend(grid, 3.0)
    frame, moving = Image(fixed, grid), Image(blobs(grid.shape, 1)[..., :30] / 6, Grid((40, 30)))
    problem = resample_pair(*placed_images(frame, moving, Annotations()), frame)
    assert problem.moving_mask is not None
    beyond = warp(problem.moving_mask, u, grid) == 0
    other = replace(problem, fixed=torch.where(beyond, blobs(grid.shape, 2) / 6, fixed))
    settings = settings_of(measure=similarity)
    known, found = (
        forward_similarity(each, compared(each, settings)[0], settings).evaluate(u)[1:] for each in (problem, other)
    )
    assert 0.2 < beyond.float().mean() < 0.5
    torch.testing.assert_close(found, known)
    assert known[1][beyond].abs().max() == 0


@given(power=st.floats(-6, 6))
@settings(max_examples=10, deadline=None)
@pytest.mark.parametrize("dim", [2, 3])
def test_an_image_is_seen_alike_through_maps_of_any_scale(dim, power):
    """Its file says another unit, and the map undoes it."""
    shape, scale = (12, 14, 16)[-dim:], 10**power
    fixed = Image(blobs(shape, 1), Grid(shape), (3.0,) * dim)
    moving = replace(fixed, grid=Grid(shape, (scale,) * dim), origin=(3.0 * scale,) * dim)
    affine = Affine(scale * torch.eye(dim, dtype=torch.float64), torch.zeros(dim, dtype=torch.float64))
    both = placed_images(fixed, moving, Annotations())
    problem = resample_pair(both[0], both[1].moved(affine.inverse()), fixed)
    torch.testing.assert_close(problem.moving, fixed.data, atol=1e-4, rtol=0)
    assert problem.mask is None or problem.mask.min() > 0.99


def sliced(image: Image, axis: int, step: int, first: int = 1) -> Image:
    """Every so many slices of an image, where they are."""
    data = image.data.index_select(2 + axis, torch.arange(first, image.grid.shape[axis], step))
    spacing = [h * step if k == axis else h for k, h in enumerate(image.grid.spacing)]
    place = torch.tensor([first * h if k == axis else 0.0 for k, h in enumerate(image.grid.spacing)]).double()
    origin = tuple(image.to_world(place.view(1, -1, 1)).flatten().tolist())
    return replace(image, data=data, grid=Grid(tuple(data.shape[2:]), tuple(spacing)), origin=origin)


def averaged(image: Image, axis: int, step: int) -> Image:
    """The means of so many slices of an image each, in their middle."""
    means = image.data.unfold(2 + axis, step, 1).mean(-1)
    middles = torch.nn.functional.pad(means.movedim(2 + axis, -1), (step // 2, 0)).movedim(-1, 2 + axis)
    return sliced(
        replace(image, data=middles, grid=Grid(tuple(middles.shape[2:]), image.grid.spacing)), axis, step, step // 2
    )


THICK = [pytest.param(sliced, id="sampled"), pytest.param(averaged, id="averaged")]


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("thick", THICK)
def test_slices_far_apart_show_the_other_image_as_they_show_their_own(axis, thick):
    """Seen through the slices of an image, the same image at full detail is what those slices give, wherever it is."""
    shape = (24, 26, 28)
    fixed = Image(blobs(shape, 2), Grid(shape, (1.5, 1.0, 0.8)), (4.0, -3.0, 9.0))
    slices = thick(fixed, axis, 5)
    problem = resample_pair(*placed_images(fixed, slices, Annotations()), fixed)
    inside = torch.ones_like(fixed.data) > 0 if problem.mask is None else problem.mask > 0.999  # None: covered
    assert problem.held == (axis,)
    torch.testing.assert_close(problem.fixed[inside], problem.moving[inside], atol=1e-4, rtol=0)
    back = resample_pair(*placed_images(slices, fixed, Annotations()), slices)
    torch.testing.assert_close(back.moving, slices.data, atol=1e-4, rtol=0)
    whole = resample_pair(*placed_images(fixed, thick(fixed, axis, 2), Annotations()), fixed)
    assert torch.equal(whole.fixed, fixed.data)
    assert whole.held == ()


@pytest.mark.parametrize("thick", THICK)
@pytest.mark.parametrize("which", ["fixed", "moving"])
def test_a_few_thick_slices_end_nearer_than_they_start(thick, which):
    shape = (40, 56, 60)
    u = bend(Grid(shape), 0.6)
    moving = Image(blobs(shape, 1) + 0.5 * torch.randn(1, 1, *shape, generator=torch.manual_seed(0)), Grid(shape))
    images = {"fixed": replace(moving, data=warp(moving.data, u, moving.grid)), "moving": moving}
    images[which] = thick(images[which], 0, 8, *([4] if thick is sliced else []))
    found = register(*images.values(), settings_of(align="none")).displacement
    truth = u[:, :, 4::8] if which == "fixed" else u
    error, start = ((truth - d).norm(dim=1)[..., 4:-4, 4:-4].mean() for d in (found, torch.zeros_like(found)))
    assert error < start


@pytest.mark.parametrize("nodes", [2, 5, 7])
@pytest.mark.parametrize("measure", ["lncc", "mind"])
def test_nothing_is_moved_across_a_few_slices(nodes, measure):
    shape = (nodes, 40, 44)
    moving = blobs((40, 44), 1).unsqueeze(2) + 0.3 * blobs(shape, 4)
    bent = bend(Grid(shape[1:]), 2.0)
    u = torch.cat([torch.zeros_like(bent[:, :1]), bent], dim=1).unsqueeze(2).expand(1, 3, *shape)
    fixed = warp(moving, u, Grid(shape))
    result = register(fixed, moving, changed(QUICK, similarity=measure, start="auto"))
    assert not result.displacement[:, 0].any()
    assert not result.diagnosis.folds.any()
    error = (result.displacement - u).norm(dim=1).mean()
    assert error < 0.6 * u.norm(dim=1).mean()


def test_a_few_slices_far_apart_do_not_bend_the_map():
    """Slices of another time, far apart: the map ends nearer to the known one than the files are."""
    shape = (30, 40, 44)
    grid = Grid(shape)
    fine = blobs(shape, 1) + 0.5 * torch.randn(1, 1, *shape, generator=torch.Generator().manual_seed(2))
    moving, u = Image(fine, grid), bend(grid, 1.5)
    fixed = replace(moving, data=warp(moving.data, u, grid))
    result = register(fixed, sliced(moving, 0, 5, 3), changed(QUICK, weight_div=0.5))
    seen = (slice(None), slice(None), slice(5, 27), slice(4, -4), slice(4, -4))
    errors = [(w - u)[seen].norm(dim=1).mean() for w in (torch.zeros_like(u), result.displacement)]
    assert errors[1] < errors[0]
    assert not result.displacement[:, 0].any()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32, torch.float64])
def test_tissue_may_have_any_type_of_number(dtype):
    fixed, moving, labels = turning_bars()
    settings = changed(QUICK, steps=(3,), tissues=BARS)
    results = [register(fixed, moving, settings, annotations=Annotations(tissue=labels.to(t))) for t in (dtype, None)]
    assert torch.equal(results[0].displacement, results[1].displacement)


def test_tissue_goes_along_with_the_problem():
    fixed, moving, labels = turning_bars()
    given = Annotations(tissue=labels)
    assert torch.equal(given.to("cpu").tissue, labels)
    tissue = Tissue.of(labels, settings_of(tissues=BARS), fixed)
    problem, coarse = RegistrationProblem(Grid((64, 64)), fixed, moving, tissue=tissue), Grid((32, 32), (63 / 31,) * 2)
    assert problem.on(problem.grid) is problem
    assert problem.on(coarse).tissue.shares.shape == (1, 2, 32, 32)
    assert problem.scaled(settings_of().decided()).tissue is tissue
