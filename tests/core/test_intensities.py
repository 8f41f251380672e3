"""Intensities: filled where they are unknown, brought to one scale, channels that correspond."""

import math
from dataclasses import replace

import pytest
import torch
from pictures import blobs, disc
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.intensities import corresponding_channels, fill, to_common_scale
from torchdeform.errors import InputError


def test_fill_keeps_what_is_known_and_stays_between_its_values():
    for shape in ((33, 20), (9, 12, 17)):
        image, mask = blobs(shape, 3, items=2), (torch.rand(2, 1, *shape) < 0.1).float()
        filled = fill(torch.where(mask > 0, image, torch.nan), mask)
        assert torch.equal(filled[mask > 0], image[mask > 0])
        for item in range(2):
            known = image[item][mask[item] > 0]
            assert filled[item].min() >= known.min() - 1e-5
            assert filled[item].max() <= known.max() + 1e-5


def test_intensities_are_scaled_by_what_the_masks_show_channel_by_channel():
    image = torch.cat([blobs((32, 32), 1), 100 * blobs((32, 32), 2), torch.zeros(1, 1, 32, 32)], dim=1)
    mask = disc((32, 32), (16, 16), 8)
    spoilt = torch.where(mask > 0, image, 1e6)
    scaled, other = to_common_scale((spoilt, image), (mask, None), jointly=False)
    for channel in (0, 1):
        inside = scaled[0, channel][mask[0, 0] > 0]
        assert inside.quantile(0.005).item() == pytest.approx(0, abs=0.01)
        assert inside.quantile(0.995).item() == pytest.approx(1, abs=0.01)
    assert (other[:, 2] == 0).all()
    jointly = to_common_scale((image, 2 * image), (None, None), jointly=True)
    ranges = [float(scaled[0, 0].max() - scaled[0, 0].min()) for scaled in jointly]
    assert ranges[1] == pytest.approx(2 * ranges[0], rel=1e-4)


def test_channels_that_correspond():
    grid = Grid((8, 9))
    grey, colour = (Image(torch.rand(1, c, 8, 9), grid, name=n) for c, n in ((1, "a"), (3, "b")))
    shades = replace(colour, data=grey.data.expand(1, 3, 8, 9))
    many = Image(torch.rand(1, 5, 8, 9), grid, name="many")
    clear = replace(colour, data=torch.cat([colour.data, torch.zeros(1, 1, 8, 9)], dim=1))

    def counts(*images: Image) -> list[int]:
        return [image.data.shape[1] for image in corresponding_channels(*images)]

    assert counts(grey, grey) == [1, 1]
    assert counts(colour, colour) == counts(clear, colour) == [3, 3]
    assert counts(grey, colour) == counts(clear, grey) == [1, 1]
    assert counts(shades, shades) == counts(shades, grey) == [1, 1]
    assert counts(many, many) == [5, 5]
    assert (corresponding_channels(clear, clear)[0].data == 0).all()
    with pytest.raises(InputError, match="many has 5 channels and b 3"):
        corresponding_channels(many, colour)


def image(data: Tensor, name: str = "image") -> Image:
    return Image(data, Grid(tuple(data.shape[2:])), name=name)


@pytest.mark.parametrize("shape", [(3, 40), (9, 2, 33)])
def test_fill_reaches_across_axes_of_very_different_length(shape):
    image, mask = torch.full((1, 1, *shape), math.nan), torch.zeros(1, 1, *shape)
    image[..., 0], mask[..., 0] = 5.0, 1.0
    torch.testing.assert_close(fill(image, mask), torch.full_like(image, 5.0))
