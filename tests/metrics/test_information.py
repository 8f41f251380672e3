"""Mutual information: a histogram filled voxel by voxel, independent images, intensities out of range."""

import numpy as np
import pytest
import torch
from metric_images import UNIT, images, soft_mask

from torchdeform.metrics.information import MutualInformation, mutual_information, normalised_mutual_information


def _histogram(fixed: np.ndarray, warped: np.ndarray, weight: np.ndarray, bins: int) -> np.ndarray:
    """The joint histogram, voxel by voxel, with scipy's B-splines around the middle of each bin."""
    interpolate = pytest.importorskip("scipy.interpolate")
    spline = {k: interpolate.BSpline.basis_element(np.arange(k + 2) - (k + 1) / 2, extrapolate=False) for k in (1, 3)}
    table = np.zeros((bins, bins))
    for f, w, m in zip(fixed.ravel(), warped.ravel(), weight.ravel(), strict=True):
        rows = np.nan_to_num(spline[3](w * (bins - 3) + 1 - np.arange(bins)))
        columns = np.nan_to_num(spline[1](f * (bins - 1) - np.arange(bins)))
        table += m * np.outer(rows, columns)
    return table / weight.sum()


def _entropy(p: np.ndarray) -> float:
    return -float(np.sum(p[p > 0] * np.log(p[p > 0])))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("bins", [8, 32])
def test_mutual_information_is_that_of_a_histogram_filled_voxel_by_voxel(bins, masked):
    shape = (9, 12)
    fixed, warped = images(shape, items=1, low=0.01)
    mask = soft_mask(shape, items=1) if masked else None
    weight = np.ones(shape) if mask is None else mask[0, 0].numpy()
    table = _histogram(fixed.numpy(), warped.numpy(), weight, bins)
    joint, alone = _entropy(table), _entropy(table.sum(0)) + _entropy(table.sum(1))
    arguments = {"mask": mask, "bins": bins, "intensity_range": UNIT}
    assert mutual_information(fixed, warped, **arguments).item() == pytest.approx(alone - joint, rel=1e-9)
    assert normalised_mutual_information(fixed, warped, **arguments).item() == pytest.approx(alone / joint, rel=1e-9)


def test_mutual_information_of_independent_images_vanishes_and_nmi_is_one():
    generator = torch.Generator().manual_seed(0)
    fixed, warped = torch.rand(2, 1, 1, 64, 64, 64, generator=generator)
    assert mutual_information(fixed, warped).item() == pytest.approx(0, abs=4e-3)
    assert normalised_mutual_information(fixed, warped).item() == pytest.approx(1, abs=2e-3)


def test_intensities_beyond_the_span_count_in_the_last_bins():
    fixed, warped = images((20, 22))
    beyond = warped.clone()
    beyond[..., 3, :], beyond[..., 7, :] = 1.0, 0.0
    cut = MutualInformation(fixed).evaluate(beyond)
    beyond[..., 3, :], beyond[..., 7, :] = 55.0, -9.0
    value, slope = MutualInformation(fixed).evaluate(beyond)
    assert torch.equal(value, cut[0])
    assert not slope[..., [3, 7], :].any()
