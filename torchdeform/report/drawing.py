"""Drawing on matplotlib axes: slices of images, maps with their scales, deformed grids, curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.registration.result import RegistrationResult
from torchdeform.report.planes import Plane

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

INK, PAPER, LINES, FRAME = "#222222", "#ffffff", "#0b5fa5", "#bbbbbb"
# Blue and orange, distinct with any colour blindness; their sum is white.
BLUE, ORANGE = (0.0, 0.45, 1.0), (1.0, 0.55, 0.0)
# The colours of Okabe and Ito, distinct with any colour blindness; for lines on a light or a dark page.
CURVES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_LARGEST = 1000  # pixels along a side that a panel can show

Floats = NDArray[np.floating]


def new_figure(width: float, height: float, *, constrained: bool = False) -> "Figure":
    """Return an empty figure of this size in inches; matplotlib places the panels if it is ``constrained``."""
    from matplotlib.figure import Figure

    return Figure((width, height), dpi=110, layout="constrained" if constrained else None, facecolor=PAPER)


def save_png(figure: "Figure", path: Path) -> None:
    """Write a figure as a PNG, without any window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure).print_png(str(path), pil_kwargs={"compress_level": 3})  # twice as fast as 6


@dataclass(frozen=True)
class Scale:
    """How values become colours: a colour map of matplotlib, its ends, and the labels of its ticks."""

    colours: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]


def signed_scale(limit: float) -> Scale:
    """Return a scale around 0, purple below and orange above."""
    return Scale("PuOr_r", -limit, limit, tuple((v, f"{v:.2g}") for v in (-limit, 0.0, limit)))


def length_scale(limit: float, colours: str = "viridis") -> Scale:
    """Return a scale from 0 up."""
    return Scale(colours, 0.0, limit, tuple((v, f"{v:.2g}") for v in (0.0, limit)))


def difference_scale(limit: float) -> Scale:
    """Return the scale of the differences before and after."""
    return length_scale(limit, "inferno")


def volume_scale(limit: float) -> Scale:
    """Return the scale of log J, with ticks at powers of 2 of J."""
    top = int(limit / math.log(2) + 1e-6)
    ticks = tuple((k * math.log(2), f"{2.0**k:g}") for k in sorted({-top, 0, top}))
    return Scale("PuOr_r", -limit, limit, ticks)


def rotation_scale(limit: float, dim: int) -> Scale:
    """Return the scale of the curl: signed in 2D, its length in 3D."""
    return signed_scale(limit) if dim == 2 else length_scale(limit)


def show(axes: "Axes", plane: Plane, pixels: Tensor, **how: Any) -> "AxesImage":
    """Show a slice ``(C, down, across)`` in node coordinates: pixel (i, j) spans i ± 1/2, j ± 1/2."""
    down, across = plane.shape
    step = 1 + max(pixels.shape[1:]) // _LARGEST  # more pixels than a screen shows would only cost time
    thin = pixels[:, ::step, ::step].movedim(0, -1).float().numpy()
    shown = axes.imshow(
        thin if thin.shape[-1] == 3 else thin[..., 0],
        extent=(-0.5, across - 0.5, down - 0.5, -0.5),
        aspect=plane.aspect,
        **how,
    )
    frame(axes, plane)
    return shown


def frame(axes: "Axes", plane: Plane) -> None:
    """Frame a slice and flip it to the usual view."""
    down, across = plane.shape
    xlim, ylim = (-0.5, across - 0.5), (down - 0.5, -0.5)
    axes.set_xlim(*(xlim[::-1] if plane.flipped[1] else xlim))
    axes.set_ylim(*(ylim[::-1] if plane.flipped[0] else ylim))
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FRAME)


def draw_image(axes: "Axes", plane: Plane, pixels: Tensor) -> "AxesImage":
    """Show grey values or colours from 0 to 1."""
    return show(axes, plane, pixels, cmap="gray", vmin=0, vmax=1)


def draw_map(axes: "Axes", plane: Plane, values: Tensor, scale: Scale) -> "AxesImage":
    """Show values in the colours of their scale."""
    return show(axes, plane, values, cmap=scale.colours, vmin=scale.low, vmax=scale.high)


def draw_bar(place: "Axes", shown: "AxesImage", scale: Scale) -> None:
    """Draw the colour bar of a map in axes of their own."""
    colours = place.figure.colorbar(shown, cax=place, orientation="horizontal")
    colours.set_ticks([value for value, _ in scale.ticks], labels=[text for _, text in scale.ticks])
    colours.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    place.tick_params(labelsize=8, colors=INK, length=2, pad=1)


def draw_lines_over(axes: "Axes", lines: Sequence[Floats], colour: str, *, hatched: bool = False) -> None:
    """Draw lines (across, down) in nodes over a slice, or hatch what is inside them."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    if not lines:
        return
    if hatched:
        inside = Outline.make_compound_path(*(Outline(line, closed=True) for line in lines))
        axes.add_patch(PathPatch(inside, facecolor="none", edgecolor=colour, linewidth=0.5, hatch="/////"))
    else:
        axes.add_collection(LineCollection(lines, colors=colour, linewidths=0.8), autolim=False)


def draw_letters(axes: "Axes", plane: Plane) -> None:
    """Write at the sides of a slice which sides of the body they are."""
    places = ((0.02, 0.5, "left", "center"), (0.98, 0.5, "right", "center"), (0.5, 0.98, "center", "top"))
    for letter, (x, y, ha, va) in zip(plane.letters, (*places, (0.5, 0.02, "center", "bottom")), strict=False):
        text = axes.text(x, y, letter, transform=axes.transAxes, ha=ha, va=va, fontsize=8, color=PAPER, weight="bold")
        text.set_bbox({"facecolor": INK, "alpha": 0.5, "pad": 1, "linewidth": 0})


def moved_lines(plane: Plane, u: Tensor, count: int) -> list[Floats]:
    """Return where φ moves the lines of a regular grid in a slice, each ``(m, 2)`` as (across, down) in nodes.

    Args:
        plane: the plane.
        u: displacement in the slice ``(D, down, across)``, units of spacing.
        count: about how many lines along the longer side.
    """
    at = np.stack(np.meshgrid(*map(np.arange, plane.shape), indexing="ij")).astype(np.float32)
    for position, axis in enumerate(plane.axes):
        at[position] += (u[axis] / plane.grid.spacing[axis]).float().numpy()
    points = np.stack((at[1], at[0]), axis=-1)
    size = max(side * plane.grid.spacing[axis] for side, axis in zip(plane.shape, plane.axes, strict=True)) / count
    down, across = (
        _every(n, max(1, round(size / plane.grid.spacing[axis])))
        for n, axis in zip(plane.shape, plane.axes, strict=True)
    )
    return [*points[down], *points[:, across].swapaxes(0, 1)]


def _every(n: int, step: int) -> NDArray[np.int64]:
    """Return nodes at regular steps, centred in 0 .. n − 1."""
    return np.arange((n - 1) % step // 2, n, step)


def draw_lines(axes: "Axes", plane: Plane, u: Tensor, count: int) -> None:
    """Draw where φ moves the lines of a regular grid."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(moved_lines(plane, u, count), colors=LINES, linewidths=0.7))
    frame(axes, plane)


def draw_faint(axes: "Axes", plane: Plane, pixels: Tensor) -> "AxesImage":
    """Show an image as a pale background for lines."""
    return show(axes, plane, pixels.mean(0, keepdim=True), cmap="gray_r", vmin=0, vmax=3)


def draw_convergence(axes: "Axes", result: RegistrationResult, *, item: int = 0) -> None:
    """Draw the similarity over the steps, one line per level."""
    start = 0
    for level, colour in zip(result.levels, cycle(CURVES), strict=False):
        values = [value[item].item() for value in level.similarity]
        size = "×".join(map(str, level.shape[::-1]))
        marker = "o-" if len(values) == 1 else "-"  # a single point makes no line
        axes.plot(range(start, start + len(values)), values, marker, label=size, linewidth=1.6, color=colour)
        start += max(len(values) - 1, 0)
    _name_axes(axes, "step", result.settings.maximised)
    if result.levels:
        axes.legend(fontsize=8, frameon=False, loc="best")


def draw_volumes(axes: "Axes", counts: Tensor, limit: float, words: Mapping[str, str]) -> None:
    """Draw a histogram of log J between −limit and limit, written as J, in the colours of the map; see `WORDS`."""
    from matplotlib import colormaps

    share = 100 * counts.numpy() / max(float(counts.sum()), 1.0)
    edges = np.linspace(-limit, limit, len(share) + 1)
    scale, middles = volume_scale(limit), (edges[1:] + edges[:-1]) / 2
    colours = colormaps[scale.colours]((middles + limit) / (2 * limit))
    axes.bar(middles, share, width=np.diff(edges), color=colours, edgecolor="#888888", linewidth=0.4)
    axes.axvline(0, color=INK, linewidth=0.8, linestyle=":")
    axes.set_xlim(-limit, limit)
    axes.set_xticks([value for value, _ in scale.ticks], labels=[text for _, text in scale.ticks])
    _name_axes(axes, f"{words['volume']}: moving / fixed", f"% of {words['voxel']}s")


def _name_axes(axes: "Axes", across: str, down: str) -> None:
    axes.set_xlabel(across, fontsize=9, color=INK)
    axes.set_ylabel(down, fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.spines[["top", "right"]].set_visible(False)


def tinted(first: Floats, second: Floats) -> Floats:
    """Return grey values ``(h, w)`` of two images as one picture: blue, orange, white where both are bright."""
    return np.clip(first[..., None] * np.array(BLUE) + second[..., None] * np.array(ORANGE), 0, 1)
