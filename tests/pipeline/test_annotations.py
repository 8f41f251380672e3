"""Landmarks and labels of another image, in other units, or turned, are named before any long work."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.pipeline.annotations import check_labels, check_points
from torchdeform.pipeline.preflight import ERROR, WARNING

PATH = Path("points.csv")


def picture(shape=(120, 160), *, unit="px", name="photo.jpg", spacing=1.0, origin=(0.0, 0.0)):
    return Image(torch.zeros(1, 1, *shape), Grid(shape, (spacing,) * len(shape)), origin, name=name, unit=unit)


def points(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def test_points_inside_and_a_little_outside_pass():
    image = picture()
    assert list(check_points(image, points([0, 0], [159, 119], [-2.9, 50], [161, 121]), PATH)) == []
    volume = picture((8, 9, 10), unit="mm", spacing=2.0, origin=(-5.0, 6.0, 7.0))
    assert list(check_points(volume, points([-5.0, 6.0, 7.0], [13.0, 22.0, 21.0]), PATH)) == []


def test_points_outside_are_counted_and_measured():
    some = points([10, 10], [159 + 300, 119 + 400], [20, 30])
    (found,) = check_points(picture(), some, PATH)
    assert found.severity == WARNING
    assert found.text.startswith("1 of 3 points of points.csv lie outside of photo.jpg, the farthest by 500 px; check")
    (found,) = check_points(picture(), some[1:2], PATH)
    assert found.severity == ERROR


def test_units_and_directions_that_are_mistaken_are_errors(make_image):
    """RAS for LPS on a grid away from the origin, and mm for a picture in micrometres."""
    image = make_image((8, 9, 10), origin=(20.0, 30.0, 40.0), tilted=True)
    inside = image.to_world(image.grid.points(dtype=torch.float64)).flatten(2)[0].T[::50]
    assert list(check_points(image, inside, PATH)) == []
    (found,) = check_points(image, inside * torch.tensor([-1.0, -1.0, 1.0]), PATH)
    assert found.severity == ERROR
    small = replace(picture(spacing=0.001), unit="µm")
    (found,) = check_points(small, points([50.0, 60.0]), PATH)
    assert "the farthest by 7.791e+04 µm" in found.text


def test_labels_of_a_picture_have_its_size():
    labels = picture((160, 120), name="labels.png")
    (found,) = check_labels(picture(), labels)
    assert found.severity == ERROR
    assert found.text.startswith("labels.png is 120×160 but photo.jpg is 160×120; give labels with a value for every")
    assert list(check_labels(picture(), picture(name="labels.png"))) == []
    (found,) = check_labels(picture(unit="mm", spacing=0.5, name="slide.tif"), picture(name="labels.png"))
    assert found.severity == ERROR
    assert "must lie in one place" in found.text


@pytest.mark.parametrize(
    ("shape", "spacing", "origin", "severity"),
    [
        ((20, 20, 20), 1.0, 0.0, None),
        ((10, 10, 10), 2.0, 0.5, None),  # the same part of the world at half the resolution
        ((20, 20, 20), 1.0, 6.0, WARNING),
        ((8, 8, 8), 1.0, 0.0, WARNING),
        ((20, 20, 20), 1.0, 100.0, ERROR),
    ],
)
def test_labels_of_a_volume_are_where_it_is(shape, spacing, origin, severity):
    image = picture((20, 20, 20), unit="mm", name="t1.nii", origin=(0.0,) * 3)
    labels = picture(shape, unit="mm", name="seg.nii", spacing=spacing, origin=(origin,) * 3)
    found = [one.severity for one in check_labels(image, labels)]
    assert found == ([] if severity is None else [severity])


def test_labels_of_another_dimension_are_left_to_others():
    assert list(check_labels(picture(), picture((9, 9, 9), origin=(0.0,) * 3))) == []
