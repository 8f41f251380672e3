"""Pictures of the page: small enough, whatever the image."""

from dataclasses import replace

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.report import make_report_data, write_report
from torchdeform.report.page import fitting_pictures
from torchdeform.report.record import describe


@pytest.mark.parametrize(("shape", "channels"), [((1600, 1500), 3), ((160, 192, 224), 1)])
def test_a_large_noisy_image_makes_a_small_page(tmp_path, make_image, make_result, shape, channels):
    """Noise is what JPEG likes least, in the images and in the map."""
    small, grid = make_image((8,) * len(shape)), Grid(shape)
    random = torch.Generator().manual_seed(0)
    noise, u = (torch.rand(1, count, *shape, generator=random) for count in (channels, grid.dim))
    fixed = Image(noise, grid, pixel_type="uint8")
    result = replace(make_result(small, small), displacement=u, inverse=-u, warped=noise.flip(2), grid=grid)
    write_report(tmp_path / "report.html", make_report_data(fixed, fixed, result), describe(result, fixed, fixed))
    assert (tmp_path / "report.html").stat().st_size < 5e6


def test_pictures_are_made_smaller_where_they_would_not_fit(make_image, make_result, monkeypatch):
    fixed = make_image((200, 300), channels=3, pixel_type="uint8")
    report_data = make_report_data(fixed, fixed, make_result(fixed, fixed))
    sizes = []
    for most in (10**9, 10**5, 0):
        monkeypatch.setattr("torchdeform.report.page._MOST", most)
        found = fitting_pictures(report_data)
        pictures = [picture for group in found["groups"].values() for picture in group]  # type: ignore
        sizes.append(sum(len(strip) for picture in pictures for strip in picture.strips.values()))
    assert sizes[0] > sizes[1] >= sizes[2] > 0
