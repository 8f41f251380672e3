"""The small picture: the warped image fills it, and outlines run where the fixed image changes."""

import numpy as np
import pytest
from report_pairs import pictures_of
from skimage.io import imread

from torchdeform.report.report_data import make_report_data
from torchdeform.report.thumbnail import write_thumbnail


@pytest.mark.parametrize(("dim", "channels"), [(2, 1), (2, 3), (3, 1)])
def test_a_thumbnail_is_small_and_has_outlines(tmp_path, make_image, make_result, dim, channels):
    fixed, moving = pictures_of(make_image, dim, channels)
    data = make_report_data(fixed, moving, make_result(fixed, moving), slices=1)
    write_thumbnail(tmp_path / "thumb.jpg", data)
    picture = imread(tmp_path / "thumb.jpg").astype(int)
    assert (tmp_path / "thumb.jpg").stat().st_size < 40_000
    assert picture.shape[0] < 200
    if channels == 1:  # what is coloured in a grey picture are the outlines
        coloured = np.ptp(picture, axis=-1) > 60
        assert 0.0005 < coloured.mean() < 0.4
