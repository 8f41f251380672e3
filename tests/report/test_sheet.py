"""Figures whose panels have their places: no text is over another, or beyond the figure."""

import pytest

from torchdeform.report.sheet import TITLE, Sheet, shortened, title


@pytest.mark.parametrize(("width", "heights"), [(3.2, [6.4, 6.4]), (3.2, [0.2, 1.0]), (2.3, [4.0, 0.5, 2.0])])
def test_no_text_meets_another(width, heights):
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    names = "sub-01_ses-BASELINE_T1w_MNI152NLin6.nii.gz" * 9
    sheet = Sheet(width, 4, heights, [TITLE] * len(heights), headlines=[names, "x" * 40], bottom=0.5)
    for row in sheet.panels:
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
            title(axes, "difference before it")
    bar = sheet.below(sheet.panels[-1][2], 2.0, 0.1, 0.12)
    bar.set_yticks([])
    canvas = FigureCanvasAgg(sheet.figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    texts = [*sheet.figure.texts, *(axes.title for row in sheet.panels for axes in row)]
    boxes = [text.get_window_extent(renderer) for text in texts] + [bar.get_tightbbox(renderer)]
    boxes += [axes.get_window_extent(renderer) for row in sheet.panels for axes in row]
    for k, box in enumerate(boxes):
        assert box is not None
        assert sheet.figure.bbox.padded(1).contains(box.x0, box.y0)
        assert sheet.figure.bbox.padded(1).contains(box.x1, box.y1)
        assert not any(box.overlaps(other) for other in boxes[:k] if other is not None)


def test_long_names_keep_both_ends():
    assert shortened("subject", 7) == "subject"
    assert shortened("sub-01_very_long_T1w.nii.gz", 15) == "sub-01_….nii.gz"
