"""The small picture of a pair that a cohort's page shows: the warped image with outlines of both."""

from pathlib import Path

from torchdeform.report.drawing import PAPER, draw_image, draw_lines_over
from torchdeform.report.marks import OUTLINES
from torchdeform.report.report_data import ReportData
from torchdeform.report.sampling import FIXED, WARPED

_HEIGHT, _WIDEST = 1.7, 3.0  # inches, and widths of a plane at most in heights
_DPI, _QUALITY = 110, 80


def write_thumbnail(path: Path, data: ReportData) -> None:
    """Draw the middle slice of each plane of the warped image as a JPEG, with outlines as in the report.

    Args:
        path: the file to write.
        data: what `make_report_data` returns.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    widths = [_HEIGHT * min(_WIDEST, 1 / cuts.plane.height_over_width) for cuts in data.slices]
    figure = Figure((sum(widths), _HEIGHT), dpi=_DPI, facecolor=PAPER)
    for axes, cuts in zip(
        figure.subplots(1, len(widths), squeeze=False, width_ratios=widths)[0], data.slices, strict=True
    ):
        draw_image(axes, cuts.plane, cuts.fields[WARPED][cuts.middle])
        for mark, lines in cuts.marks.items():
            if mark.kind == OUTLINES and mark.image in (FIXED, WARPED):
                draw_lines_over(axes, lines[cuts.middle], mark.colour)
        axes.set_axis_off()
    figure.subplots_adjust(0, 0, 1, 1, wspace=0.02)
    FigureCanvasAgg(figure).print_jpg(str(path), pil_kwargs={"quality": _QUALITY})
