"""Pictures for the page: slices below each other in one JPEG, deformed grids as SVG paths, curves as SVG."""

import base64
import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.report.drawing import INK, Scale, moved_lines
from torchdeform.report.planes import Plane
from torchdeform.report.report_data import Slices

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARGIN = 4  # rows repeated above and below a slice, so that smoothing in a browser does not mix neighbours
_FEWEST = 160  # pixels of the longer side of a slice at least: in fewer the blocks of a JPEG are visible
_STOPS = 16  # colours of a bar
UNITS = 4  # SVG units per pixel

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """Size of the slices of a plane in square pixels, and their number."""

    down: int
    across: int
    slices: int

    @property
    def pitch(self) -> int:
        """Rows from one slice to the next."""
        return self.down + 2 * _MARGIN

    @property
    def positions(self) -> list[float]:
        """The vertical object-position of each slice for CSS, in percent."""
        room = self.slices * self.pitch - self.down
        return [round(100 * (k * self.pitch + _MARGIN) / room, 4) for k in range(self.slices)]


def frame_of(plane: Plane, slices: int, largest: int) -> Frame:
    """Return the frame of a plane whose longer side has at most ``largest`` pixels."""
    extent = [n * plane.grid.spacing[axis] for n, axis in zip(plane.shape, plane.axes, strict=True)]
    finest = min(plane.grid.spacing[axis] for axis in plane.axes)
    pixels = min(max(max(extent) / finest, _FEWEST), largest)
    down, across = (max(8, round(side / max(extent) * pixels)) for side in extent)
    return Frame(down, across, slices)


def grey_levels(values: Tensor) -> Bytes:
    """Return slices ``(n, 1 or 3, h, w)`` from 0 to 1 as bytes ``(n, h, w, 1 or 3)``."""
    return values.mul(255).round().byte().movedim(1, -1).numpy()


def colours(values: Tensor, scale: Scale) -> Bytes:
    """Return slices ``(n, 1, h, w)`` in the colours of a scale ``(n, h, w, 3)``."""
    place = values[:, 0].sub(scale.low).mul(255 / (scale.high - scale.low)).nan_to_num(0.0).clamp(0, 255)
    return _table(scale)[place.round().byte().numpy()]


def css_stops(scale: Scale) -> str:
    """Return a scale's colours as the stops of a CSS gradient."""
    chosen = _table(scale)[np.linspace(0, 255, _STOPS).round().astype(int)]
    return ", ".join(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in chosen)


def _table(scale: Scale) -> Bytes:
    from matplotlib import colormaps

    return (colormaps[scale.colours](np.arange(256))[:, :3] * 255).round().astype(np.uint8)


def image_strip(pixels: Bytes, plane: Plane, frame: Frame, quality: int) -> str:
    """Return slices ``(n, h, w, 1 or 3)`` below each other, in the usual view, as a JPEG in a data URI."""
    from PIL import Image as Picture

    shown = pixels[:, :: -1 if plane.flipped[0] else 1, :: -1 if plane.flipped[1] else 1]
    rows = [np.asarray(_resized(flat.squeeze(-1) if flat.shape[-1] == 1 else flat, frame)) for flat in shown]
    padding = ((_MARGIN, _MARGIN), (0, 0), (0, 0))
    sheet = np.concatenate([np.pad(row, padding[: row.ndim], mode="edge") for row in rows])
    file = io.BytesIO()
    Picture.fromarray(sheet).save(file, "JPEG", quality=quality, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def _resized(flat: Bytes, frame: Frame) -> Bytes:
    from PIL import Image as Picture

    picture = Picture.fromarray(np.ascontiguousarray(flat))
    size = (frame.across, frame.down)
    return np.asarray(picture if picture.size == size else picture.resize(size, Picture.Resampling.BILINEAR))


def grid_paths(cuts: Slices, frame: Frame, count: int) -> list[str]:
    """Return the deformed grid of every slice as the d of an SVG path, with `UNITS` units per pixel of the frame."""
    return [_path(moved_lines(cuts.plane, u, count), cuts.plane, frame) for u in cuts.fields["u"]]


def _path(lines: Sequence[NDArray[np.floating]], plane: Plane, frame: Frame) -> str:
    down, across = plane.shape
    size = np.array((UNITS * frame.across / across, UNITS * frame.down / down))
    parts = []
    for line in lines:
        shown = np.where(plane.flipped[::-1], np.array((across, down)) - 1 - line, line)
        steps = _thinned(((shown + 0.5) * size).round().astype(int))
        parts.append("M" + "l".join(f"{x} {y}" for x, y in steps.tolist()))
    return "".join(parts).replace(" -", "-")


def _thinned(points: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the first point and the steps between points, about one per two pixels."""
    length = np.abs(np.diff(points, axis=0)).max(1).sum() if len(points) > 1 else 0
    every = max(1, round(2 * UNITS * len(points) / max(length, 1)))
    kept = points[np.unique(np.append(np.arange(0, len(points), every), len(points) - 1))]
    return np.concatenate((kept[:1], np.diff(kept, axis=0)))


def curve(name: str, draw: Callable[["Axes"], None], width: float, height: float) -> str:
    """Return what a function draws on axes as an SVG element in the colour of the surrounding text.

    Args:
        name: of the picture; the names inside the SVG are derived from it.
        draw: draws on the axes.
        width: in inches, for the size of the text.
        height: in inches.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure = Figure((width, height), layout="tight", facecolor="none")
        axes = figure.add_subplot(facecolor="none")
        draw(axes)
        for spine in axes.spines.values():
            spine.set_color(INK)
        file = io.StringIO()
        FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None})
    return _for_page(file.getvalue())


def _for_page(svg: str) -> str:
    """Return an SVG without what a page cannot use: the prologue, metadata, global styles, fixed sizes and colours."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'<svg [^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" aria-hidden="true">', svg, count=1)
    svg = re.sub(r'<g id="[^"]*"', "<g", svg).replace("xlink:href", "href")
    svg = re.sub(r"font: ([0-9.]+)px [^;\"]*|font-family: [^;\"]*;? ?", _font_size, svg)
    return svg.replace(INK, "currentColor").replace("#000000", "currentColor")


def _font_size(found: re.Match[str]) -> str:
    return f"font-size: {found[1]}px" if found[1] else ""
