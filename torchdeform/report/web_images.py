"""Pictures for the page: slices below each other in one JPEG, deformed grids as SVG paths, curves as SVG."""

import base64
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.report.drawing import INK, Scale
from torchdeform.report.planes import Plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARGIN = 4  # rows repeated above and below a slice, so that smoothing in a browser does not mix neighbours; even
_FEWEST = 160  # pixels of the longer side of a slice at least: in fewer the blocks of a JPEG are visible
_STOPS = 16  # colours of a bar
_FLAT = 0.5  # SVG units that a point is off the line between its neighbours where this counts as straight
_STRAIGHT = 5
_CURVE = (0.11, 0.19, 0.87, 0.77)  # where the axes of a curve are in its figure
UNITS = 4  # SVG units per pixel

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """Size of the slices of a plane in square pixels, and their number."""

    down: int
    across: int
    slices: int
    margin: int = _MARGIN

    @property
    def pitch(self) -> int:
        """Rows from one slice to the next."""
        return self.down + 2 * self.margin

    @property
    def half(self) -> "Frame":
        """The frame with half as many pixels down and across: its slices are at the same positions."""
        return Frame(self.down // 2, self.across // 2, self.slices, self.margin // 2)

    @property
    def positions(self) -> list[float]:
        """The vertical object-position of each slice for CSS, in percent."""
        room = self.slices * self.pitch - self.down
        return [round(100 * (k * self.pitch + self.margin) / room, 4) for k in range(self.slices)]


def frame_of(plane: Plane, slices: int, largest: int) -> Frame:
    """Return the frame of a plane whose longer side has at most ``largest`` pixels."""
    extent = [n * plane.grid.spacing[axis] for n, axis in zip(plane.shape, plane.axes, strict=True)]
    finest = min(plane.grid.spacing[axis] for axis in plane.axes)
    pixels = min(max(max(extent) / finest, _FEWEST), largest)
    down, across = (2 * max(4, round(side / max(extent) * pixels / 2)) for side in extent)
    return Frame(down, across, slices)


def grey_levels(values: Tensor) -> Bytes:
    """Return slices ``(n, 1 or 3, h, w)`` from 0 to 1 as bytes ``(n, h, w, 1 or 3)``."""
    return values.mul(255).round().byte().movedim(1, -1).numpy()


def colours(values: Tensor, scale: Scale) -> Bytes:
    """Return slices ``(n, 1, h, w)`` in the colours of a scale ``(n, h, w, 3)``."""
    place = values[:, 0].sub(scale.low).mul(255 / (scale.high - scale.low)).nan_to_num(0.0).clamp(0, 255)
    return _table(scale)[place.round().byte().numpy()]


@dataclass(frozen=True)
class Bar:
    """A colour bar for CSS: the stops of a gradient, and ticks with their place in percent."""

    stops: str
    ticks: tuple[Mapping[str, object], ...]


def bar_of(scale: Scale) -> Bar:
    """Return the colour bar of a scale."""
    width = scale.high - scale.low
    ticks = ({"place": round(100 * (value - scale.low) / width, 2), "text": text} for value, text in scale.ticks)
    return Bar(_css_stops(scale), tuple(ticks))


def _css_stops(scale: Scale) -> str:
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
    first, last = frame.margin, frame.margin + frame.down
    sheet = np.empty((len(shown), frame.pitch, frame.across, *([3] if shown.shape[-1] == 3 else [])), np.uint8)
    for rows, flat in zip(sheet, shown, strict=True):
        rows[first:last] = _resized(flat.squeeze(-1) if flat.shape[-1] == 1 else flat, frame)
        rows[:first], rows[last:] = rows[first], rows[last - 1]
    sheet = sheet.reshape(-1, *sheet.shape[2:])
    file = io.BytesIO()
    Picture.fromarray(sheet).save(file, "JPEG", quality=quality, optimize=True)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def _resized(flat: Bytes, frame: Frame) -> Bytes:
    from PIL import Image as Picture

    picture = Picture.fromarray(np.ascontiguousarray(flat))
    size = (frame.across, frame.down)
    return np.asarray(picture if picture.size == size else picture.resize(size, Picture.Resampling.BILINEAR))


def svg_paths(slices: Sequence[Sequence[NDArray[np.floating]]], plane: Plane, frame: Frame) -> list[str]:
    """Return the lines of every slice as the d of an SVG path, with `UNITS` units per pixel of the frame.

    Args:
        slices: of each slice the lines, each ``(m, 2)`` as (across, down) in nodes, m at least 2.
        plane: the plane.
        frame: its frame.

    Notes:
        Points are left out where lines are straight or nodes denser than pixels.
    """
    lines = [line for some in slices for line in some]
    if not lines:
        return ["" for _ in slices]
    down, across = plane.shape
    size = np.array((UNITS * frame.across / across, UNITS * frame.down / down))
    counts, points = np.array([len(line) for line in lines]), np.concatenate(lines)
    shown = (np.where(plane.flipped[::-1], np.array((across, down)) - 1 - points, points) + 0.5) * size
    kept = _kept(shown, counts, max(1, round(2 * UNITS / float(size.min()))))
    steps = shown[kept].round().astype(np.int64)
    stops = np.cumsum(np.add.reduceat(kept, np.cumsum(counts) - counts)).tolist()
    starts = [0, *stops[:-1]]
    firsts = _pairs(steps[starts])
    steps[1:] -= steps[:-1].copy()
    pairs = _pairs(steps)
    texts = iter(
        f"M{first}l" + " ".join(pairs[start + 1 : stop])
        for first, start, stop in zip(firsts, starts, stops, strict=True)
    )
    return ["".join(next(texts) for _ in some).replace(" -", "-") for some in slices]


def _pairs(points: NDArray[np.int64]) -> list[str]:
    return [f"{x} {y}" for x, y in zip(points[:, 0].tolist(), points[:, 1].tolist(), strict=True)]


def _kept(points: NDArray[np.floating], counts: NDArray[np.int64], every: int) -> NDArray[np.bool_]:
    """Return which points of lines one after another are kept.

    These are the first and the last of each, one of so many, of these again one of `_STRAIGHT` where they are on a
    straight line.
    """
    ends = np.cumsum(counts)
    place = np.arange(ends[-1]) - np.repeat(ends - counts, counts)
    before, after = (np.roll(points, shift, axis=0) for shift in (every, -every))
    off = np.abs(points - (before + after) / 2).max(1) > _FLAT
    kept = (place % every == 0) & (off | (place % (_STRAIGHT * every) == 0))
    kept[ends - 1] = True
    return kept


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
        figure = Figure((width, height), facecolor="none")
        axes = figure.add_axes(_CURVE, facecolor="none")
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
