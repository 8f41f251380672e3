"""Sliding: maps of two sides are joined without folds, move alike across the border, and each finds its own motion."""

from itertools import pairwise

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import blobs, disc
from tissues import kabsch_residual, sliding_blocks
from torch import Tensor

from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.warp import sample
from torchdeform.errors import InputError
from torchdeform.metrics.base import Similarity
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register
from torchdeform.registration.sliding import Gliding, _OfAllSides, join

QUICK = settings_of(steps=(30, 24, 16), window=7)
GRIDS = [Grid((40, 48), (1.0, 0.6)), Grid((20, 22, 24), (1.0, 0.6, 0.8))]


def halves(grid: Grid, *borders: float) -> Tensor:
    """Sides ``(1, K, *S)`` between flat borders across the first axis, in nodes."""
    x = torch.arange(grid.shape[0]).view(1, 1, -1, *[1] * (grid.dim - 1)).expand(1, 1, *grid.shape)
    edges = [-1.0, *borders, float(grid.shape[0])]
    return torch.cat([((x > low) & (x <= high)).float() for low, high in pairwise(edges)], dim=1)


def along_border(grid: Grid, amounts: list[float], axis: int = 1) -> Tensor:
    """A displacement ``(1, K, D, *S)`` along an axis for each side, in voxels, fading to the faces."""
    x = grid.points()[:, axis] / grid.extent[axis]
    fade = (8 * x * (1 - x)).clamp(max=1)
    u = torch.zeros(1, len(amounts), grid.dim, *grid.shape)
    for k, amount in enumerate(amounts):
        u[:, k, axis] = amount * fade * grid.spacing[axis]
    return u


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("count", [2, 3])
def test_each_side_keeps_its_own_map_away_from_the_border(grid, count):
    borders = [grid.shape[0] * k / count + 0.5 for k in range(1, count)]
    sides, apart = halves(grid, *borders), along_border(grid, [1.0, -1.0, 0.5][:count])
    u = join(apart, sides, grid, 0.03)
    x = torch.arange(grid.shape[0])
    for k in range(count):
        inner = sides[0, k].flatten(1)[:, 0] > 0.5
        for border in borders:
            inner &= (x - border).abs() > 1.0
        torch.testing.assert_close(u[0][:, inner], apart[0, k][:, inner], rtol=0, atol=1e-5)
    assert diagnose(u, grid).folds.item() == 0


@pytest.mark.parametrize("grid", GRIDS)
def test_equal_maps_are_joined_to_themselves(grid):
    u = along_border(grid, [1.0])
    joined = join(u.repeat(2, 2, 1, *[1] * grid.dim), halves(grid, grid.shape[0] / 2), grid, 0.03)
    torch.testing.assert_close(joined, u[:, 0].repeat(2, 1, *[1] * grid.dim), rtol=0, atol=1e-6)


@pytest.mark.parametrize("jump", [2.0, 6.0])
def test_a_slanted_border_does_not_fold_where_its_sides_slide_far(jump):
    grid = Grid((72, 72))
    x = grid.points()
    along = torch.tensor([0.8, 0.6]).view(1, 2, 1, 1)
    sides = ((x[:, :1] * 0.6 - x[:, 1:] * 0.8) > -7).float()
    sides = torch.cat([sides, 1 - sides], dim=1)
    fade = (4 * x / 71 * (1 - x / 71)).clamp(max=1).prod(1, keepdim=True).sqrt()
    apart = torch.stack([jump / 2 * fade * along, -jump / 2 * fade * along], dim=1)
    u = join(apart, sides, grid, 0.03)
    assert diagnose(u, grid).folds.item() == 0
    distance = (x[:, 0] * 0.6 - x[:, 1] * 0.8 + 7)[0]
    for side, sign in ((0, 1), (1, -1)):
        there = sign * distance > 4
        torch.testing.assert_close(u[0][:, there], apart[0, side][:, there], rtol=0, atol=1e-5)


def noise(grid: Grid, count: int, items: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(count * items, grid.dim, *grid.shape, generator=generator)


@pytest.mark.parametrize("grid", GRIDS)
def test_at_the_border_velocities_agree_across_it_and_along_it_they_are_free(grid):
    border = grid.shape[0] // 2 - 0.5
    v = noise(grid, 2)
    w = Gliding(halves(grid, border), grid).velocity(v)
    for row in (int(border), int(border) + 1):
        torch.testing.assert_close(w[0, 0, row], w[1, 0, row], rtol=0, atol=1e-5)
    torch.testing.assert_close(w[:, 1:], v[:, 1:], rtol=0, atol=1e-6)
    far = (torch.arange(grid.shape[0]) - border).abs() > 5
    assert torch.equal(w[:, :, far], v[:, :, far])


def test_what_agrees_already_is_left_as_it_is():
    grid = GRIDS[0]
    v = noise(grid, 1, 2).repeat(2, 1, 1, 1)
    torch.testing.assert_close(Gliding(halves(grid, 20.0), grid).velocity(v), v)


@pytest.mark.parametrize("grid", GRIDS)
def test_beyond_its_side_a_map_goes_on_and_on_it_it_stays(grid):
    sides, u = halves(grid, grid.shape[0] / 2), noise(grid, 2)
    even = torch.ones_like(u)
    gliding = Gliding(sides, grid)
    v = gliding.extended(u)
    for k in range(2):
        own = sides[0, k] > 0.5
        assert torch.equal(v[k][:, own], u[k][:, own])
    assert not torch.equal(u, v)
    torch.testing.assert_close(gliding.extended(even), even)
    far = (torch.arange(grid.shape[0]) - grid.shape[0] / 2).abs() > 5
    assert torch.equal(v[:, :, far], u[:, :, far])


@pytest.mark.parametrize("shared", [True, False])
def test_maps_of_an_item_are_judged_together(shared):
    """Maps stand side after side, the items of a side one after another."""
    grid = Grid((12, 10))
    sides = halves(grid, 3.5, 7.5)
    sides = sides if shared else torch.cat([sides, sides.flip(2)])
    gliding = Gliding(sides, grid)
    flags = torch.tensor([True, True, True, False, True, True])
    assert gliding.all(flags).tolist() == [True, False] * 3
    assert gliding.together(torch.tensor([1.0, 2.0, 5.0, 0.0, 3.0, 4.0])).tolist() == [5.0, 4.0] * 3
    lowest = torch.full((6, 1, *grid.shape), -1.0)
    counted = gliding.counted(lowest)
    for side in range(3):
        for item in range(2):
            own = sides[item % len(sides), side] > 0.5
            assert torch.equal(counted[2 * side + item, 0], torch.where(own, -1.0, 1.0))


def error_at(u: Tensor, truth: Tensor) -> float:
    """The mean error of a displacement within 4 voxels of the border between two blocks, off the faces."""
    border = truth.shape[3] // 2
    error = (u - truth).square().sum(1).sqrt()[:, 10:-10, border - 4 : border + 4]
    return float(error.mean())


@pytest.mark.parametrize("shape", [(64, 72), (32, 30, 24)])
def test_blocks_that_slide_are_found_on_both_sides_of_their_border(shape):
    fixed, moving, upper, truth = sliding_blocks(shape, jump=4.0 if len(shape) == 2 else 3.0)
    given = Annotations(tissue=upper)
    free, result = (
        register(fixed, moving, QUICK),
        register(fixed, moving, changed(QUICK, sliding=(1,)), annotations=given),
    )
    assert error_at(result.displacement, truth) < 0.5 * error_at(free.displacement, truth)
    assert result.diagnosis.folds.item() == 0
    (side,) = result.tissue
    assert (side.label, side.kind, side.sliding) == (1, "free", True)
    assert result.levels[-1].similarity[-1].shape == (1,)


def test_items_of_a_batch_may_slide_along_borders_of_their_own():
    """Without an early stop: a change of 1e-6 of the images may move that by ten steps, and the map by 0.06."""
    settings = changed(QUICK, sliding=(1,), tolerance=0.0)
    one, two = sliding_blocks(), sliding_blocks(jump=-4.0)
    fixed, moving = torch.cat([one[0], two[0].flip(3)]), torch.cat([one[1], two[1].flip(3)])
    shifted = disc((64, 72), (32, 36), 16)
    result = register(fixed, moving, settings, annotations=Annotations(tissue=one[2]))
    assert not result.diagnosis.folds.any()
    own = torch.cat([one[2], shifted])
    several = register(fixed, moving, settings, annotations=Annotations(tissue=own))
    assert not several.diagnosis.folds.any()
    alone = register(one[0], one[1], settings, annotations=Annotations(tissue=one[2]))
    for found in (result, several):
        torch.testing.assert_close(found.displacement[:1], alone.displacement, rtol=0, atol=0.05)


def test_landmarks_pull_the_side_that_they_lie_on():
    """They lie on one half alone and ask for the same motion there that the images deny: the other half stays."""
    shape = (64, 72)
    moving, upper = blobs(shape, 4), sliding_blocks()[2]
    points = torch.stack(torch.meshgrid(torch.linspace(16, 48, 4), torch.linspace(46, 60, 3), indexing="ij"))
    points = points.flatten(1).unsqueeze(0)
    ends = points + torch.tensor([2.0, 0.0]).view(1, 2, 1)
    annotations = Annotations(tissue=upper, fixed_points=points, moving_points=ends)
    settings = changed(QUICK, sliding=(1,), points_weight=10.0)
    u = register(moving, moving, settings, annotations=annotations).displacement
    pulled, still = sample(u, points, Grid(shape)), u[:, :, 16:48, 12:33]
    assert (pulled - (ends - points)).square().sum(1).sqrt().mean() < 0.5
    assert still.square().sum(1).sqrt().mean() < 0.3


@pytest.mark.parametrize("side", ["fixed_mask", "moving_mask"])
def test_what_is_masked_out_has_no_influence(side):
    fixed, moving, upper, _ = sliding_blocks()
    mask = 1 - disc((64, 72), (32, 20), 8)
    annotations = Annotations(tissue=upper, **{side: mask})
    settings, found = changed(QUICK, sliding=(1,), steps=(10, 8)), []
    for garbage in (0.0, 50.0):
        images = {"fixed_mask": fixed, "moving_mask": moving}
        images[side] = torch.where(mask > 0, images[side], garbage)
        found.append(register(*images.values(), settings, annotations=annotations))
    assert torch.equal(found[0].displacement, found[1].displacement)
    assert found[0].diagnosis.folds.item() == 0


LABELS = {
    "everything": torch.ones(1, 1, 64, 72),
    "a disc that touches the border": disc((64, 72), (10, 36), 16),
    "two that touch each other": disc((64, 72), (32, 36), 20) + sliding_blocks()[2] * disc((64, 72), (32, 36), 20),
    "a single voxel": disc((64, 72), (32, 36), 0.5),
}


@pytest.mark.parametrize("name", LABELS)
def test_any_label_may_slide(name):
    fixed, moving, _, _ = sliding_blocks()
    labels = LABELS[name]
    names = tuple(int(n) for n in labels.unique() if n)
    settings = changed(QUICK, sliding=names, steps=(10, 8))
    result = register(fixed, moving, settings, annotations=Annotations(tissue=labels))
    assert result.diagnosis.folds.item() == 0
    assert result.displacement.isfinite().all()
    assert result.similarity_after > result.similarity_before


def test_a_start_is_gone_on_from():
    fixed, moving, upper, truth = sliding_blocks(jump=3.0)
    start, settings = 0.5 * truth.mean(3, keepdim=True).expand_as(truth), changed(QUICK, sliding=(1,), steps=(0, 0))
    start = start + 0.1 * torch.sin(torch.linspace(0, 3.1416, 64)).view(1, 1, -1, 1)
    result = register(fixed, fixed, settings, annotations=Annotations(tissue=upper), start=start)
    assert result.diagnosis.folds.item() == 0
    found = register(
        fixed, moving, changed(QUICK, sliding=(1,), steps=(10, 8)), annotations=Annotations(tissue=upper), start=start
    )
    assert found.similarity_after > found.similarity_before


def test_sliding_needs_labels():
    fixed, moving, _, _ = sliding_blocks()
    with pytest.raises(InputError, match=r"annotations\.tissue is not given"):
        register(fixed, moving, changed(QUICK, sliding=(1,)))


def test_all_sides_are_as_similar_as_they_are_together():
    class Brightness(Similarity):
        def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
            return warped.flatten(1).mean(1), torch.ones_like(warped)

    maps = (
        torch.tensor([1.0, 2.0, 3.0, 4.0]).view(4, 1, 1, 1).expand(4, 1, 5, 5)
    )  # two items on one side, and the other
    sizes = torch.tensor([[0.25, 0.5], [0.75, 0.5]])
    value, slope = _OfAllSides(Brightness(), sizes).evaluate(maps)
    assert value.tolist() == [0.25 * 1 + 0.75 * 3, 0.5 * 2 + 0.5 * 4] * 2
    assert torch.equal(slope, torch.ones_like(maps))


def test_bones_may_lie_in_what_slides():
    fixed, moving, upper, _ = sliding_blocks()
    labels = upper + disc((64, 72), (32, 55), 6)  # 2 in 1
    settings = changed(QUICK, sliding=(1,), tissues={2: "rigid"})
    result = register(fixed, moving, settings, annotations=Annotations(tissue=labels))
    assert kabsch_residual(result.displacement[0], labels[0, 0] == 2) < 0.05
    assert result.diagnosis.folds.item() == 0


def test_images_slide_in_their_own_unit():
    fixed, moving, upper, truth = sliding_blocks()
    grid = Grid((64, 72), (0.5, 0.5))
    images, tissue = [Image(part, grid) for part in (fixed, moving)], Image(upper, grid)
    settings = changed(QUICK, sliding=(1,), align="none")
    result = register(*images, settings, annotations=Annotations(tissue=tissue))
    assert error_at(2 * result.displacement, truth) < 0.5
    assert result.diagnosis.folds.item() == 0
