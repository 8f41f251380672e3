"""Levels keep the box, thin the finest axes first, and hand over images and displacements without a shift."""

from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import MIN_NODES, prolong, pyramid_grids, restrict


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(8, 90), st.floats(0.2, 5)), min_size=2, max_size=3), st.integers(1, 6))
def test_every_level_spans_the_same_box(axes, levels):
    grid = Grid(tuple(n for n, _ in axes), tuple(h for _, h in axes))
    grids = pyramid_grids(grid, levels)
    assert grids[-1] == grid
    assert len(grids) <= levels
    for coarse, fine in pairwise(grids):
        assert coarse.shape != fine.shape
        assert all(MIN_NODES <= a <= b for a, b in zip(coarse.shape, fine.shape, strict=True))
        assert coarse.extent == pytest.approx(grid.extent)


def test_thick_slices_are_thinned_last():
    grids = pyramid_grids(Grid((20, 101, 101), (4.0, 1.0, 1.0)), 3)
    assert [g.shape for g in grids] == [(20, 26, 26), (20, 51, 51), (20, 101, 101)]


@pytest.mark.parametrize("shape", [(33, 40), (17, 20, 24)])
def test_linear_images_and_maps_pass_through_unchanged_inside(shape):
    grid = Grid(shape, (1.0, 1.5, 0.7)[: len(shape)])
    coarse = pyramid_grids(grid, 2)[0]
    x = grid.points(dtype=torch.float64)
    image = sum((k + 1) * x[:, k : k + 1] for k in range(grid.dim))
    there = restrict(image, grid, coarse)
    y = coarse.points(dtype=torch.float64)
    expected = sum((k + 1) * y[:, k : k + 1] for k in range(grid.dim))
    inside = (..., *[slice(3, -3)] * grid.dim)
    torch.testing.assert_close(there[inside], expected[inside])
    torch.testing.assert_close(prolong(0.1 * y, grid), 0.1 * x)


def test_restriction_removes_what_would_alias():
    grid = Grid((65, 65))
    checkers = torch.ones(1, 1, 65, 65)
    checkers[..., ::2, ::2], checkers[..., 1::2, 1::2] = -1.0, -1.0
    assert restrict(checkers, grid, pyramid_grids(grid, 2)[0])[..., 2:-2, 2:-2].abs().max() < 0.1
