"""Outlines: they enclose what they should, and edges are where an image changes."""

import numpy as np
import pytest

from torchdeform.report.contours import edge_lines, outlines


def _area(line) -> float:
    """The area inside a closed line, by Green's theorem."""
    (x, y), (a, b) = line.T, np.roll(line, -1, axis=0).T
    return abs(float((x * b - a * y).sum()) / 2)


def test_an_outline_encloses_its_region():
    """A box of pixels: its area less the corners that are cut off; closed, also at the edge of the image."""
    inside = np.zeros((3, 20, 30), dtype=bool)
    inside[0, 5:9, 10:17] = True
    inside[2, 0:4, 25:30] = True
    first, empty, last = outlines(inside)
    assert empty == []
    for lines, area in ((first, 28), (last, 20)):
        (line,) = lines
        assert np.array_equal(line[0], line[-1])
        assert _area(line) == pytest.approx(area - 4 / 8)
    np.testing.assert_allclose(first[0].mean(0), (13, 6.5), atol=0.6)
    np.testing.assert_allclose(last[0].min(0), (24.5, -0.5))


def test_a_ring_has_two_outlines():
    inside = np.ones((1, 9, 9), dtype=bool)
    inside[0, 3:6, 3:6] = False
    assert sorted(_area(line) for line in outlines(inside)[0]) == pytest.approx([9 - 4 / 8 + 1, 81 - 4 / 8], abs=1.1)


@pytest.mark.parametrize("values", [(1, 2, 7), (-3, 5, 70000), (0.5, 2.0, 614454277.0)])
def test_every_label_has_its_outline(values):
    """Whatever its number is; touching labels have one each, 0 has none."""
    labels = np.zeros((1, 12, 30))
    for k, value in enumerate(values):
        labels[0, 2:10, 3 + 8 * k : 11 + 8 * k] = value
    lines = outlines(labels)[0]
    assert sorted(_area(line) for line in lines) == pytest.approx([63.5] * 3)
    assert sorted(round(float(line[:, 0].mean())) for line in lines) == pytest.approx([6, 14, 22], abs=1)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 2.0)])
def test_edges_are_where_a_disc_ends(spacing):
    """A blurred disc of known radius, on pixels that need not be square; an empty slice has none."""
    down, across = (np.arange(n) * h for n, h in zip((120, 120), spacing, strict=True))
    middle = (down[-1] / 2, across[-1] / 2)
    radius = min(middle) * 0.6
    distance = np.hypot(*np.meshgrid(down - middle[0], across - middle[1], indexing="ij"))
    disc = 1 / (1 + np.exp((distance - radius) / (0.02 * radius)))
    lines, none = edge_lines(np.stack((disc, np.zeros_like(disc))), spacing)
    assert none == []
    found = np.concatenate(lines) * spacing[::-1] - np.array(middle)[::-1]
    assert abs(np.hypot(*found.T) - radius).max() < 1.2 * max(spacing)
