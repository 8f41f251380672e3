"""What a report shows: slices and derivatives that are what the functions of the library give."""

import math
from dataclasses import replace

import pytest
import torch

from torchdeform.core.derivatives import curl, divergence, jacobian_determinant
from torchdeform.core.diagnostics import inverse_error
from torchdeform.core.grid import Grid
from torchdeform.core.image import resample
from torchdeform.core.transform import Affine
from torchdeform.registration.problem import moved
from torchdeform.report.planes import planes_of
from torchdeform.report.report_data import derivative_fields, evenly_spaced, grey, make_report_data, quantiles, to_unit


@pytest.mark.parametrize("depth", [2, 3, 15, 16, 200])
@pytest.mark.parametrize("count", [1, 2, 7, 15])
def test_slices_are_spread_around_the_middle(make_image, depth, count):
    plane = planes_of(make_image((depth, 4, 5)))[0]
    numbers = evenly_spaced(plane, count)
    assert list(numbers) == sorted(set(numbers))
    assert plane.middle in numbers
    assert len(numbers) <= count
    assert 0 <= numbers[0] <= numbers[-1] < depth


@pytest.mark.parametrize("shape", [(3, 5), (17, 12), (8, 9, 10), (9, 3, 4), (10, 4, 5), (25, 4, 3)])
def test_rates_are_those_of_the_stencils(shape):
    grid = Grid(shape, (0.7, 1.3, 2.0)[: len(shape)])
    u = torch.randn(1, grid.dim, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    found = derivative_fields(u, grid)
    turn = curl(u, grid)
    torch.testing.assert_close(found["determinant"], jacobian_determinant(u, grid))
    torch.testing.assert_close(found["divergence"], divergence(u, grid))
    torch.testing.assert_close(found["rotation"], turn if grid.dim == 2 else turn.square().sum(1, keepdim=True).sqrt())


@pytest.mark.parametrize("dim", [2, 3])
def test_a_scene_shows_what_is_there(make_image, make_result, dim):
    """Its slices are those of the images, resampled as the library does it, and of the fields."""
    fixed, moving = make_image((12, 14, 17)[-dim:], tilted=True), make_image((13, 15, 16)[-dim:], (1.1,) * dim)
    shift = Affine(torch.eye(dim, dtype=torch.float64), torch.full((dim,), 1.5, dtype=torch.float64))
    result = replace(make_result(fixed, moving), affine=shift)
    report_data = make_report_data(fixed, moving, result, slices=3)
    fields = {
        "fixed": to_unit(fixed.data, fixed.data),
        "original": to_unit(resample(moving, fixed), moving.data),
        "moving": to_unit(resample(moved(moving, shift.inverse()), fixed), moving.data),
        "warped": to_unit(result.warped, moving.data),
        "u": result.displacement,
        "divergence": divergence(result.displacement, fixed.grid),
        "log_det": jacobian_determinant(result.displacement, fixed.grid).log(),
    }
    fields["after"] = (fields["warped"] - fields["fixed"]).abs()
    fields["before"] = (fields["moving"] - fields["fixed"]).abs()
    assert len(report_data.slices) == {2: 1, 3: 3}[dim]
    for cuts in report_data.slices:
        for name, field in fields.items():
            torch.testing.assert_close(cuts.fields[name], cuts.plane.cut(field, cuts.numbers), atol=2e-5, rtol=1e-4)
        _, largest = inverse_error(result.displacement, result.inverse, fixed.grid)
        assert cuts.fields["inverse_error"].max() <= largest + 1e-6
    assert report_data.volumes.sum() <= math.prod(fixed.grid.shape)
    assert report_data.limits["before"] == report_data.limits["after"]


def test_a_scene_survives_odd_images(make_image, make_result):
    """Two channels that are no colours, pixels that are not finite, an image that is constant."""
    fixed = make_image((12, 14), channels=2)
    data = fixed.data.clone()
    data[..., 0, :] = math.nan
    for image in (replace(fixed, data=data), replace(fixed, data=torch.ones_like(data))):
        cuts = make_report_data(image, image, make_result(fixed, fixed)).slices[0]
        assert cuts.fields["fixed"].shape[1] == 1
        assert cuts.fields["fixed"].isfinite().all()
    assert grey(fixed).shape[1] == 1
    assert quantiles(torch.tensor([math.nan]), 1.0, 99.0) == [0.0, 0.0]
