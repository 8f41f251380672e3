"""Landmarks: they meet, they count beside the images, and contradictions do not make a map fold."""

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import bend, blobs
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import sample, warp
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register
from torchdeform.registration.landmarks import ForwardLandmarks, scatter_points

QUICK = settings_of(steps=(30, 20, 10), weight_div=1.0, length_scale=6.0, window=7, align="none")


def landmarks(truth: Tensor, grid: Grid, count: int = 8) -> tuple[Tensor, Tensor]:
    """Points well inside the grid, and where a displacement takes them."""
    share = torch.rand(1, grid.dim, count, generator=torch.Generator().manual_seed(5))
    points = (0.15 + 0.7 * share) * torch.tensor(grid.extent).view(1, -1, 1)
    return points, points + sample(truth, points, grid)


@pytest.mark.parametrize("shape", [(64, 80), (28, 32, 36)])
@pytest.mark.parametrize("symmetric", [False, True])
def test_landmarks_with_a_high_weight_meet_although_the_images_say_otherwise(shape, symmetric):
    grid, moving = Grid(shape), blobs(shape, 1)
    truth = bend(grid, 3.0)
    points, ends = landmarks(truth, grid)
    annotations = Annotations(fixed_points=points, moving_points=ends + 1.5)
    settings = settings_of(points_weight=30.0, symmetric=symmetric)
    result = register(warp(moving, truth, grid), moving, settings, annotations=annotations)
    assert result.evaluation is not None
    assert result.evaluation.before.distances.mean() > 1.5
    assert result.evaluation.after.distances.max() < 0.2
    assert result.diagnosis.folds.item() == 0


def test_landmarks_and_images_are_combined():
    shape = (64, 80)
    grid, moving = Grid(shape), blobs(shape, 1)
    truth = bend(grid, 3.0)
    points, ends = landmarks(truth, grid)
    fixed = warp(moving, truth, grid)
    climb = changed(QUICK, tolerance=0.0)  # all steps, so that the ends can be compared
    after, similar = [], []
    for weight in (0.0, 0.001, 1.0):
        annotations = Annotations(fixed_points=points, moving_points=ends + 1.5)
        result = register(fixed, moving, changed(climb, points_weight=weight), annotations=annotations)
        after.append(result.evaluation.after.distances.mean().item())
        similar.append(result.similarity_after.item())
    assert after[0] > after[1] > after[2]
    assert similar[0] > similar[1] > similar[2]
    plain = register(fixed, moving, climb)  # weight 0 only measures
    assert similar[0] == plain.similarity_after.item()


@pytest.mark.parametrize("shape", [(48, 56), (24, 28, 26)])
@pytest.mark.parametrize("symmetric", [False, True])
def test_landmarks_that_contradict_each_other_do_not_make_it_fold(shape, symmetric):
    grid, moving = Grid(shape), blobs(shape, 1)
    points, _ = landmarks(torch.zeros(1, grid.dim, *shape), grid)
    annotations = Annotations(fixed_points=points, moving_points=points.flip(2))
    settings = changed(QUICK, points_weight=100.0, symmetric=symmetric)
    result = register(moving.flip(2), moving, settings, annotations=annotations)
    assert result.diagnosis.folds.item() == 0
    nearer = result.evaluation.after.distances.mean() < result.evaluation.before.distances.mean()
    assert nearer or symmetric  # two maps bring the ends of a pair together in the middle, which says less


@pytest.mark.parametrize("shape", [(6, 7), (4, 5, 6)])
def test_spreading_is_the_transpose_of_interpolation(shape):
    grid = Grid(shape, tuple(0.5 + 0.3 * k for k in range(len(shape))))
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(2, grid.dim, 9, generator=generator) * 1.2 - 0.1  # some outside
    points = (points * torch.tensor(grid.extent).view(1, -1, 1)).double()
    field = torch.randn(2, 3, *shape, generator=generator).double()
    values = torch.randn(2, 3, 9, generator=generator).double()
    at_points = (sample(field, points, grid) * values).flatten(1).sum(1)
    at_nodes = (field * scatter_points(values, points, grid)).flatten(1).sum(1)
    torch.testing.assert_close(at_points, at_nodes)


@pytest.mark.parametrize("shape", [(12, 14), (8, 9, 7)])
def test_maps_that_share_the_pairs_of_an_item_feel_their_own_and_go_equally_far(shape):
    """Against a force for each part of the pairs alone, and the best multiple by trying many."""
    grid, generator = Grid(shape), torch.Generator().manual_seed(3)
    u, v = 0.2 * torch.randn(2, 4, grid.dim, *shape, generator=generator, dtype=torch.float64)
    extent = torch.tensor(grid.extent, dtype=torch.float64).view(1, -1, 1)
    ends = [torch.rand(2, grid.dim, 10, generator=generator, dtype=torch.float64) * extent for _ in "pq"]
    belongs = torch.zeros(4, 1, 10, dtype=torch.float64)
    belongs[:2, :, :4], belongs[2:, :, 4:] = 1, 1
    several = [end.repeat(2, 1, 1) for end in ends]
    force = ForwardLandmarks(*several, grid, belongs, 2).evaluate(u)
    parts = [slice(4), slice(4, None)]
    alone = [
        ForwardLandmarks(*(end[..., part] for end in ends), grid).evaluate(half)
        for part, half in zip(parts, u.chunk(2), strict=True)
    ]
    load = torch.cat([one.load(grid) * (share / 10) for one, share in zip(alone, (4, 6), strict=True)])
    torch.testing.assert_close(force.load(grid), load)
    distance = alone[0].distance * 0.4 + alone[1].distance * 0.6
    torch.testing.assert_close(force.distance, distance.repeat(2))
    multiple = force.line_search(v, grid)
    torch.testing.assert_close(multiple[:2], multiple[2:])
    moved = sample(v, several[0], grid)
    moved = torch.einsum("bijn,bjn->bin", force.slopes, moved)

    def left(t: Tensor) -> Tensor:
        away = (force.residuals - t.view(-1, 1, 1) * moved).square().flatten(1).sum(1)
        return away[:2] + away[2:]

    for nearby in (multiple + 1e-2, multiple - 1e-2):
        assert (left(multiple) < left(nearby)).all()


def test_a_map_without_pairs_of_its_own_is_not_pulled():
    grid, points = Grid((12, 14)), torch.full((2, 2, 3), 5.0)
    belongs = torch.tensor([1.0, 0.0]).view(2, 1, 1)
    load = ForwardLandmarks(points, points + 1, grid, belongs, 2).evaluate(torch.zeros(2, 2, 12, 14)).load(grid)
    assert load[0].any()
    assert not load[1].any()
