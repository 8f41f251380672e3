"""Banded matrices against torch's own interpolation, padding and convolution, and against the dense matrix."""

import math
from itertools import pairwise
from unittest import mock

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

import torchdeform.core.resampling as module
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import (
    MIN_NODES,
    Transfer,
    banded,
    box_sum,
    box_sum_by_rows,
    box_sum_transpose,
    centres,
    coarsened,
    hat_average,
    interpolation,
    interpolation_transpose,
    multiply,
    prolong,
    pyramid_grids,
    restrict,
    restriction,
    with_nodes,
)

LIKE = torch.zeros(0, dtype=torch.float64)


def applied(matrix, line):
    """Return the matrix times a line, as the last axis of a field."""
    return matrix.along(line.view(1, 1, 1, -1), 3).flatten()


@settings(max_examples=40, deadline=None)
@pytest.mark.parametrize("small", [0, 2**13])
@given(st.integers(1, 90), st.integers(1, 90), st.integers(0, 200), st.integers(0, 2), st.integers(0, 99))
def test_it_is_the_dense_matrix(small, count, size, entries, axis, seed):
    """Rows without entries and places with several among them; along every axis, also where a gradient is wanted."""
    generator = torch.manual_seed(seed)
    rows = torch.randint(0, count, (entries,), generator=generator)
    columns = torch.randint(0, size, (entries,), generator=generator)
    values = torch.rand(entries, generator=generator, dtype=torch.float64)
    dense = torch.zeros(count, size, dtype=torch.float64).index_put_((rows, columns), values, accumulate=True)
    field = torch.rand(2, 3, *(size if a == axis else 4 for a in range(3)), dtype=torch.float64)
    expected = torch.tensordot(dense, field, dims=([1], [axis + 2])).movedim(0, axis + 2)
    with mock.patch.object(module, "_SMALL", small):  # in blocks, and as one
        matrix = banded(rows, columns, values, (count, size), LIKE)
    torch.testing.assert_close(matrix.along(field, axis + 2), expected)
    torch.testing.assert_close(matrix.along(field.requires_grad_(), axis + 2).detach(), expected)


def test_it_is_differentiable():
    field = torch.rand(1, 2, 6, 7, dtype=torch.float64, requires_grad=True)
    factors = [interpolation(6, 9, LIKE), restriction(7, 4, 0.5, LIKE)]
    assert gradcheck(lambda x: multiply(x, factors), (field,))


@pytest.mark.parametrize(("coarse", "fine"), [(8, 15), (40, 97), (300, 601)])
def test_interpolation_and_its_transpose(coarse, fine):
    field = torch.rand(1, 1, coarse, dtype=torch.float64)
    up = applied(interpolation(coarse, fine, LIKE), field)
    torch.testing.assert_close(up, F.interpolate(field, fine, mode="linear", align_corners=True).flatten())
    force = torch.rand(fine, dtype=torch.float64)
    down = applied(interpolation_transpose(fine, coarse, LIKE), force)
    torch.testing.assert_close((field.flatten() * down).sum(), (up * force).sum() * (coarse - 1) / (fine - 1))
    assert interpolation(coarse, coarse, LIKE) is None


@pytest.mark.parametrize(("fine", "coarse"), [((15, 9), (8, 9)), ((12, 33, 20), (5, 11, 20)), ((40, 301), (7, 44))])
def test_a_hat_average_is_weighted_by_the_hat_function_of_each_node(fine, coarse):
    """Against dense matrices; the mean of what is constant is that constant."""
    field = expected = torch.rand(2, 3, *fine, dtype=torch.float64)
    for axis, (many, few) in enumerate(zip(fine, coarse, strict=True), start=2):
        place = torch.linspace(0, few - 1, many, dtype=torch.float64)
        hats = (1 - (place - torch.arange(few).unsqueeze(1)).abs()).clamp(min=0)
        expected = torch.einsum("ij,j...->i...", hats / hats.sum(1, keepdim=True), expected.movedim(axis, 0))
        expected = expected.movedim(0, axis)
    torch.testing.assert_close(hat_average(field, Grid(coarse)), expected)
    ones = torch.ones(1, 1, *fine)
    torch.testing.assert_close(hat_average(ones, Grid(coarse)), torch.ones(1, 1, *coarse))


@pytest.mark.parametrize(("fine", "coarse"), [(15, 8), (97, 30), (601, 151)])
def test_restriction_smooths_and_interpolates(fine, coarse):
    line, sigma = torch.rand(1, 1, fine, dtype=torch.float64), 0.5 * (fine - 1) / (coarse - 1)
    reach = int(torch.tensor(3 * sigma).ceil())
    kernel = torch.exp(-(torch.arange(-reach, reach + 1, dtype=torch.float64) ** 2) / (2 * sigma**2))
    smooth = F.conv1d(F.pad(line, (reach, reach), mode="replicate"), (kernel / kernel.sum()).view(1, 1, -1))
    expected = F.interpolate(smooth, coarse, mode="linear", align_corners=True).flatten()
    torch.testing.assert_close(applied(restriction(fine, coarse, 0.5, LIKE), line), expected)
    flat = applied(restriction(fine, coarse, 0.5, LIKE), torch.ones(fine, dtype=torch.float64))
    torch.testing.assert_close(flat, torch.ones(coarse, dtype=torch.float64))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(3, 14), min_size=2, max_size=3), st.sampled_from([3, 5, 7, 9]), st.integers(0, 99))
def test_box_sum_counts_the_window_and_is_self_adjoint(shape, window, seed):
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.rand(2, 1, 2, *shape, generator=generator, dtype=torch.float64)
    node = tuple(int(torch.randint(n, (), generator=generator)) for n in shape)
    cut = (..., *(slice(max(0, i - window // 2), i + window // 2 + 1) for i in node))
    torch.testing.assert_close(box_sum(x, window)[(..., *node)], x[cut].flatten(2).sum(2))
    torch.testing.assert_close((box_sum(x, window) * y).sum(), (x * box_sum(y, window)).sum())


def test_box_sum_is_the_same_on_long_axes():
    x = torch.rand(1, 1, 600, 20, dtype=torch.float64)
    torch.testing.assert_close(box_sum(x, 9)[:, :, 100:200], box_sum(x[:, :, 90:210].contiguous(), 9)[:, :, 10:110])


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.sampled_from([3, 4, 7, 10, 13, 530]), min_size=2, max_size=3).filter(
        lambda shape: shape.count(530) < 2
    ),
    st.sampled_from([3, 5, 9]),
    st.integers(1, 4),
    st.integers(0, 99),
)
def test_with_a_stride_windows_are_left_out_and_the_transpose_is_one(shape, window, stride, seed):
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(1, 2, *shape, generator=generator, dtype=torch.float64)
    few = box_sum(x, window, stride)
    torch.testing.assert_close(few, centres(box_sum(x, window), stride))
    y = torch.rand(few.shape, generator=generator, dtype=torch.float64)
    transpose = box_sum_transpose(y, window, stride, shape)
    torch.testing.assert_close((few * y).sum(), (x * transpose(slice(None))).sum())
    with torch.no_grad():
        torch.testing.assert_close(box_sum_by_rows(lambda rows: x[:, :, rows], shape, x, window, stride), few)


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


MODES = {2: "bilinear", 3: "trilinear"}


@pytest.fixture(params=[(41, 36), (30, 20, 25), (12, 600)], ids=["2d", "3d", "long"])
def transfer(request):
    fine = Grid(request.param, spacing=(1.0, 0.7, 1.3)[: len(request.param)])
    return Transfer(fine, coarsened(fine, 2.0), torch.zeros(1, dtype=torch.float64))


def test_up_is_linear_interpolation(transfer):
    field = torch.rand(2, 3, *transfer.coarse.shape, dtype=torch.float64)
    expected = F.interpolate(field, transfer.fine.shape, mode=MODES[transfer.fine.dim], align_corners=True)
    torch.testing.assert_close(transfer.up(field)(slice(None)), expected, rtol=0, atol=1e-12)


def test_gather_is_the_transpose_per_volume(transfer):
    field = torch.rand(2, 3, *transfer.coarse.shape, dtype=torch.float64)
    force = torch.rand(2, 3, *transfer.fine.shape, dtype=torch.float64)
    work = (transfer.up(field)(slice(None)) * force).sum() * transfer.fine.cell_volume
    torch.testing.assert_close(
        (field * transfer.gather(lambda rows: force[:, :, rows])).sum() * transfer.coarse.cell_volume, work
    )


def test_a_constant_force_stays_what_it_is_inside(transfer):
    inner = (..., *[slice(2, -2)] * transfer.fine.dim)
    ones = torch.ones(1, 1, *transfer.fine.shape, dtype=torch.float64)
    found = transfer.gather(lambda rows: ones[:, :, rows])[inner]
    torch.testing.assert_close(found.mean(), torch.ones((), dtype=torch.float64), rtol=0.02, atol=0)


def test_grids_have_few_nodes_of_one_spacing():
    coarse = with_nodes(Grid((300, 200, 20), (1.0, 1.0, 5.0)), 4096)
    assert math.prod(coarse.shape) <= 4096
    assert coarse.extent == pytest.approx((299, 199, 95))
    assert max(coarse.spacing) < 1.6 * min(coarse.spacing)
    assert with_nodes(Grid((10, 12)), 4096) == Grid((10, 12))
