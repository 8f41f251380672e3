"""Planes: upright, in the right place, and chosen by name."""

import pytest
import torch

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.report.planes import PLANES, chosen_plane, planes_of
from torchdeform.report.report_data import evenly_spaced


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


@pytest.mark.parametrize("dim", [2, 3])
def test_points_of_slices_are_where_the_slices_are(make_image, dim):
    """Cutting the coordinates of all nodes gives the coordinates of the slices' nodes."""
    image = make_image((6, 7, 9)[-dim:], (2.0, 1.0, 0.5)[-dim:], tilted=True)
    every = image.grid.points(dtype=torch.float64)
    for plane in planes_of(image):
        numbers = evenly_spaced(plane, 3)
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
