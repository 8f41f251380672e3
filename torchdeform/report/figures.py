"""Pictures as files: the overview of a registration, images side by side, two images over each other."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, box_corners
from torchdeform.core.warp import sample
from torchdeform.metrics.similarity import measure_name
from torchdeform.report.drawing import (
    difference_scale,
    draw_bar,
    draw_convergence,
    draw_faint,
    draw_image,
    draw_letters,
    draw_lines,
    draw_lines_over,
    draw_map,
    frame,
    save_png,
    tinted,
    volume_scale,
)
from torchdeform.report.marks import ABSENT, LANDMARKS, NO_DATA, OUTLINES, REGIONS, TISSUE
from torchdeform.report.planes import WORDS, Plane, planes_of
from torchdeform.report.report_data import ReportData, Slices
from torchdeform.report.sampling import FIXED, MOVING, WARPED, grey, to_unit
from torchdeform.report.sheet import GAP, TITLE, Sheet, letters_in, shortened, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from torchdeform.registration.result import RegistrationResult

_SHEET = {2: (2, 4), 3: (3, 7)}  # rows and columns of panels
_PANEL_INCHES = {2: 3.2, 3: 2.3}
_GRID_LINES = {2: 36, 3: 24}
_GALLERY_INCHES = {2: 3.2, 3: 2.2}
_OUTLINES = ("#0b5fa5", "#b34700")
_LEAST_CURVE = 1.0  # height of the convergence in inches
_OVERLAY_INCHES = 3.0
_OVERLAY = "fixed in blue, moving in orange, frames at their borders"
_PIXELS = 400  # along the longer side of an overlay
_FARTHEST = 3.0  # width of an overlay at most, in widths of the fixed image

Draw = Callable[["Axes", ReportData, Slices], "AxesImage"]


def write_overview(path: Path, data: ReportData) -> None:
    """Draw a registration as a PNG: images, differences, the deformed grid and log J; in 3D three middle planes.

    Args:
        path: the file to write.
        data: what `make_report_data` returns.
    """
    dim = data.result.grid.dim
    rows, columns = _SHEET[dim]
    width, shapes = _PANEL_INCHES[dim], [cuts.plane.height_over_width for cuts in data.slices]
    heights = [width * min(2.0, shape) for shape in shapes] * (rows // len(shapes))
    if dim == 2:
        heights[-1] = max(heights[-1], _LEAST_CURVE)
    room = [TITLE] * rows if dim == 2 else [TITLE, *[GAP] * (rows - 1)]
    sheet = Sheet(width, columns, heights, room, headlines=_headlines(data, letters_in(width, columns)), bottom=0.5)
    cells = chain(*sheet.panels)
    scale = volume_scale(data.limits["log_det"])
    for cuts, (name, draw) in product(data.slices, _PANELS.items()):
        axes = next(cells)
        shown = draw(axes, data, cuts)
        axes.set_anchor("N")
        if axes is sheet.panels[data.slices.index(cuts)][0]:
            draw_letters(axes, cuts.plane)
        if cuts is data.slices[0]:
            title(axes, _title(name, data.result))
        if name == _VOLUME and cuts is data.slices[-1]:
            draw_bar(sheet.below(axes, 0.7 * width, 0.1, 0.12), shown, scale)
    for axes in cells:  # the last one, in 2D
        _draw_convergence(axes, data.result, width, heights[-1])
    save_png(sheet.figure, path)


def _draw_convergence(axes: "Axes", result: "RegistrationResult", width: float, height: float) -> None:
    """Draw the similarity over the steps, with room for the numbers on the left within the panel."""
    place = axes.get_position(original=True)
    left = 0.45 / width * place.width
    axes.set_position((place.x0 + left, place.y0, place.width - left, place.height))
    axes.set_box_aspect(height / (width - 0.45))
    draw_convergence(axes, result)
    axes.set_ylabel("")
    title(axes, f"{measure_name(result.settings.similarity.measure)} over the steps")


def _title(panel: str, result: "RegistrationResult") -> str:
    """Return the title of a panel; the moving image is shown after the alignment."""
    if panel == _VOLUME:
        return f"{WORDS[result.grid.dim]['volume']}: moving / fixed"
    return f"{panel}, aligned" if panel == "moving" and result.affine is not None else panel


def _headlines(data: ReportData, most: int) -> tuple[str, str]:
    """Return the names of the files in so many letters, and the most important figures."""
    result, diagnosis = data.result, data.result.diagnosis
    before, after = result.similarity_before.item(), result.similarity_after.item()
    voxel = WORDS[result.grid.dim]["voxel"]
    names = [shortened(Path(image.name).name, most // 2 - 3) for image in (data.moving, data.fixed)]
    return " onto ".join(names), "     ".join(
        (
            f"{measure_name(result.settings.seen_by)} {before:.3g} → {after:.3g}",
            f"folds {int(diagnosis.folds.item())}",
            f"determinant {diagnosis.det_min.item():.2g} to {diagnosis.det_max.item():.2g}",
            f"inverse consistency {result.inverse_error_mean.item():.2g} {voxel}",
        )
    )


def _draw_image(name: str, axes: "Axes", data: ReportData, cuts: Slices) -> "AxesImage":
    shown = draw_image(axes, cuts.plane, cuts.fields[name][cuts.middle])
    _draw_marks(axes, cuts, name, (OUTLINES, TISSUE, LANDMARKS, NO_DATA, ABSENT))
    return shown


def _draw_difference(name: str, axes: "Axes", data: ReportData, cuts: Slices) -> "AxesImage":
    shown = draw_map(axes, cuts.plane, cuts.fields[name][cuts.middle], difference_scale(data.limits[name]))
    _draw_marks(axes, cuts, {"before": MOVING, "after": WARPED}[name], REGIONS)
    return shown


def _draw_marks(axes: "Axes", cuts: Slices, image: str, kinds: Collection[str]) -> None:
    """Draw the marks of some kinds that belong over an image."""
    for mark, lines in cuts.marks.items():
        if mark.image in (FIXED, image) and mark.kind in kinds:
            draw_lines_over(axes, lines[cuts.middle], mark.colour, hatched=mark.kind in REGIONS)


def _draw_grid(axes: "Axes", data: ReportData, cuts: Slices) -> "AxesImage":
    """Draw where φ moves the lines of a regular grid, over the moving image."""
    shown = draw_faint(axes, cuts.plane, cuts.fields["moving"][cuts.middle])
    draw_lines(axes, cuts.plane, cuts.fields["u"][cuts.middle], _GRID_LINES[cuts.plane.grid.dim])
    return shown


def _draw_volume(axes: "Axes", data: ReportData, cuts: Slices) -> "AxesImage":
    shown = draw_map(axes, cuts.plane, cuts.fields["log_det"][cuts.middle], volume_scale(data.limits["log_det"]))
    _draw_marks(axes, cuts, FIXED, (TISSUE,))
    return shown


_VOLUME = "volume"
_PANELS: dict[str, Draw] = {
    "fixed": partial(_draw_image, "fixed"),
    "moving": partial(_draw_image, "moving"),
    "warped": partial(_draw_image, "warped"),
    "deformed grid": _draw_grid,
    "difference before": partial(_draw_difference, "before"),
    "difference after": partial(_draw_difference, "after"),
    _VOLUME: _draw_volume,
}


def write_gallery(path: Path, images: Mapping[str, Image]) -> None:
    """Draw images side by side as a PNG, each on its own scale of grey values; in 3D their three middle planes.

    Args:
        path: the file to write.
        images: by title, all of one dimension.
    """
    planes = [planes_of(image) for image in images.values()]
    width = _GALLERY_INCHES[next(iter(images.values())).grid.dim]
    heights = [width * max(plane.height_over_width for plane in row) for row in zip(*planes, strict=True)]
    sheet = Sheet(width, len(images), heights, [TITLE, *[GAP] * (len(heights) - 1)])
    for column, (name, image) in enumerate(images.items()):
        values = grey(image).float().cpu()
        for row, plane in enumerate(planes[column]):
            axes = sheet.panels[row][column]
            draw_image(axes, plane, plane.cut(to_unit(values, values), [plane.middle])[0])
        title(sheet.panels[0][column], shortened(name, int(14 * width)))
    save_png(sheet.figure, path)


@dataclass(frozen=True)
class _Cut:
    """A plane of the canvas: grey values from 0 to 1 of both images ``(h, w)``, and where each of them has values."""

    plane: Plane
    values: tuple[NDArray[np.float32], NDArray[np.float32]]
    inside: tuple[NDArray[np.bool_], NDArray[np.bool_]]


def write_overlay(path: Path, fixed: Image, moving: Image) -> None:
    """Draw both images and their overlay as a PNG: fixed in blue, moving in orange, white where both are bright.

    Args:
        path: the file to write.
        fixed: fixed image; the planes are its middle ones, three in 3D.
        moving: moving image of the same dimension, at its own position.
    """
    cuts = _cuts(fixed, moving)
    heights = [_OVERLAY_INCHES * min(2.0, max(0.4, cut.plane.height_over_width)) for cut in cuts]
    room = [TITLE, *[GAP] * (len(cuts) - 1)]
    sheet = Sheet(_OVERLAY_INCHES, 3, heights, room, headlines=[_OVERLAY])
    for row, cut in zip(sheet.panels, cuts, strict=True):
        _draw_row(row, cut, titled=cut is cuts[0])
    save_png(sheet.figure, path)


def _draw_row(row: "Sequence[Axes]", cut: _Cut, *, titled: bool) -> None:
    pictures = {"fixed": cut.values[0], "moving": cut.values[1], "overlay": tinted(*cut.values)}
    for axes, (name, picture) in zip(row, pictures.items(), strict=True):
        axes.imshow(picture, cmap="gray", vmin=0, vmax=1, aspect=cut.plane.aspect)
        for inside, colour in zip(cut.inside, _OUTLINES, strict=True):
            if inside.any() and not inside.all():
                axes.contour(inside.astype(np.float32), levels=[0.5], colors=[colour], linewidths=0.9)
        frame(axes, cut.plane)
        title(axes, name if titled else "")


def _cuts(fixed: Image, moving: Image) -> list[_Cut]:
    canvas = _canvas(fixed, moving)
    return [_cut(plane, canvas, (fixed, moving)) for plane in planes_of(canvas)]


def _canvas(fixed: Image, moving: Image) -> Image:
    """Return an empty image along the axes and around the middle of the fixed one, large enough for both if it can."""
    corners = fixed.to_grid(moving.to_world(box_corners(moving.grid)))[0]
    middle, width = [side / 2 for side in fixed.grid.extent], []
    for k, side in enumerate(fixed.grid.extent):
        farthest = max(float((corners[k] - middle[k]).abs().max()), side / 2)
        width.append(2 * min(farthest, _FARTHEST * side / 2) * 1.02)
    pixel = max(width) / _PIXELS
    shape = tuple(max(2, round(w / pixel) + 1) for w in width)
    grid = Grid(shape, tuple(w / (n - 1) for w, n in zip(width, shape, strict=True)))
    first = torch.tensor([m - w / 2 for m, w in zip(middle, width, strict=True)], dtype=torch.float64)
    origin = fixed.to_world(first.view(1, -1, 1))[0, :, 0].tolist()
    return replace(fixed, data=torch.zeros(()).expand(1, 1, *shape), grid=grid, origin=tuple(origin))


def _cut(plane: Plane, canvas: Image, images: tuple[Image, Image]) -> _Cut:
    """Sample both images in one plane of the canvas, at the points of that plane only."""
    world = canvas.to_world(plane.points([plane.middle]))
    found = [_values(image, world, plane) for image in images]
    return _Cut(plane, (found[0][0], found[1][0]), (found[0][1], found[1][1]))


def _values(image: Image, world: Tensor, plane: Plane) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    data = image.data.detach().cpu()
    values = to_unit(data[:, :3], data).mean(1, keepdim=True).float()
    points = image.to_grid(world)
    flat = plane.arrange(sample(values, points, image.grid, outside=torch.nan))[0, 0].numpy()
    return np.nan_to_num(flat), ~np.isnan(flat)
