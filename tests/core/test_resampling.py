"""Banded matrices against torch's own interpolation, padding and convolution, and against the dense matrix."""

from unittest import mock

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.autograd import gradcheck

import torchdeform.core.resampling as module
from torchdeform.core.resampling import banded, gathering, interpolation, multiply, restriction

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
    down = applied(gathering(fine, coarse, LIKE), force)
    torch.testing.assert_close((field.flatten() * down).sum(), (up * force).sum() * (coarse - 1) / (fine - 1))
    assert interpolation(coarse, coarse, LIKE) is None


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
