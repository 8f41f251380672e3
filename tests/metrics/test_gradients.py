"""Normalised gradient fields: numpy's gradient, and the spacing."""

import numpy as np
import pytest
import torch
from metric_images import UNIT, images

from torchdeform.core.grid import Grid
from torchdeform.metrics.gradients import GradientFields, ngf
from torchdeform.metrics.similarity import make_similarity


def test_the_derivative_of_gradient_fields_knows_the_spacing():
    grid = Grid((7, 9, 8), (0.7, 1.1, 2.5))
    fixed, warped = images(grid.shape)
    warped.requires_grad_(True)
    expected = ngf(fixed, warped, grid=grid, edge=0.5, intensity_range=UNIT)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    value, found = GradientFields(fixed, grid, edge=0.5).evaluate(warped.detach())
    torch.testing.assert_close(value, expected.detach())
    torch.testing.assert_close(found, slope * warped[0].numel())
    by_name = make_similarity("ngf", fixed, grid=grid).evaluate(warped.detach())[0]
    assert torch.equal(by_name, GradientFields(fixed, grid).evaluate(warped.detach())[0])


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 2.0), (1.0, 0.7, 3.0)])
def test_ngf_is_numpys_gradient(spacing):
    shape = (8, 9, 7)[: len(spacing)]
    fixed, warped = images(shape, items=1)
    f, w = (np.stack(np.gradient(x[0, 0].numpy(), *spacing, edge_order=2)) for x in (fixed, warped))
    square = (0.1 * np.sqrt((f**2).sum(0)).mean()) ** 2
    expected = np.mean((f * w).sum(0) ** 2 / (((f**2).sum(0) + square) * ((w**2).sum(0) + square)))
    assert ngf(fixed, warped, grid=Grid(shape, spacing), intensity_range=UNIT).item() == pytest.approx(
        expected, rel=1e-9
    )
