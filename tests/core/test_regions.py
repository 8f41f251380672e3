"""Boxes around masks, and distances to them, against scipy and the definition."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from torchdeform.core.grid import Grid
from torchdeform.core.regions import Crop, grown, nearest, require_labels
from torchdeform.errors import InputError


@st.composite
def masks(draw):
    dim = draw(st.sampled_from((2, 3)))
    shape = draw(st.tuples(*[st.integers(3, 12)] * dim))
    seed = torch.manual_seed(draw(st.integers(0, 99)))
    mask = torch.rand(1, 2, *shape, generator=seed) < draw(st.sampled_from((0.02, 0.2, 0.8)))
    mask[(..., *(n // 2 for n in shape))] = True
    return mask


@given(masks(), st.integers(1, 5))
@settings(deadline=None)
def test_the_nearest_nodes_are_as_far_as_scipy_says(mask, reach):
    squares, number = nearest(mask, reach)
    for channel in (0, 1):
        want = ndimage.distance_transform_edt(~mask[0, channel].numpy()) ** 2
        want[want > reach**2 + 1e-6] = math.inf
        np.testing.assert_allclose(squares[0, channel].numpy(), want, atol=1e-6)
        near = np.nonzero(want < math.inf)
        there = np.unravel_index(number[0, channel].numpy()[near], want.shape)
        assert mask[0, channel].numpy()[there].all()
        away = sum((a - b) ** 2 for a, b in zip(near, there, strict=True))
        np.testing.assert_array_equal(away, want[near].round())


@given(masks())
@settings(deadline=None)
def test_a_mask_grows_over_corners(mask):
    cube = np.ones((3,) * (mask.dim() - 2), dtype=bool)
    for channel in (0, 1):
        want = ndimage.binary_dilation(mask[0, channel].numpy(), cube, iterations=2)
        assert np.array_equal(grown(mask, 2)[0, channel].numpy(), want)


@given(masks(), st.integers(0, 4))
@settings(deadline=None)
def test_a_crop_holds_the_mask_and_its_margin(mask, margin):
    grid = Grid(tuple(mask.shape[2:]), (0.5, 2.0, 1.5)[: mask.dim() - 2])
    crop = Crop.around(mask[0, 0], grid, margin)
    assert crop.of(mask[:, :1]).sum() == mask[:, :1].sum()
    assert crop.grid.spacing == grid.spacing
    assert crop.of(mask).shape[2:] == crop.grid.shape
    for axis, (low, high, n) in enumerate(zip(crop.low, crop.high, grid.shape, strict=True)):
        found = mask[0, 0].movedim(axis, 0).flatten(1).any(1).nonzero()
        assert max(0, low) <= max(0, int(found.min()) - margin)
        assert high >= min(n, int(found.max()) + margin + 1)
        assert high - low >= 3
        assert crop.cut(axis, 0) == (low > 0)
        assert crop.cut(axis, 1) == (high < n)


def test_a_part_is_put_back_where_it_was():
    grid = Grid((8, 9))
    mask = torch.zeros(8, 9, dtype=torch.bool)
    mask[3:5, 0:2] = True
    crop = Crop.around(mask, grid, 1)
    assert (crop.low, crop.high) == ((2, 0), (6, 3))
    field = torch.zeros(1, 1, 8, 9)
    part = torch.ones(1, 1, 4, 3)
    assert torch.equal(crop.of(crop.replaced(field, part)), part)
    assert not field.any()
    assert float(crop.replaced(field, part).sum()) == 12
    assert crop.without_rim(part).shape == (1, 1, 2, 2)


@pytest.mark.parametrize("labels", [torch.ones(1, 1, 4, 5), torch.ones(1, 5, 4, dtype=torch.bool)])
def test_labels_that_are_none_are_refused(labels):
    with pytest.raises(InputError, match=r"x: inside must be bool of shape \(B, L, 5, 4\)"):
        require_labels(labels, Grid((5, 4)), "x: inside")
