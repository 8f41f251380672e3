"""Images side by side: one row of panels, the middle planes of each below its title."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from torchdeform.image import Image, luminance
from torchdeform.report.drawing import INK, PAPER, draw_image
from torchdeform.report.planes import planes_of

_INCHES = {2: 3.2, 3: 2.2}  # width of a panel
_PERCENTILES = (0.005, 0.995)


def write_gallery(path: Path, images: Mapping[str, Image]) -> None:
    """Draw images side by side as a PNG, each by its own grey values; in 3D their three middle planes.

    Args:
        path: the file to write.
        images: by title, all of one dimension.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    sheet = [planes_of(image) for image in images.values()]
    width = _INCHES[next(iter(images.values())).grid.dim]
    heights = [width * max(plane.height_over_width for plane in row) for row in zip(*sheet, strict=True)]
    size = (width * len(images), sum(heights) + 0.3)
    figure = Figure(size, dpi=110, layout="constrained", facecolor=PAPER)
    cells = figure.subplots(len(heights), len(images), squeeze=False, height_ratios=heights)
    for column, ((title, image), planes) in enumerate(zip(images.items(), sheet, strict=True)):
        grey = _grey(image)
        for row, plane in enumerate(planes):
            draw_image(cells[row, column], plane, plane.cut(grey.data, [plane.middle])[0])
        cells[0, column].set_title(title, fontsize=10, color=INK)
    FigureCanvasAgg(figure).print_png(str(path))


def _grey(image: Image) -> Image:
    """Return an image as grey values from 0 to 1."""
    grey = luminance(image).data.float().cpu()
    values = grey.flatten().sort().values
    low, high = (values[round(share * (len(values) - 1))] for share in _PERCENTILES)
    return replace(image, data=((grey - low) / (high - low).clamp(min=1e-12)).clamp(0, 1))
