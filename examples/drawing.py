"""Pictures of moved grids, as the paper draws them."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from torch import Tensor

INK, PAPER = "#0b5fa5", "#ffffff"


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size in inches."""
    return Figure((width, height), dpi=110, layout="constrained", facecolor=PAPER)


def save(figure: Figure, path: Path) -> None:
    """Write the figure as a PNG."""
    FigureCanvasAgg(figure).print_png(str(path))


def draw_plane(axes: Axes, points: Tensor, title: str) -> None:
    """Draw the lines of a grid through the points ``(1, 2, n0, n1)``, axis 0 downwards."""
    lines = points[0].flip(0).movedim(0, -1).numpy()  # (x, y) is (axis 1, axis 0)
    axes.add_collection(LineCollection([*lines, *lines.swapaxes(0, 1)], colors=INK, linewidths=0.5))
    axes.set_xlim(lines[..., 0].min(), lines[..., 0].max())
    axes.set_ylim(lines[..., 1].max(), lines[..., 1].min())
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


def draw_cutaway(axes: Axes3D, points: Tensor, title: str) -> None:
    """Draw the faces of a box of points ``(1, 3, n0, n1, n2)`` with the octant that faces the viewer cut out."""
    nodes = points[0].movedim(0, -1).numpy()
    faces = np.concatenate([quads for axis in range(3) for quads in _visible(nodes, axis)])
    axes.add_collection3d(Poly3DCollection(faces, facecolors=PAPER, edgecolors=INK, linewidths=0.25))
    low, high = nodes.reshape(-1, 3).min(0), nodes.reshape(-1, 3).max(0)
    for limit, a, b in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low, high, strict=True):
        limit(a, b)
    axes.set_box_aspect(high - low)
    axes.view_init(elev=30, azim=40)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


def _visible(nodes: np.ndarray, axis: int) -> list[np.ndarray]:
    """Return the quadrangles seen along an axis: the last face without its quarter, and that quarter inside the box."""
    turned = np.moveaxis(nodes, axis, 0)
    middle = [n // 2 for n in turned.shape[:3]]
    inside, outside = _quads(turned[middle[0]]), _quads(turned[-1])
    quarter = np.zeros(outside.shape[:2], dtype=bool)
    quarter[middle[1] :, middle[2] :] = True
    return [outside[~quarter], inside[quarter]]


def _quads(face: np.ndarray) -> np.ndarray:
    """Return the corners of the cells of a face ``(m, n, 3)`` in order around each, ``(m − 1, n − 1, 4, 3)``."""
    return np.stack([face[:-1, :-1], face[:-1, 1:], face[1:, 1:], face[1:, :-1]], axis=2)
