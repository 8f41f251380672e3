"""Images in physical space: geometry, resampling, luminance, overlap."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import (
    Image,
    is_oblique,
    luminance,
    orientation,
    overlap,
    require_registrable,
    require_same_place,
    resample,
    surroundings,
)
from torchdeform.errors import InputError


@pytest.mark.parametrize("dim", [2, 3])
def test_world_and_grid_undo_each_other(make_image, dim):
    image = make_image((5, 6, 7)[-dim:], (0.5, 2.0, 1.2)[-dim:], origin=(1e5, -20.0, 3.0)[:dim], tilted=True)
    points = torch.rand(2, dim, 9, dtype=torch.float64, generator=torch.manual_seed(0)) * 10
    torch.testing.assert_close(image.to_grid(image.to_world(points)), points, atol=1e-9, rtol=0)


def test_world_of_a_turned_image():
    """A quarter turn: stepping along the rows (x index) moves along world y."""
    image = Image(torch.zeros(1, 1, 3, 4), Grid((3, 4), (2.0, 0.5)), (10.0, 20.0), ((0, -1), (1, 0)))
    points = torch.tensor([[2.0], [0.5]])[None]  # array order: one row down, one column across
    assert image.to_world(points).flatten().tolist() == [8.0, 20.5]


@pytest.mark.parametrize("dim", [2, 3])
def test_resampling_onto_another_grid_keeps_the_world(make_image, dim):
    """A smooth function of world position stays itself on a finer, turned grid, as linear interpolation allows."""
    coarse = make_image((40, 44, 48)[-dim:], (1.0, 0.9, 1.1)[-dim:], origin=(-20.0,) * dim)
    fine = make_image((14, 15, 16)[-dim:], (0.7, 0.8, 0.6)[-dim:], tilted=True)
    assert (resample(coarse, fine) - fine.data).abs().max() < 2.1  # Σ_k h_k² / 8 · max |∂_k² f| is 2.03


def test_outside_is_what_was_asked_for():
    image = Image(torch.full((1, 1, 4, 4), 5.0), Grid((4, 4)))
    far = Image(torch.zeros(1, 1, 4, 4), Grid((4, 4)), (2.0, 0.0))
    assert resample(image, far)[0, 0, 0].tolist() == [5.0, 5.0, 0.0, 0.0]
    assert resample(image, far, outside=-1.0)[0, 0, 0].tolist() == [5.0, 5.0, -1.0, -1.0]
    assert resample(image, far, outside=None)[0, 0, 0].tolist() == [5.0, 5.0, 5.0, 5.0]


@pytest.mark.parametrize("dim", [2, 3])
def test_luminance_is_the_standard_one(dim):
    from skimage.color import rgb2gray  # an oracle with weights a little different (Rec. 709)

    rgb = torch.rand(1, 3, *(6, 7, 8)[-dim:], generator=torch.manual_seed(0))
    grey = luminance(Image(rgb, Grid(rgb.shape[2:]))).data
    expected = (rgb * torch.tensor([0.299, 0.587, 0.114]).view(1, 3, *[1] * dim)).sum(1, keepdim=True)
    torch.testing.assert_close(grey, expected)
    assert np.corrcoef(grey.flatten(), rgb2gray(rgb[0].numpy(), channel_axis=0).flatten())[0, 1] > 0.95


@pytest.mark.parametrize(("kind", "opaque"), [("uint8", 255.0), ("uint16", 65535.0), ("float32", 1.0)])
def test_transparent_counts_as_black(kind, opaque):
    rgba = torch.full((1, 4, 3, 3), 0.5 * opaque)
    rgba[:, 3] = opaque
    rgba[:, 3, 0] = 0.0
    grey = luminance(Image(rgba, Grid((3, 3)), pixel_type=kind)).data / opaque
    torch.testing.assert_close(grey[0, 0], torch.tensor([[0.0] * 3, [0.5] * 3, [0.5] * 3]))


def test_luminance_of_grey_is_itself_and_of_others_refused(make_image):
    grey = make_image((6, 7))
    assert luminance(grey) is grey
    with pytest.raises(InputError, match="slice has 5 channels"):
        luminance(make_image((6, 7), channels=5, name="slice"))


def test_overlap_is_the_share_of_the_fixed_grid(make_image):
    fixed = make_image((101, 101))
    assert overlap(fixed, fixed) == 1.0
    assert overlap(fixed, make_image((101, 101), origin=(50.0, 0.0))) == pytest.approx(0.5, abs=0.05)
    assert overlap(fixed, make_image((101, 101), origin=(50.0, 50.0))) == pytest.approx(0.25, abs=0.05)
    assert overlap(fixed, make_image((101, 101), origin=(102.0, 0.0))) == 0.0
    with pytest.raises(InputError, match="a is 2D but b is 3D"):
        overlap(make_image((8, 8), name="a"), make_image((8, 8, 8), name="b"))


def test_what_cannot_be_registered(make_image):
    image = make_image((6, 7), name="slice")
    require_registrable(image)
    with pytest.raises(InputError, match="slice is constant"):
        require_registrable(Image(torch.ones(1, 3, 6, 7), image.grid, name="slice"))
    for value in (math.nan, math.inf):
        broken = image.data.clone()
        broken[0, 0, 2, 2] = value
        with pytest.raises(InputError, match="slice has pixels that are NaN"):
            require_registrable(Image(broken, image.grid, name="slice"))


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"direction": ((1, 1), (1, 1))}, "singular"),
        ({"direction": ((math.nan, 0), (0, 1))}, "singular"),
        ({"direction": ((1, 0, 0), (0, 1, 0), (0, 0, 1))}, "must have 2 axes"),
        ({"origin": (1.0,)}, "must have 2 axes"),
        ({"origin": (1.0, math.inf)}, "not finite"),
    ],
)
def test_broken_headers_are_refused(how, message):
    with pytest.raises(InputError, match=message):
        Image(torch.zeros(1, 1, 4, 4), Grid((4, 4)), **how)


def test_device_is_moved():
    image = Image(torch.zeros(1, 1, 4, 4), Grid((4, 4)), (1.0, 2.0), name="slice")
    moved = image.to("meta")
    assert (moved.data.device.type, moved.origin, moved.name) == ("meta", (1.0, 2.0), "slice")


@pytest.mark.parametrize(("unit", "shown"), [("px", 2.5), ("mm", 2.5), ("µm", 2500.0)])
def test_lengths_are_shown_in_the_unit_of_the_image(unit, shown):
    image = Image(torch.zeros(1, 1, 4, 4), Grid((4, 4)), unit=unit)
    assert image.in_unit(2.5) == shown
    assert image.in_unit(torch.tensor([2.5])).item() == shown


def test_unknown_units_are_refused():
    with pytest.raises(InputError, match="slice: unit must be one of px, mm, µm, got 'inch'"):
        Image(torch.zeros(1, 1, 4, 4), Grid((4, 4)), name="slice", unit="inch")


def framed(border: tuple[float, ...], inside: tuple[float, ...], noise: float = 0.0, dim: int = 2) -> Image:
    """Return an image of two colours: an object in the middle of a border."""
    shape = (40, 50, 60)[-dim:]
    middle = torch.zeros(shape, dtype=torch.bool)
    middle[(slice(10, 30),) * dim] = True
    data = torch.stack([torch.where(middle, i, b) for b, i in zip(border, inside, strict=True)])
    data += noise * torch.randn(data.shape, generator=torch.manual_seed(0))
    return Image(data[None], Grid(shape))


@pytest.mark.parametrize(
    ("border", "inside", "noise"),
    [
        ((0.0,), (200.0,), 0.0),
        ((240.0,), (90.0,), 2.0),  # paper
        ((-1000.0,), (40.0,), 20.0),  # air
        ((240.0, 235.0, 230.0), (90.0, 40.0, 120.0), 2.0),
        ((0.0, 0.0, 0.0, 0.0), (90.0, 40.0, 120.0, 255.0), 0.0),  # transparent
    ],
)
@pytest.mark.parametrize("dim", [2, 3])
def test_what_surrounds_an_image_is_its_border(border, inside, noise, dim):
    found = surroundings(framed(border, inside, noise, dim))
    torch.testing.assert_close(found, torch.tensor(border), atol=noise, rtol=0)


def test_an_image_full_of_tissue_is_surrounded_by_its_dark_end():
    """Half of the border is tissue, and a corner holds what a scanner writes where it saw nothing."""
    image = framed((-1000.0,), (40.0,), 20.0)
    image.data[..., :25] = torch.linspace(-300, 300, 25)
    image.data[..., :2, :2] = -3024.0
    found = surroundings(image).item()
    assert found == pytest.approx(-1000, abs=60)
    assert found in image.data


def test_what_is_not_finite_surrounds_nothing():
    image = framed((7.0,), (1.0,))
    image.data[..., 0, :] = math.nan
    image.data[..., :, 0] = math.inf
    assert surroundings(image).item() == 7
    assert surroundings(replace(image, data=image.data * math.nan)).item() == 0


def test_outside_of_colours_is_their_surroundings():
    image = framed((240.0, 235.0, 230.0), (90.0, 40.0, 120.0))
    far = replace(image, origin=(30.0, 0.0))
    found = resample(image, far, outside="auto")
    assert found[0, :, :, 25:].flatten(1).unique(dim=1).T.tolist() == [[240.0, 235.0, 230.0]]
    with pytest.raises(InputError, match="outside, if it is no number, must be one of auto, got 'white'"):
        resample(image, far, outside="white")


@pytest.mark.parametrize(
    ("direction", "letters", "oblique"),
    [
        (((1, 0, 0), (0, 1, 0), (0, 0, 1)), "LPS", False),
        (((-1, 0, 0), (0, -1, 0), (0, 0, 1)), "RAS", False),
        (((-1, 0, 0), (0, -1, 0), (0, 0, -1)), "RAI", False),
        (((0, 0, -1), (1, 0, 0), (0, 1, 0)), "PSR", False),
        (((0, 0, 1), (-1, 0, 0), (0, -1, 0)), "AIL", False),
        (((0.936, -0.275, 0.218), (0.29, 0.956, -0.037), (-0.199, 0.098, 0.975)), "LPS", True),
        (((0, 1), (-1, 0)), "AL", False),
        (((0.8, -0.6), (0.6, 0.8)), "LP", True),
    ],
)
def test_orientation_codes(direction, letters, oblique):
    dim = len(direction)
    image = Image(torch.rand(1, 1, *[3] * dim), Grid((3,) * dim), direction=direction)
    assert (orientation(image), is_oblique(image)) == (letters, oblique)


def test_another_spacing_is_another_place(make_image):
    image = make_image((8, 9), (1.0, 1.0))
    require_same_place(image, replace(image, grid=Grid((8, 9), (1.0, 1.0 + 1e-5))))
    with pytest.raises(InputError, match=r"must lie in one place, but their headers put them 8 mm apart"):
        require_same_place(image, replace(image, grid=Grid((8, 9), (1.0, 2.0))))
