"""Both images at nodes of the fixed grid: as the library resamples them, wherever they lie in the world."""

import math
from dataclasses import replace

import pytest
import torch

from torchdeform.core.image import resample
from torchdeform.core.transform import Affine, Transform
from torchdeform.registration.annotations import Annotations
from torchdeform.report.planes import planes_of
from torchdeform.report.sampling import FIXED, ORIGINAL, WARPED, PairSampler, grey, quantiles


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("away", [0.0, 1e5])
def test_labels_and_masks_are_where_the_transform_puts_them(make_image, make_result, dim, away):
    """Also on grids of their own, and with an origin far away."""
    origin = (away,) * dim
    fixed = make_image((20, 22, 24)[-dim:], tilted=True, origin=origin)
    moving = make_image((21, 20, 25)[-dim:], (1.1, 0.9, 1.0)[-dim:], origin=origin)
    affine = Affine(torch.eye(dim, dtype=torch.float64), torch.full((dim,), 1.25, dtype=torch.float64))
    result = replace(make_result(fixed, moving), affine=affine)
    labels = make_image((15, 16, 18)[-dim:], (1.3,) * dim, origin=origin)
    labels = replace(labels, data=(labels.data / 40).round())
    mask = replace(moving, data=(moving.data > 90).float())
    given = Annotations(fixed_labels=labels, moving_labels=labels, moving_mask=mask)
    sampler = PairSampler(fixed, moving, result, given)
    whole = Transform.from_displacement(result.displacement, fixed, affine=affine)
    plane = planes_of(fixed)[0]
    numbers = range(plane.depth)
    warped, here = (sampler.at_slices(name, plane, numbers) for name in (WARPED, FIXED))
    for found, expected in (
        (warped.labels, whole.image(labels, fixed, mode="nearest").data),
        (warped.mask, whole.image(mask, fixed, mode="nearest").data),
        (here.labels, resample(labels, fixed, mode="nearest")),
    ):
        assert found is not None
        assert float((found == plane.cut(expected, numbers)).float().mean()) > 0.999
    assert here.mask is None
    assert sampler.at_slices(ORIGINAL, plane, numbers).labels is None
    assert bool(here.inside.all())
    assert not bool(warped.inside.all())


def test_grey_values_and_percentiles(make_image):
    assert grey(make_image((12, 14), channels=2)).shape[1] == 1
    assert quantiles(torch.tensor([math.nan]), 1.0, 99.0) == [0.0, 0.0]
