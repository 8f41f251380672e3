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
from torchdeform.report.report_data import derivative_fields, make_report_data
from torchdeform.report.sampling import to_unit


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
    """Its slices are those of the images, as the library resamples them, and of the fields; NaN beyond the images."""
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
    ones, seen = replace(moving, data=torch.ones_like(moving.data)), moved(moving, shift.inverse())
    inside = {
        "original": resample(ones, fixed),
        "before": resample(replace(seen, data=ones.data), fixed),
        "after": resample(replace(seen, data=ones.data), fixed, result.displacement),
    }
    inside["moving"] = inside["before"]
    assert len(report_data.slices) == {2: 1, 3: 3}[dim]
    for cuts in report_data.slices:
        for name, field in fields.items():
            there = cuts.plane.cut(inside.get(name, torch.ones(())).expand_as(field), cuts.numbers) > 0.5
            expected = cuts.plane.cut(field, cuts.numbers)
            torch.testing.assert_close(cuts.fields[name][there], expected[there], atol=5e-5, rtol=1e-4)
            if name in ("before", "after"):
                assert torch.equal(cuts.fields[name].isnan(), ~there)
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


def test_every_slice_that_shows_something_is_there(make_image, make_result):
    """All of a small volume; of a large one many; of a light report few; always the middle and the worst place."""
    for shape, count in (((30, 33, 36), 30), ((60, 61, 62), 21)):
        image = make_image(shape)
        result = make_result(image, image)
        data = make_report_data(image, image, result)
        assert [len(cuts.numbers) >= count for cuts in data.slices] == [True] * 3
        light = make_report_data(image, image, result, light=True)
        assert all(len(cuts.numbers) <= 7 for cuts in light.slices)
        for cuts in (*data.slices, *light.slices):
            assert cuts.plane.middle in cuts.numbers
            assert cuts.plane.through is not None
            assert cuts.numbers[cuts.start] == round(data.known.worst.node[cuts.plane.through])


def test_what_lies_beyond_the_moving_image_does_not_stretch_the_scale(make_image, make_result):
    """A moving image of half the size: the scale of the differences is that of the half that is there."""
    whole = make_image((40, 40))
    half = replace(whole, data=whole.data[..., :20] * 0.9, grid=Grid((40, 20)))
    still = torch.zeros(1, 2, 40, 40)
    result = replace(make_result(whole, half), displacement=still, inverse=still, warped=resample(half, whole))
    data = make_report_data(whole, half, result)
    field = data.slices[0].fields["after"]
    assert field[..., :20].isfinite().all()
    assert field[..., 20:].isnan().all()
    assert data.limits["before"] == pytest.approx(float(field[..., :20].max()), abs=0.05)
