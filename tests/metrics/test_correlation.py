"""Correlations: numpy's own, and a loop over windows."""

import itertools
import math

import numpy as np
import pytest
import torch
from metric_images import SHAPES, UNIT, images, smooth, soft_mask

from torchdeform.metrics.correlation import LNCC_CONTRAST, LNCC_FLOOR, LocalCrossCorrelation, lncc, ncc


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
    total = count = 0.0
    for node in itertools.product(*map(range, shape)):
        cut = tuple(slice(max(0, i - 1), i + 2) for i in node)
        if m[node] > 0:
            c = np.cov(f[cut].ravel(), w[cut].ravel(), aweights=m[cut].ravel(), ddof=0)
            variance = [c[k, k] + LNCC_FLOOR for k in range(2)]
            t = m[node] * c[0, 0] ** 2 / (c[0, 0] ** 2 + LNCC_CONTRAST**4)
            total, count = total + t * (abs(c[0, 1]) + LNCC_FLOOR) ** 2 / math.prod(variance), count + t
    found = lncc(fixed, warped, mask=weight if masked else None, window=3, intensity_range=UNIT)
    assert found.item() == pytest.approx(total / count, rel=1e-9)


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


@pytest.mark.parametrize("shape", [(40, 44), (18, 20, 16)])
def test_lncc_of_an_image_with_itself_is_1_and_cannot_be_raised(shape):
    """Half of the picture is flat but for noise below a grey level: nothing is gained by enlarging it."""
    noise = torch.rand(1, 1, *shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    shown = (torch.arange(shape[0]) < shape[0] // 2).view(-1, *[1] * (len(shape) - 1))
    fixed = smooth(shape) * shown + 0.004 * noise
    value, slope = LocalCrossCorrelation(fixed, 5, 2).evaluate(fixed)
    assert value.item() == pytest.approx(1, abs=1e-12)
    assert slope.abs().max() < 1e-9


@pytest.mark.parametrize("shape", [(64, 64), (20, 20, 20)])
def test_lncc_of_white_noise_is_about_the_number_of_voxels_in_a_window(shape):
    first, second = torch.rand(2, 1, 1, *shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert lncc(first, second, window=9).item() == pytest.approx(1 / (9 ** len(shape) - 1), rel=0.4)


def test_lncc_looks_only_where_the_fixed_image_has_contrast():
    """Half of the fixed image is flat: what the other one shows there changes nothing."""
    shape = (40, 60)
    fixed, warped = (smooth(shape, seed=seed) for seed in (0, 3))
    fixed[..., 30:] = 0.3
    near = fixed.new_ones(1, 1, *shape)
    near[..., 35:] = 0  # windows of 5 that touch the other half
    whole, half = (lncc(fixed, warped, mask=mask, window=5, intensity_range=UNIT) for mask in (None, near))
    changed = torch.where(near > 0, warped, warped.flip(2))
    assert lncc(fixed, changed, window=5, intensity_range=UNIT).item() == pytest.approx(whole.item(), rel=1e-6)
    assert half.item() == pytest.approx(whole.item(), rel=1e-6)
