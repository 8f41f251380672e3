"""The small picture of a pair that a cohort's page shows: the warped image with contours of the fixed one."""

from pathlib import Path

import torch

from torchdeform.core.grid import Grid
from torchdeform.deformation.monitors import smooth
from torchdeform.report.drawing import PAPER, draw_image
from torchdeform.report.report_data import ReportData, Slices

_HEIGHT, _WIDEST = 1.7, 3.0  # inches, and widths of a plane at most in heights
_DPI, _QUALITY = 110, 80
_CONTOUR, _BLUR = "#ffb000", 0.012  # standard deviation of the blur in lengths of the longer side


def write_thumbnail(path: Path, data: ReportData) -> None:
    """Draw the middle slice of each plane of the warped image as a JPEG, with contours of the fixed image.

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
        draw_image(axes, cuts.plane, cuts.fields["warped"][cuts.middle])
        contour = _grey(cuts)
        axes.contour(contour.numpy(), levels=[_between(contour)], colors=[_CONTOUR], linewidths=0.9)
        axes.set_axis_off()
    figure.subplots_adjust(0, 0, 1, 1, wspace=0.02)
    FigureCanvasAgg(figure).print_jpg(str(path), pil_kwargs={"quality": _QUALITY})


def _grey(cuts: Slices) -> torch.Tensor:
    """Return the grey values of the fixed slice ``(down, across)``, blurred."""
    grey = cuts.fields["fixed"][cuts.middle].mean(0).float()
    return smooth(grey[None, None], Grid(tuple(grey.shape)), _BLUR * max(grey.shape))[0, 0]


def _between(grey: torch.Tensor) -> float:
    """Return the grey value between the dark and the bright pixels: each half's mean is equally far from it."""
    level = grey.mean()
    for _ in range(20):
        dark, bright = grey[grey <= level], grey[grey > level]
        if not len(bright):
            break
        level = (dark.mean() + bright.mean()) / 2
    return float(level)
