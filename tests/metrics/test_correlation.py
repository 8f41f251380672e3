"""Correlations: numpy's own, and a loop over windows."""

import itertools

import numpy as np
import pytest
import torch
from metric_images import SHAPES, UNIT, images, smooth, soft_mask

from torchdeform.metrics.correlation import LNCC_FLOOR, LocalCrossCorrelation, lncc, ncc


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("stride", [2, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_lncc_with_a_stride_has_its_derivative_too(shape, stride, masked):
    fixed, warped = images(shape, channels=2)
    mask = soft_mask(shape) if masked else None
    expected = lncc(fixed, warped.requires_grad_(True), mask=mask, window=7, stride=stride, intensity_range=UNIT)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    value, found = LocalCrossCorrelation(fixed, 7, stride).evaluate(warped.detach(), mask)
    torch.testing.assert_close(value, expected.detach(), rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(found, slope * warped[0].numel(), rtol=1e-7, atol=1e-8)


def test_lncc_sees_that_its_mask_was_written_to():
    fixed, warped = images((11, 14))
    mask, other = soft_mask((11, 14)), soft_mask((11, 14), seed=6)
    similarity = LocalCrossCorrelation(fixed, 5)
    similarity.evaluate(warped, mask)
    mask.copy_(other)
    for found, expected in zip(similarity.evaluate(warped, mask), similarity.evaluate(warped, other), strict=True):
        assert torch.equal(found, expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_ncc_is_numpys_correlation(shape):
    fixed, warped = images(shape, channels=2)
    expected = [
        np.mean([np.corrcoef(f.ravel(), w.ravel())[0, 1] for f, w in zip(*pair, strict=True)])
        for pair in zip(fixed.numpy(), warped.numpy(), strict=True)
    ]
    torch.testing.assert_close(ncc(fixed, warped), torch.tensor(expected), rtol=0, atol=1e-6)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(7, 8), (5, 6, 4)])
def test_lncc_is_a_loop_over_windows(shape, masked):
    fixed, warped = images(shape, items=1)
    weight = soft_mask(shape, items=1) if masked else torch.ones(1, 1, *shape, dtype=torch.float64)
    f, w, m = (x[0, 0].numpy() for x in (fixed, warped, weight))
    total = 0.0
    for node in itertools.product(*map(range, shape)):
        cut = tuple(slice(max(0, i - 1), i + 2) for i in node)
        if m[node] > 0:
            c = np.cov(f[cut].ravel(), w[cut].ravel(), aweights=m[cut].ravel(), ddof=0)
            total += m[node] * c[0, 1] ** 2 / ((c[0, 0] + LNCC_FLOOR) * (c[1, 1] + LNCC_FLOOR))
    found = lncc(fixed, warped, mask=weight if masked else None, window=3, intensity_range=UNIT)
    assert found.item() == pytest.approx(total / m.sum(), rel=1e-9)


def test_lncc_of_tiny_and_of_huge_intensities():
    fixed, warped = smooth((32, 32)), smooth((32, 32)).square()
    expected = lncc(fixed, warped)
    for scale in (1e-30, 1e30):
        torch.testing.assert_close(lncc((scale * fixed).float(), warped.float()).double(), expected, rtol=1e-3, atol=0)


def test_a_window_that_the_mask_hardly_touches():
    fixed, warped = images((16, 16)).float()
    mask = torch.zeros(2, 1, 16, 16)
    mask[..., 3, 4], mask[..., 10:, 10:] = 1e-12, 1
    value, slope = LocalCrossCorrelation(fixed, 5).evaluate(warped, mask)
    assert value.isfinite().all()
    assert slope.isfinite().all()
    assert slope[..., 3, 4].abs().max() < 1e-6
