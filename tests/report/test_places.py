"""Where to look: slices that show something, and the place that is worst by what is known best."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.result import RegistrationResult
from torchdeform.report.landmarks import landmarks_of
from torchdeform.report.places import chosen_slices, span, worst_place
from torchdeform.report.planes import planes_of
from torchdeform.report.sampling import PairSampler


@pytest.mark.parametrize("depth", [2, 3, 15, 16, 200])
@pytest.mark.parametrize("most", [1, 2, 7, 31])
def test_slices_are_spread_evenly(make_image, depth, most):
    plane = planes_of(make_image((depth, 4, 5)))[0]
    numbers = chosen_slices(plane, (0, depth - 1), most, ())
    assert list(numbers) == sorted(set(numbers))
    assert len(numbers) == min(most, depth)
    assert 0 <= numbers[0] <= numbers[-1] < depth
    gaps = {b - a for a, b in pairwise(numbers)}
    assert not gaps or max(gaps) - min(gaps) <= 1
    assert set(chosen_slices(plane, (0, depth - 1), most, (1,))) == {*numbers, 1}


def test_empty_slices_are_left_out():
    picture = torch.zeros(1, 1, 20, 16, 12)
    picture[:, :, 5:9, 3:10, 2:7] = torch.rand(4, 7, 5) + 1
    assert [span(picture, axis) for axis in range(3)] == [(5, 8), (3, 9), (2, 6)]
    assert span(torch.ones(1, 1, 20, 16, 12), 0) == (0, 19)


def _pair(make_result, dim: int, spot: tuple[int, ...]) -> tuple[Image, Image, RegistrationResult]:
    """Two equal images, one of which has another grey value around a spot; the map is the identity."""
    shape = (40, 44, 48)[-dim:]
    data = torch.rand(1, 1, *shape, generator=torch.Generator().manual_seed(0))
    fixed, other = Image(data, Grid(shape)), data.clone()
    there = (..., *(slice(k - 3, k + 4) for k in spot))
    other[there] = 1 - other[there]
    moving = replace(fixed, data=other)
    still = torch.zeros(1, dim, *shape)
    return fixed, moving, replace(make_result(fixed, moving), displacement=still, inverse=still, warped=other)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_worst_place_is_found(make_result, dim):
    """By landmarks if there are any, else by labels, else by grey values outside of masks and of what is let go."""
    spot, label_spot, point = (30, 12, 20)[-dim:], (10, 30, 33)[-dim:], (5, 6, 40)[-dim:]
    fixed, moving, result = _pair(make_result, dim, spot)

    def place(absent=None, **given):
        annotations = Annotations(**given)
        sampler = PairSampler(fixed, moving, result, annotations)
        return worst_place(sampler, landmarks_of(fixed, result, annotations), absent, alike=True)

    assert place().node == pytest.approx(spot, abs=2)
    hidden = torch.zeros_like(fixed.data)
    hidden[(..., *(slice(k - 6, k + 7) for k in spot))] = 1.0
    assert place(hidden).node != pytest.approx(spot, abs=5)
    assert place(fixed_mask=replace(fixed, data=1 - hidden)).node != pytest.approx(spot, abs=5)
    labels = torch.ones_like(fixed.data)
    labels[(..., *(slice(k - 3, k + 4) for k in label_spot))] = 2.0
    both = {"fixed_labels": replace(fixed, data=labels), "moving_labels": replace(fixed, data=torch.ones_like(labels))}
    assert place(**both).node == pytest.approx(label_spot, abs=2)
    here = torch.rand(1, dim, 5, dtype=torch.float64) * 20 + 10
    here[0, :, 3] = torch.tensor(point[::-1], dtype=torch.float64)
    there = here + 0.1
    there[0, 0, 3] += 5.0
    found = place(fixed_points=here, moving_points=there, **both)
    assert found.node == pytest.approx(point)
    assert found.reason.startswith("landmark 4 is 5.1")


@pytest.mark.parametrize("dim", [2, 3])
def test_two_contrasts_are_compared_by_their_edges(make_image, make_result, dim):
    """Where bright and dark are swapped everywhere, the place is that of an edge which only one image has."""
    fixed, spot = make_image((40, 44, 48)[-dim:]), (12, 30, 33)[-dim:]
    other = 200 - fixed.data
    other[(..., *(slice(k - 4, k + 5) for k in spot))] = 300.0
    moving, still = replace(fixed, data=other), torch.zeros(1, dim, *fixed.grid.shape)
    result = replace(make_result(fixed, moving), displacement=still, inverse=still, warped=other)
    found = worst_place(PairSampler(fixed, moving, result, Annotations()), None, None, alike=False)
    assert found.node == pytest.approx(spot, abs=6)
    assert found.reason == "the edges differ most here"


def test_what_the_moving_image_does_not_show_is_not_the_worst_place(make_image, make_result):
    """Labels beyond it have no partner, which says nothing about the registration."""
    fixed = make_image((40, 60))
    label = torch.zeros_like(fixed.data)
    label[..., 25:40, 35:60] = 1.0
    label[..., 5:9, 5:9] = 1.0
    half = replace(fixed, data=fixed.data[..., :30], grid=Grid((40, 30)))
    still = torch.zeros(1, 2, 40, 60)
    result = replace(make_result(fixed, half), displacement=still, inverse=still)
    given = Annotations(fixed_labels=replace(fixed, data=label), moving_labels=replace(half, data=0 * half.data + 2))
    given.moving_labels.data[..., 9:, :] = 0.0  # type: ignore[union-attr]
    found = worst_place(PairSampler(fixed, half, result, given), None, None, alike=True)
    assert found.node[1] < 30
