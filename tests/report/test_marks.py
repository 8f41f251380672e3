"""What is drawn over slices: in the right slice, at the right place, in the right colour."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchdeform.registration.annotations import Annotations
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report import make_report_data
from torchdeform.report.marks import landmark_colours


def _points(lines) -> np.ndarray:
    return np.concatenate([line for some in lines for line in some])


@pytest.mark.parametrize("dim", [2, 3])
def test_landmarks_are_drawn_on_the_nearest_slice(make_image, make_result, dim):
    """A dot around the fixed point and an arrow to the other, coloured by the distance."""
    image = make_image((40, 44, 48)[-dim:])
    still = torch.zeros(1, dim, *image.grid.shape)
    result = replace(make_result(image, image), displacement=still, inverse=still)
    here = torch.tensor([[20.0, 24.0, 10.2][:dim], [30.0, 12.0, 33.9][:dim]], dtype=torch.float64).T.unsqueeze(0)
    there = here.clone()
    there[0, 0, 0] += 0.5
    there[0, 0, 1] += 9.0
    given = Annotations(fixed_points=here, moving_points=there)
    data = make_report_data(image, image, result, annotations=given)
    cuts = data.slices[0]
    found = {
        mark.colour: lines for mark, lines in cuts.marks.items() if mark.kind == "landmarks" and mark.image == "warped"
    }
    colours = landmark_colours()
    assert list(found) == [colours[0], colours[-1]]
    for k, lines in enumerate(found.values()):
        (number,) = (cuts.numbers[i] for i, some in enumerate(lines) if some)
        if dim == 3:
            assert abs(number - here[0, 2, k]) == min(abs(n - here[0, 2, k]) for n in cuts.numbers)
        dot = next(some[0] for some in lines if some)
        np.testing.assert_allclose((dot.min(0) + dot.max(0)) / 2, here[0, :2, k], atol=0.01)
    assert _points(found[colours[-1]]).max(0)[0] == pytest.approx(39.0)
    assert not any(mark.image == "original" for mark in cuts.marks)


def test_regions_are_where_they_are(make_image, make_result):
    """What is let go and a mask in all planes; nothing is drawn of what is not there."""
    image = make_image((20, 22, 24))
    box = torch.zeros_like(image.data)
    box[..., 4:8, 6:11, 10:16] = 1.0
    still = torch.zeros(1, 3, 20, 22, 24)
    result = replace(make_result(image, image), displacement=still, inverse=still)
    object.__setattr__(result, "absent", box)
    data = make_report_data(image, image, result, annotations=Annotations(fixed_mask=replace(image, data=box)))
    ends = {0: (3.5, 7.5), 1: (5.5, 10.5), 2: (9.5, 15.5)}
    for cuts in data.slices:
        marks = {mark.kind: lines for mark, lines in cuts.marks.items()}
        assert set(marks) <= {"absent", "masks", "outlines", "worst"}
        for kind in ("absent", "masks"):
            points = _points(marks[kind])
            for column, axis in enumerate(cuts.plane.axes[::-1]):
                assert (points[:, column].min(), points[:, column].max()) == pytest.approx(ends[axis])
            assert cuts.plane.through is not None
            first, last = ends[cuts.plane.through]
            assert all(
                (first < number < last) == bool(some) for number, some in zip(cuts.numbers, marks[kind], strict=True)
            )


def test_labels_of_both_images_are_drawn_where_they_are(make_image, make_result):
    """A label of the moving image appears moved by the map; without labels the edges of the fixed image are drawn."""
    image = make_image((40, 50))
    label = torch.zeros_like(image.data)
    label[..., 10:20, 15:30] = 3.0
    shift = torch.zeros(1, 2, 40, 50)
    shift[:, 1] = 4.0
    result = replace(make_result(image, image), displacement=shift, inverse=-shift)
    labels = replace(image, data=label)
    given = Annotations(fixed_labels=labels, moving_labels=labels)
    marks = make_report_data(image, image, result, annotations=given).slices[0].marks
    found = {mark.image: _points(lines) for mark, lines in marks.items() if mark.kind == "outlines"}
    assert set(found) == {"fixed", "moving", "warped"}
    np.testing.assert_allclose(found["fixed"].min(0), (14.5, 9.5))
    np.testing.assert_allclose(found["warped"].min(0), (10.5, 9.5))
    plain = make_report_data(image, image, result).slices[0].marks
    assert {mark.image for mark in plain if mark.kind == "outlines"} == {"fixed"}


def test_tissue_is_drawn_where_settings_name_it_in_the_fixed_image_alone(make_image, make_result):
    """Other labels of the file are not drawn, and the moving image has none; on a grid of their own, too."""
    image, fine = make_image((40, 50)), make_image((79, 99), (0.5, 0.5))
    labels = torch.zeros_like(fine.data)
    labels[..., 20:40, 30:60], labels[..., 50:60, 30:60] = 3.0, 4.0
    settings = RegistrationSettings(tissues={3: "rigid"}, sliding=(9,))
    result = make_result(image, image, settings)
    given = Annotations(tissue=replace(fine, data=labels))
    marks = make_report_data(image, image, result, annotations=given).slices[0].marks
    (mark,) = (mark for mark in marks if mark.kind == "tissue")
    assert (mark.image, mark.colour) == ("fixed", "#009e73")
    points = _points(marks[mark])
    np.testing.assert_allclose((points.min(0), points.max(0)), ((14.5, 9.5), (29.5, 19.5)))
    bare = replace(result, settings=RegistrationSettings())
    assert not any(m.kind == "tissue" for m in make_report_data(image, image, bare, annotations=given).slices[0].marks)
