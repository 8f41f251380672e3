"""Pictures of deformed grids as in the paper: lines in 2D; in 3D the faces of a box with one octant cut out."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.report import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

_LINES = {2: 64, 3: 40}  # lines that are drawn along an axis at most
_PANEL = {2: 4.0, 3: 4.6}  # inches

Nodes = NDArray[np.floating]


def write_grids(path: Path, grids: Mapping[str, Tensor], picture: Tensor | None = None) -> None:
    """Draw deformed grids side by side as a PNG, in 2D with the image that they belong to on the left.

    Args:
        path: the file to write.
        grids: positions of the nodes by title, ``(1, D, *S)`` in units of spacing, array order.
        picture: grey values ``(1, 1, *S)`` or colours ``(1, 3, *S)`` from 0 to 1, on the original grid; 2D.
    """
    dim = next(iter(grids.values())).shape[1]
    panels = len(grids) + (picture is not None)
    figure = drawing.new_figure(panels * _PANEL[dim], _PANEL[dim], constrained=True)
    if picture is not None:
        axes = figure.add_subplot(1, panels, 1)
        draw_picture(axes, picture, next(iter(grids.values())), "image")
    for place, (title, points) in enumerate(grids.items(), start=1 + panels - len(grids)):
        axes: Any = figure.add_subplot(1, panels, place, projection="3d" if dim == 3 else None)
        (draw_cutaway if dim == 3 else draw_plane)(axes, points, title)
    _share_limits(figure)
    drawing.save_png(figure, path)


def draw_picture(axes: "Axes", picture: Tensor, points: Tensor, title: str) -> None:
    """Draw grey values or colours ``(1, C, *S)`` from 0 to 1 over the box of a grid ``(1, 2, *S)``."""
    down, across = (float(p.max()) for p in points[0])
    pixels = picture[0].movedim(0, -1).numpy()
    axes.imshow(pixels, extent=(0, across, down, 0), cmap="gray", vmin=0, vmax=1)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


def draw_plane(axes: "Axes", points: Tensor, title: str) -> None:
    """Draw the lines of a grid through the points ``(1, 2, n0, n1)``, axis 0 downwards.

    Raises:
        InputError: points that are not ``(1, 2, n0, n1)``.
    """
    from matplotlib.collections import LineCollection

    nodes = _nodes(points, 2)[..., ::-1]  # (x, y) is (axis 1, axis 0)
    down, across = (_some(n, _LINES[2]) for n in nodes.shape[:2])
    lines = [*nodes[down], *nodes[:, across].swapaxes(0, 1)]
    axes.add_collection(LineCollection(lines, colors=drawing.LINES, linewidths=0.5))
    axes.set_xlim(nodes[..., 0].min(), nodes[..., 0].max())
    axes.set_ylim(nodes[..., 1].max(), nodes[..., 1].min())
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


def draw_cutaway(axes: "Axes3D", points: Tensor, title: str) -> None:
    """Draw the faces of a box of points ``(1, 3, n0, n1, n2)`` without the octant in front of the viewer.

    Raises:
        InputError: points that are not ``(1, 3, n0, n1, n2)``.
    """
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    nodes = _nodes(points, 3)[..., ::-1]  # x, y, z: array axis 0 upwards
    nodes = nodes[np.ix_(*(_some(n, _LINES[3]) for n in nodes.shape[:3]))]
    faces = np.concatenate([quads for axis in range(3) for quads in _visible(nodes, axis)])
    axes.add_collection3d(Poly3DCollection(faces, facecolors=drawing.PAPER, edgecolors=drawing.LINES, linewidths=0.25))
    low, high = nodes.reshape(-1, 3).min(0), nodes.reshape(-1, 3).max(0)
    for limit, a, b in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low, high, strict=True):
        limit(a, b)
    axes.set_box_aspect(high - low)
    axes.view_init(elev=30, azim=40)
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)


def _share_limits(figure: "Figure") -> None:
    """Draw all 2D panels on one scale, so that a stretched grid looks stretched."""
    planes = [axes for axes in figure.axes if axes.name != "3d"]
    for name in ("xlim", "ylim") if planes else ():
        starts, stops = zip(*(getattr(axes, f"get_{name}")() for axes in planes), strict=True)
        first, last = (min, max) if starts[0] < stops[0] else (max, min)
        for axes in planes:
            getattr(axes, f"set_{name}")(first(starts), last(stops))


def _nodes(points: Tensor, dim: int) -> Nodes:
    """Return points ``(1, D, *S)`` as an array ``(*S, D)``."""
    if points.dim() != dim + 2 or tuple(points.shape[:2]) != (1, dim):
        raise InputError(f"a grid is drawn from points (1, {dim}, {dim} axes), got {tuple(points.shape)}")
    return points[0].detach().cpu().movedim(0, -1).numpy()


def _some(n: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` of 0 .. n − 1, with the first and the last."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(np.int64))


def _visible(nodes: Nodes, axis: int) -> list[Nodes]:
    """Return the cells seen along an axis: the last face without one quarter, and that quarter inside the box."""
    layers = np.moveaxis(nodes, axis, 0)
    middle = [n // 2 for n in layers.shape[:3]]
    inside, outside = _quads(layers[middle[0]]), _quads(layers[-1])
    quarter = np.zeros(outside.shape[:2], dtype=bool)
    quarter[middle[1] :, middle[2] :] = True
    return [outside[~quarter], inside[quarter]]


def _quads(face: Nodes) -> Nodes:
    """Return the corners of the cells of a face ``(m, n, 3)``, in order around each cell, ``(m − 1, n − 1, 4, 3)``."""
    ends = {0: slice(None, -1), 1: slice(1, None)}
    around = sorted(product((0, 1), repeat=2), key=lambda corner: (corner[0], corner[0] ^ corner[1]))
    return np.stack([face[ends[a], ends[b]] for a, b in around], axis=2)
