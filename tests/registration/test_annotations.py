"""What does not go with the images is named."""

import pytest
import torch
from nested_settings import changed, settings_of
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register

QUICK = settings_of(steps=(1,), window=7)


def image(data: Tensor, name: str = "image") -> Image:
    return Image(data, Grid(tuple(data.shape[2:])), name=name)


PAIR = torch.rand(1, 1, 16, 16), torch.rand(1, 1, 16, 16)


POINTS = torch.rand(1, 2, 3)


@pytest.mark.parametrize(
    ("annotations", "message"),
    [
        ({"fixed_mask": torch.zeros(1, 1, 16, 16)}, "fixed_mask is 0 everywhere"),
        ({"moving_mask": torch.full((1, 1, 16, 16), 255.0)}, "moving_mask must hold weights from 0 to 1"),
        ({"moving_mask": torch.full((1, 1, 16, 16), torch.nan)}, "moving_mask must hold weights"),
        ({"moving_mask": torch.ones(1, 1, 16, 15)}, "moving_mask must have shape"),
        ({"moving_mask": image(torch.ones(1, 1, 16, 16))}, "moving_mask must be a tensor"),
        ({"fixed_points": POINTS}, "moving_points are missing"),
        ({"moving_labels": PAIR[0]}, "fixed_labels are missing"),
        ({"fixed_points": POINTS, "moving_points": POINTS[..., :2]}, "both have shape"),
        ({"fixed_points": POINTS, "moving_points": POINTS / 0}, "must be finite"),
        ({"fixed_points": POINTS[:, :1], "moving_points": POINTS[:, :1]}, r"must have shape \(1, 2, n\)"),
        ({"fixed_labels": PAIR[0], "moving_labels": PAIR[1]}, "whole numbers"),
        ({"fixed_labels": torch.ones(1, 1, 16, 16), "moving_labels": torch.zeros(1, 1, 16, 16)}, "no label in common"),
    ],
)
def test_guidance_that_does_not_fit_is_named(annotations, message):
    with pytest.raises(InputError, match=message):
        register(*PAIR, QUICK, annotations=Annotations(**annotations))


@pytest.mark.parametrize(
    ("annotations", "message"),
    [
        ({"fixed_mask": torch.ones(1, 1, 16, 16)}, "fixed_mask must be an Image"),
        ({"fixed_mask": image(torch.ones(1, 1, 8, 8, 8), "volume")}, "volume must be 2D"),
        ({"fixed_mask": image(torch.ones(1, 3, 16, 16), "rgb")}, "rgb must be 2D with one channel"),
        ({"moving_mask": image(torch.zeros(1, 1, 16, 16), "empty.png")}, "empty.png is 0 everywhere"),
        ({"fixed_points": POINTS.repeat(2, 1, 1), "moving_points": POINTS.repeat(2, 1, 1)}, "must have shape"),
    ],
)
def test_guidance_that_does_not_fit_images_is_named(annotations, message):
    with pytest.raises(InputError, match=message):
        register(*map(image, PAIR), changed(QUICK, align="none"), annotations=Annotations(**annotations))


def test_tissue_of_another_size_or_kind_is_named():
    grid, image = Grid((12, 14)), Image(torch.zeros(1, 1, 12, 14), Grid((12, 14)), name="parts")
    with pytest.raises(InputError, match=r"tissue must have shape \(2, 1, 12, 14\), got \(3, 1, 12, 14\)"):
        Annotations(tissue=torch.zeros(3, 1, 12, 14)).require_tensors(grid, 2)
    with pytest.raises(InputError, match="tissue must be a tensor, because the images are"):
        Annotations(tissue=image).require_tensors(grid, 1)
    with pytest.raises(InputError, match="tissue must be an Image, because the images are"):
        Annotations(tissue=image.data).require_images(2)
    with pytest.raises(InputError, match="tissue: parts must be 3D with one channel"):
        Annotations(tissue=image).require_images(3)
