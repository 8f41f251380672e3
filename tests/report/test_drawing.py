"""Colours that can be told apart."""

from torchdeform.report import drawing


def test_colours_of_curves_differ_in_brightness_or_blue():
    """Okabe and Ito's palette, no colour twice."""
    assert len(set(drawing.CURVES)) == len(drawing.CURVES)
