"""An overlay of two images where they lie in the world, before anything is registered."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.image import Image
from torchdeform.report.drawing import INK, PAPER, frame, tinted
from torchdeform.report.planes import Plane, planes_of
from torchdeform.report.scene import to_unit
from torchdeform.warp import sample

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_OUTLINES = ("#0b5fa5", "#b34700")
_PANEL_INCHES = 3.0
_PIXELS = 400  # along the longer side of a picture
_FARTHEST = 3.0  # the picture is at most so many times as wide as the fixed image


@dataclass(frozen=True)
class _Cut:
    """A plane of the canvas: grey values from 0 to 1 of both images ``(h, w)``, and where each of them is."""

    plane: Plane
    values: tuple[NDArray[np.float32], NDArray[np.float32]]
    inside: tuple[NDArray[np.bool_], NDArray[np.bool_]]


def write_overlay(path: Path, fixed: Image, moving: Image) -> None:
    """Draw both images and their overlay as a PNG: fixed in blue, moving in orange, white where both are bright.

    Args:
        path: the file to write.
        fixed: fixed image; the planes are its middle ones, three in 3D.
        moving: moving image of the same dimension, in its own place.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cuts = _cuts(fixed, moving)
    heights = [_PANEL_INCHES * min(2.0, max(0.4, cut.plane.height_over_width)) for cut in cuts]
    size = (3 * _PANEL_INCHES, sum(heights) + 0.3 * len(cuts) + 0.5)
    figure = Figure(size, dpi=110, layout="constrained", facecolor=PAPER)
    cells = figure.subplots(len(cuts), 3, squeeze=False, height_ratios=heights)
    for row, cut in zip(cells, cuts, strict=True):
        _draw_row(row, cut, titled=cut is cuts[0])
    figure.suptitle("fixed in blue, moving in orange, frames where they end", fontsize=11, color=INK)
    FigureCanvasAgg(figure).print_png(str(path))


def _draw_row(row: "Sequence[Axes]", cut: _Cut, *, titled: bool) -> None:
    pictures = {"fixed": cut.values[0], "moving": cut.values[1], "overlay": tinted(*cut.values)}
    for axes, (title, picture) in zip(row, pictures.items(), strict=True):
        axes.imshow(picture, cmap="gray", vmin=0, vmax=1, aspect=cut.plane.aspect)
        for inside, colour in zip(cut.inside, _OUTLINES, strict=True):
            if inside.any() and not inside.all():
                axes.contour(inside.astype(np.float32), levels=[0.5], colors=[colour], linewidths=0.9)
        frame(axes, cut.plane)
        axes.set_title(title if titled else "", fontsize=10, color=INK)


def _cuts(fixed: Image, moving: Image) -> list[_Cut]:
    canvas = _canvas(fixed, moving)
    return [_cut(plane, canvas, (fixed, moving)) for plane in planes_of(canvas)]


def _canvas(fixed: Image, moving: Image) -> Image:
    """Return an empty image along the fixed one's axes, its middle there, that holds both (unless one is far off)."""
    corners = fixed.to_grid(moving.to_world(_corners(moving.grid)))[0]
    middle, width = [side / 2 for side in fixed.grid.extent], []
    for k, side in enumerate(fixed.grid.extent):
        reach = max(float((corners[k] - middle[k]).abs().max()), side / 2)
        width.append(2 * min(reach, _FARTHEST * side / 2) * 1.02)
    pixel = max(width) / _PIXELS
    shape = tuple(max(2, round(w / pixel) + 1) for w in width)
    grid = Grid(shape, tuple(w / (n - 1) for w, n in zip(width, shape, strict=True)))
    first = torch.tensor([m - w / 2 for m, w in zip(middle, width, strict=True)], dtype=torch.float64)
    origin = fixed.to_world(first.view(1, -1, 1))[0, :, 0].tolist()
    return replace(fixed, data=torch.zeros(()).expand(1, 1, *shape), grid=grid, origin=tuple(origin))


def _corners(grid: Grid) -> Tensor:
    return torch.tensor(list(product(*((0.0, side) for side in grid.extent))), dtype=torch.float64).T.unsqueeze(0)


def _cut(plane: Plane, canvas: Image, images: tuple[Image, Image]) -> _Cut:
    """Sample both images in one plane of the canvas; only its points are made."""
    world = canvas.to_world(plane.points([plane.middle]))
    found = [_values(image, world, plane) for image in images]
    return _Cut(plane, (found[0][0], found[1][0]), (found[0][1], found[1][1]))


def _values(image: Image, world: Tensor, plane: Plane) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    data = image.data.detach().cpu()
    grey = to_unit(data[:, :3], data).mean(1, keepdim=True).float()
    points = image.to_grid(world)
    flat = plane.arrange(sample(grey, points, image.grid, outside=torch.nan))[0, 0].numpy()
    return np.nan_to_num(flat), ~np.isnan(flat)
