"""Images for the page: the slices of a volume side by side, upright."""

import pytest

from torchdeform.report import make_report_data
from torchdeform.report.web_images import frame_of, image_strip


def test_a_sprite_holds_the_slices_upright(make_image, make_result):
    """A bright corner of the second slice is where it belongs, below the first, turned like the plane."""
    import base64
    import io

    import numpy as np
    from PIL import Image as Picture

    report_data = make_report_data(
        *[make_image((20, 24, 28))] * 2, make_result(*[make_image((20, 24, 28))] * 2), slices=3
    )
    cuts = report_data.slices[1]
    assert cuts.plane.flipped == (True, False)
    frame = frame_of(cuts.plane, 3, 200)
    pixels = np.zeros((3, *cuts.plane.shape, 1), dtype=np.uint8)
    pixels[1, -6:, :6] = 255
    data = base64.b64decode(image_strip(pixels, cuts.plane, frame, 90).partition(",")[2])
    sheet = np.asarray(Picture.open(io.BytesIO(data)))
    assert sheet.shape == (3 * frame.pitch, frame.across)
    down, across = (values.mean() for values in np.nonzero(sheet > 128))
    assert frame.pitch < down < frame.pitch + frame.down / 3
    assert across < frame.across / 3
    positions = frame.positions
    assert positions[0] < positions[1] < positions[2]
    top = positions[1] / 100 * (3 * frame.pitch - frame.down)
    assert top == pytest.approx(frame.pitch + 4, abs=0.01)
