"""Evaluation: overlap and surface distance against counting, landmarks against maps that are known."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pictures import bend
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine, Transform
from torchdeform.core.warp import sample, warp
from torchdeform.errors import InputError
from torchdeform.metrics.evaluation import (
    common_labels,
    dice,
    evaluate_images,
    evaluate_tensors,
    hausdorff,
    landmark_distances,
)
from torchdeform.registration.annotations import Annotations


def surface_by_counting(region: Tensor) -> list[tuple[int, ...]]:
    """Voxels of which a face neighbour is missing or beyond the edge."""
    inside = {tuple(v) for v in region.nonzero().tolist()}
    steps = [tuple(s * (a == k) for a in range(region.dim())) for k, s in product(range(region.dim()), (-1, 1))]
    return [v for v in inside if any(tuple(a + b for a, b in zip(v, s, strict=True)) not in inside for s in steps)]


def distance_by_counting(a: Tensor, b: Tensor, spacing: tuple[float, ...], percentile: float) -> float:
    first, second = (torch.tensor(surface_by_counting(r)).double() * torch.tensor(spacing) for r in (a, b))
    apart = torch.cdist(first, second)
    return max(float(d.quantile(percentile / 100)) for d in (apart.amin(1), apart.amin(0)))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([(9, 12), (5, 6, 7)]), st.sampled_from([50.0, 95.0, 100.0]))
def test_the_distance_of_surfaces_is_what_counting_finds(seed, shape, percentile):
    generator = torch.Generator().manual_seed(seed)
    fixed, warped = torch.randint(0, 3, (2, 2, 1, *shape), generator=generator)
    spacing = tuple(0.5 + k for k in range(len(shape)))
    found = hausdorff(fixed, warped, (1, 2), Grid(shape, spacing), percentile=percentile)
    for item, (column, label) in product(range(2), enumerate((1, 2))):
        regions = (fixed[item, 0] == label, warped[item, 0] == label)
        assert found[item, column].item() == pytest.approx(distance_by_counting(*regions, spacing, percentile))


def test_overlap_is_what_counting_finds():
    generator = torch.Generator().manual_seed(1)
    fixed, warped = torch.randint(0, 4, (2, 3, 1, 7, 8), generator=generator).float()
    found = dice(fixed, warped, (1, 2, 3, 9))
    for item, (column, label) in product(range(3), enumerate((1, 2, 3))):
        pairs = list(zip(fixed[item].flatten().tolist(), warped[item].flatten().tolist(), strict=True))
        both = sum(a == b == label for a, b in pairs)
        either = sum(a == label for a, _ in pairs) + sum(b == label for _, b in pairs)
        assert found[item, column].item() == pytest.approx(2 * both / either)
    assert found[:, 3].isnan().all()


def test_known_distances():
    grid = Grid((20, 20), (1.0, 2.0))
    box = torch.zeros(1, 1, 20, 20)
    box[..., 5:10, 5:10] = 1
    assert hausdorff(box, box, (1,), grid).item() == 0
    assert hausdorff(box, box.roll(3, 2), (1,), grid).item() == 3
    assert hausdorff(box, box.roll(3, 3), (1,), grid).item() == 6
    assert hausdorff(box, 0 * box, (1,), grid).item() == float("inf")
    assert dice(box, 0 * box, (1,)).item() == 0
    points = torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])
    assert landmark_distances(points, points + torch.tensor([3.0, 4.0]).view(1, 2, 1)).tolist() == [[5.0, 5.0]]


def test_labels_in_common():
    fixed, moving = torch.tensor([0.0, 1.0, 2.0, 1007.0]), torch.tensor([0, 2, 1007, 5])
    assert common_labels(fixed, moving) == (2, 1007)
    with pytest.raises(InputError, match="moving_labels must hold whole numbers"):
        common_labels(fixed, moving + 0.5)
    with pytest.raises(InputError, match="second must hold whole numbers"):
        common_labels(fixed, fixed + torch.inf, names=("first", "second"))
    with pytest.raises(InputError, match="no label in common"):
        common_labels(fixed, torch.tensor([0, 7]))
    with pytest.raises(InputError, match="one shape"):
        dice(torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 5), (1,))


def stripes(shape: tuple[int, ...]) -> Tensor:
    return (Grid(shape).points()[:, :1] // 6 + 1).round()


def test_the_right_map_fits_labels_and_landmarks():
    shape = (36, 40)
    grid = Grid(shape)
    truth = bend(grid, 3.0)
    moving = stripes(shape)
    points = torch.rand(1, 2, 6, generator=torch.Generator().manual_seed(0)) * 30 + 2
    annotations = Annotations(
        fixed_labels=warp(moving, truth, grid, mode="nearest"),
        moving_labels=moving,
        fixed_points=points,
        moving_points=points + sample(truth, points, grid),
    )
    found = evaluate_tensors(truth, grid, labels=annotations.labels, points=annotations.points)
    assert found is not None
    assert found.aligned is None
    assert found.before.labels == found.after.labels == (1, 2, 3, 4, 5, 6)
    assert found.label_interpolation == "label"
    assert (found.after.dice > 0.97).all()  # of regions six voxels wide, cut out by the nearest label
    assert (found.after.hausdorff == 0).all()
    assert found.after.distances.max() < 1e-5
    assert found.before.dice.mean() < 0.9
    assert found.before.hausdorff.mean() > 1
    assert found.before.distances.mean() > 1
    assert evaluate_tensors(truth, grid) is None


def test_images_are_measured_in_their_place_before_and_after_each_map():
    turned = ((0.0, -1.0), (1.0, 0.0))
    moving = Image(stripes((36, 40)), Grid((36, 40), (1.5, 1.0)), (5.0, 1.0), turned, "moving")
    fixed = Image(torch.zeros(1, 1, 40, 44), Grid((40, 44)), (-40.0, -3.0), name="fixed")
    affine = Affine(torch.tensor([[0.98, 0.1], [-0.05, 1.02]]).double(), torch.tensor([2.0, 3.0]).double())
    u = bend(fixed.grid, 2.0)
    nodes = fixed.to_world(fixed.grid.points(dtype=torch.float64) + u)
    labels = sample(moving.data, moving.to_grid(affine(nodes)), moving.grid, mode="nearest", outside=0.0)
    points = fixed.to_world(torch.rand(1, 2, 5, generator=torch.Generator().manual_seed(0)).double() * 30)
    place = fixed.to_grid(points)
    ends = affine(fixed.to_world(place + sample(u.double(), place, fixed.grid)))
    annotations = Annotations(
        fixed_labels=Image(labels, fixed.grid, fixed.origin),
        moving_labels=moving,
        fixed_points=points,
        moving_points=ends,
    )
    found = evaluate_images(fixed, affine, u, labels=annotations.labels, points=annotations.points)
    assert found is not None
    assert found.aligned is not None
    assert (found.after.dice > 0.97).all()
    assert found.after.distances.max() < 1e-9
    torch.testing.assert_close(found.before.distances, (points - ends).norm(dim=1))
    torch.testing.assert_close(found.aligned.distances, (affine(points) - ends).norm(dim=1))
    assert found.before.dice.mean() < found.aligned.dice.mean() < 1
    torch.testing.assert_close(Transform.from_displacement(u.double(), fixed, affine=affine).points(points), ends)


def test_labels_of_a_batch_are_carried_item_by_item():
    grid = Grid((30, 34))
    u = torch.cat([bend(grid, 3.0), bend(grid, -1.5)])
    fixed, moving = torch.cat([stripes(grid.shape), stripes(grid.shape).flip(2)]), stripes(grid.shape)
    together = evaluate_tensors(u, grid, labels=(fixed, moving))
    assert together is not None
    for item in range(2):
        alone = evaluate_tensors(u[item : item + 1], grid, labels=(fixed[item : item + 1], moving))
        assert alone is not None
        assert torch.equal(together.after.dice[item], alone.after.dice[0])


def test_the_labels_measured_are_those_that_a_transform_carries():
    grid = Grid((30, 34), (1.5, 1.0))
    place = Image(torch.zeros(1, 1, 30, 34), grid, (5.0, 1.0))
    fixed, moving = replace(place, data=stripes(grid.shape)), replace(place, data=stripes(grid.shape).flip(3))
    affine, u = Affine(torch.eye(2).double() * 1.02, torch.tensor([0.3, -0.4]).double()), bend(grid, 2.0)
    found = evaluate_images(place, affine, u, labels=(fixed, moving))
    assert found is not None
    carried = Transform.from_displacement(u, place, affine=affine).labels(moving, place).data
    assert torch.equal(found.after.dice, dice(fixed.data, carried, found.after.labels))
