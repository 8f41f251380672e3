"""Planes: upright, in the right place, and chosen by name."""

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.report.planes import PLANES, chosen_plane, planes_of


def test_planes_show_the_patient_upright(make_image):
    """However a volume is stored, z goes up, y down and x to the right on the sheet."""
    grid_image = make_image((5, 6, 7))
    for direction, vertical in (
        (((1, 0, 0), (0, 1, 0), (0, 0, 1)), [(1, False), (0, True), (0, True)]),
        (((-1, 0, 0), (0, -1, 0), (0, 0, -1)), [(1, True), (0, False), (0, False)]),
        (((0, 0, 1), (1, 0, 0), (0, 1, 0)), [(2, False), (1, True), (1, True)]),
    ):
        image = Image(grid_image.data, grid_image.grid, direction=direction)
        assert [(plane.axes[0], plane.flipped[0]) for plane in planes_of(image)] == vertical


@pytest.mark.parametrize("direction", [((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, 0, -1), (1, 0, 0), (0, 1, 0))])
def test_letters_say_where_the_patient_is(make_image, direction):
    """A step to the right of the picture goes to the side of the body that its letter names, and so downwards."""
    image = Image(make_image((5, 6, 7)).data, Grid((5, 6, 7)), direction=direction)
    ways = {"L": (1, 0, 0), "R": (-1, 0, 0), "P": (0, 1, 0), "A": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
    for plane in planes_of(image):
        left, right, top, bottom = plane.letters
        for axis, turned, letter, other in (
            (plane.axes[1], plane.flipped[1], right, left),
            (plane.axes[0], plane.flipped[0], bottom, top),
        ):
            step = torch.zeros(1, 3, 1, dtype=torch.float64)
            step[0, axis] = -1.0 if turned else 1.0
            way = (image.to_world(step) - image.to_world(torch.zeros_like(step))).flatten().tolist()
            assert way == list(ways[letter]) == [-w for w in ways[other]]
    assert [plane.letters for plane in planes_of(make_image((5, 6, 7)))] == ["RLAP", "RLSI", "APSI"]
    assert planes_of(make_image((5, 6)))[0].letters == ""


@pytest.mark.parametrize("dim", [2, 3])
def test_points_of_slices_are_where_the_slices_are(make_image, dim):
    """Cutting the coordinates of all nodes gives the coordinates of the slices' nodes."""
    image = make_image((6, 7, 9)[-dim:], (2.0, 1.0, 0.5)[-dim:], tilted=True)
    every = image.grid.points(dtype=torch.float64)
    for plane in planes_of(image):
        numbers = (0,) if plane.depth == 1 else (1, plane.middle, plane.depth - 1)
        assert torch.equal(plane.arrange(plane.points(numbers)), plane.cut(every, numbers))
        assert plane.cut(every, numbers).shape == (len(numbers), dim, *plane.shape)
        assert torch.equal(plane.arrange(plane.chosen(every, numbers)), plane.cut(every, numbers))


def test_a_plane_is_chosen_by_name(make_image):
    volume, picture = make_image((6, 8, 9)), make_image((6, 8))
    assert [chosen_plane(volume, name, None)[0].name for name in (None, *PLANES)] == ["axial", *PLANES]
    assert chosen_plane(volume, "coronal", 0)[1] == 0
    assert chosen_plane(picture, None, None)[1] == 0
    for image, name, index, message in (
        (volume, "axal", None, "did you mean 'axial'"),
        (picture, "axial", None, "is 2D and has no axial plane"),
        (volume, "axial", 6, "there are 6 axial slices, from 0; there is no slice 6"),
        (picture, None, 1, "there is no slice 1"),
    ):
        with pytest.raises(InputError, match=message):
            chosen_plane(image, name, index)
