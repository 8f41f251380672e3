"""The overlay: both images where they lie, in colours that everybody tells apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from report_pairs import pictures_of

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.io import read_image
from torchdeform.report.drawing import BLUE, ORANGE
from torchdeform.report.figures import _cuts, write_overlay, write_overview
from torchdeform.report.report_data import make_report_data


def half(dim: int, low: bool, **how) -> Image:
    """White in the first or the last half along x."""
    shape = (20, 24, 32)[-dim:]
    data = torch.zeros(1, 1, *shape)
    data[..., :16] = float(low)
    data[..., 16:] = float(not low)
    return Image(data, Grid(shape), **how)


@pytest.mark.parametrize("dim", [2, 3])
def test_both_images_are_where_they_lie(dim):
    fixed, moving = half(dim, True), half(dim, False)
    cut = _cuts(fixed, moving)[0]
    first, second = cut.values
    middle = first.shape[1] // 2
    row = first.shape[0] // 2
    assert first[row, middle // 2] == second[row, middle + middle // 2] == 1
    assert first[row, middle + middle // 2] == second[row, middle // 2] == 0


@pytest.mark.parametrize("dim", [2, 3])
def test_a_shifted_image_is_drawn_shifted(dim):
    """A bright voxel lands where its world position says, whatever the direction of its own axes."""
    fixed = half(dim, True)
    sign = tuple(tuple(-float(i == j) for j in range(dim)) for i in range(dim))
    stored = replace(
        fixed, data=fixed.data.flip(*range(2, 2 + dim)), direction=sign, origin=tuple(fixed.grid.extent[::-1])
    )
    for cut in _cuts(fixed, stored):
        np.testing.assert_allclose(cut.values[0], cut.values[1], atol=1e-6)
        assert np.array_equal(cut.inside[0], cut.inside[1])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("away", [0.0, 15.0, 1e5])
@pytest.mark.parametrize("channels", [1, 3])
def test_it_is_drawn_near_and_far(tmp_path, dim, away, channels):
    fixed = half(dim, True)
    data = fixed.data.expand(1, channels, *fixed.grid.shape)
    write_overlay(tmp_path / "a.png", fixed, replace(fixed, data=data, origin=(away,) * dim))
    picture = read_image(tmp_path / "a.png")
    assert min(picture.grid.shape) > 150
    assert picture.data[0, :3].std() > 20


def test_it_is_the_same_every_time(tmp_path):
    for name in ("a.png", "b.png"):
        write_overlay(tmp_path / name, half(2, True), half(2, False))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_the_colours_are_told_apart_by_everybody():
    """They add up to white and differ most in blue against red, which no common colour blindness mixes up."""
    blue, orange = (np.array(colour) for colour in (BLUE, ORANGE))
    np.testing.assert_allclose(blue + orange, 1.0)
    assert blue[2] - orange[2] == orange[0] - blue[0] == 1.0


def _pixels(path) -> torch.Tensor:
    from torchdeform.io import read_image

    return read_image(path).data[0, :3]


@pytest.mark.parametrize(("dim", "channels"), [(2, 1), (2, 3), (2, 4), (3, 1)])
def test_overview_is_drawn(tmp_path, make_image, make_result, dim, channels):
    fixed, moving = pictures_of(make_image, dim, channels)
    write_overview(tmp_path / "overview.png", make_report_data(fixed, moving, make_result(fixed, moving)))
    pixels = _pixels(tmp_path / "overview.png")
    assert min(pixels.shape[1:]) > 400
    assert pixels.std() > 20


@pytest.mark.parametrize("dim", [2, 3])
def test_overview_survives_odd_results(tmp_path, make_image, make_result, dim):
    """Folds, no levels and a long thin grid are drawn too."""
    fixed = make_image((64, 9, 8)[-dim:] if dim == 3 else (9, 200))
    result = make_result(fixed, fixed)
    folded = replace(result, displacement=result.displacement * 40, levels=())
    write_overview(tmp_path / "overview.png", make_report_data(fixed, fixed, folded, slices=1))
    assert _pixels(tmp_path / "overview.png").std() > 5


def test_overview_is_the_same_every_time(tmp_path, make_image, make_result):
    fixed, moving = pictures_of(make_image, 2)
    for name in ("a.png", "b.png"):
        write_overview(tmp_path / name, make_report_data(fixed, moving, make_result(fixed, moving)))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
