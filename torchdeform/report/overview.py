"""``overview.png``: one look that tells whether a registration went well."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from torchdeform.report.drawing import (
    INK,
    PAPER,
    difference_scale,
    draw_convergence,
    draw_faint,
    draw_image,
    draw_lines,
    draw_map,
    measure_name,
    volume_scale,
)
from torchdeform.report.scene import Scene, Slices

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from torchdeform.registration.result import RegistrationResult

_SHEET = {2: (2, 4), 3: (3, 7)}  # rows and columns of panels
_PANEL_INCHES = {2: 3.2, 3: 2.3}
_GRID_LINES = {2: 36, 3: 24}

Draw = Callable[["Axes", Scene, Slices], None]


def write_overview(path: Path, scene: Scene) -> None:
    """Draw a registration as a PNG: images, differences, the deformed grid and log J; in 3D three middle planes.

    Args:
        path: the file to write.
        scene: what `make_scene` returns.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    result, dim = scene.result, scene.result.grid.dim
    rows, columns = _SHEET[dim]
    width = _PANEL_INCHES[dim]
    shapes = [cuts.plane.height_over_width for cuts in scene.slices]
    heights = [width * min(2.0, max(0.4, shape)) for shape in shapes] * (rows // len(shapes))
    figure = Figure((columns * width, sum(heights) + 0.3 * rows + 0.4), dpi=110, layout="constrained", facecolor=PAPER)
    cells = figure.subplots(rows, columns, squeeze=False, height_ratios=heights).flat
    for cuts, (title, draw) in product(scene.slices, _PANELS.items()):
        axes = next(cells)
        draw(axes, scene, cuts)
        axes.set_title(_title(title, result) if cuts is scene.slices[0] else "", fontsize=10, color=INK)
    for axes in cells:
        draw_convergence(axes, result)
        axes.set_title(f"{measure_name(result)} over the steps", fontsize=10, color=INK)
        axes.set_ylabel("")
        axes.set_box_aspect(shapes[0])
    figure.suptitle(_headline(result), fontsize=11, color=INK)
    FigureCanvasAgg(figure).print_png(str(path))


def _title(panel: str, result: "RegistrationResult") -> str:
    """Return the title of a panel; the moving image is shown where the alignment has taken it."""
    return f"{panel}, aligned" if panel == "moving" and result.affine is not None else panel


def _headline(result: "RegistrationResult") -> str:
    diagnosis = result.diagnosis
    before, after = result.similarity_before.item(), result.similarity_after.item()
    return (
        f"{measure_name(result)} {before:.3g} → {after:.3g}     "
        f"folds {int(diagnosis.folds.item())}     "
        f"determinant {diagnosis.det_min.item():.2g} to {diagnosis.det_max.item():.2g}     "
        f"inverse error {result.inverse_error_mean.item():.2g} voxel"
    )


def _draw_image(name: str) -> Draw:
    def draw(axes: "Axes", scene: Scene, cuts: Slices) -> None:
        draw_image(axes, cuts.plane, cuts.fields[name][cuts.middle])

    return draw


def _draw_difference(name: str) -> Draw:
    def draw(axes: "Axes", scene: Scene, cuts: Slices) -> None:
        draw_map(axes, cuts.plane, cuts.fields[name][cuts.middle], difference_scale(scene.limits[name]), bar=False)

    return draw


def _draw_grid(axes: "Axes", scene: Scene, cuts: Slices) -> None:
    """Draw where φ takes the lines of a regular grid, over the moving image it takes them to."""
    draw_faint(axes, cuts.plane, cuts.fields["moving"][cuts.middle])
    draw_lines(axes, cuts.plane, cuts.fields["u"][cuts.middle], _GRID_LINES[cuts.plane.grid.dim])


def _draw_volume(axes: "Axes", scene: Scene, cuts: Slices) -> None:
    draw_map(axes, cuts.plane, cuts.fields["log_det"][cuts.middle], volume_scale(scene.limits["log_det"]))


_PANELS: dict[str, Draw] = {
    "fixed": _draw_image("fixed"),
    "moving": _draw_image("moving"),
    "warped": _draw_image("warped"),
    "grid moved by the map": _draw_grid,
    "difference before": _draw_difference("before"),
    "difference after": _draw_difference("after"),
    "volume: moving / fixed": _draw_volume,
}
