"""``overview.png``: one look that tells whether a registration went well."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.image import Image, luminance, resample
from torchdeform.registration.result import RegistrationResult
from torchdeform.registration.settings import similarity_weights
from torchdeform.stencil import jacobian_determinant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

_INK, _PAPER, _LINES = "#222222", "#ffffff", "#0b5fa5"
_SHEET = {2: (2, 4), 3: (3, 7)}  # rows and columns of panels
_PANEL_INCHES = {2: 3.2, 3: 2.3}
_GRID_LINES = {2: 36, 3: 24}
_LARGEST = 1000  # pixels along a side that a panel can show
_PERCENTILES = (0.5, 99.5)
_SMALLEST = 1e-3  # determinants below this, folds among them, are drawn as this

Draw = Callable[["Axes", "Scene", "Plane"], None]


@dataclass(frozen=True)
class Plane:
    """A plane through the middle of a grid: the axes it shows (down, across), and which are turned for the eye."""

    grid: Grid
    axes: tuple[int, int]
    turned: tuple[bool, bool]

    def cut(self, field: Tensor) -> Tensor:
        """Return the plane ``(C, n_down, n_across)`` of a field ``(1, C, *S)``."""
        plane = field[0]
        for axis in reversed(range(self.grid.dim)):
            if axis not in self.axes:
                plane = plane.select(axis + 1, self.grid.shape[axis] // 2)
        return plane if self.axes[0] < self.axes[1] else plane.transpose(1, 2)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes down and across."""
        return self.grid.shape[self.axes[0]], self.grid.shape[self.axes[1]]

    @property
    def aspect(self) -> float:
        """Height of a pixel over its width."""
        return self.grid.spacing[self.axes[0]] / self.grid.spacing[self.axes[1]]

    @property
    def height_over_width(self) -> float:
        """Shape of the plane in the world."""
        return self.aspect * self.shape[0] / self.shape[1]


@dataclass(frozen=True)
class Scene:
    """Everything that is drawn, on the fixed grid and the CPU; grey values run from 0 to 1.

    ``difference`` is what is drawn brightest in both differences, ``limit`` the largest |log J| that is told apart.
    """

    fixed: Tensor
    moving: Tensor
    warped: Tensor
    before: Tensor
    after: Tensor
    u: Tensor
    log_det: Tensor
    difference: float
    limit: float


def write_overview(path: Path, fixed: Image, moving: Image, result: RegistrationResult) -> None:
    """Draw a registration as a PNG: images, differences, the deformed grid and log J; in 3D three middle planes.

    Args:
        path: the file to write.
        fixed: fixed image.
        moving: moving image, in its own place, or where the alignment has taken it.
        result: a result of one pair (batch of 1) on the fixed grid.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene, planes = _scene(fixed, moving, result), middle_planes(fixed)
    rows, columns = _SHEET[fixed.grid.dim]
    width = _PANEL_INCHES[fixed.grid.dim]
    heights = [width * min(2.0, max(0.4, plane.height_over_width)) for plane in planes] * (rows // len(planes))
    figure = Figure((columns * width, sum(heights) + 0.3 * rows + 0.4), dpi=110, layout="constrained", facecolor=_PAPER)
    cells = figure.subplots(rows, columns, squeeze=False, height_ratios=heights).flat
    for plane, (title, draw) in product(planes, _PANELS.items()):
        axes = next(cells)
        draw(axes, scene, plane)
        axes.set_title(_title(title, result) if plane is planes[0] else "", fontsize=10, color=_INK)
    for axes in cells:
        _draw_similarity(axes, result, planes[0])
    figure.suptitle(_headline(result), fontsize=11, color=_INK)
    FigureCanvasAgg(figure).print_png(str(path))


def _title(panel: str, result: RegistrationResult) -> str:
    """Return the title of a panel; the moving image is shown where the alignment has taken it."""
    return f"{panel}, aligned" if panel == "moving" and result.affine is not None else panel


def _headline(result: RegistrationResult) -> str:
    diagnosis = result.diagnosis
    before, after = result.similarity_before.item(), result.similarity_after.item()
    return (
        f"{_measure(result)} {before:.3g} → {after:.3g}     "
        f"folds {int(diagnosis.folds.item())}     "
        f"determinant {diagnosis.det_min.item():.2g} to {diagnosis.det_max.item():.2g}     "
        f"inverse error {result.inverse_error_mean.item():.2g} voxel"
    )


def _measure(result: RegistrationResult) -> str:
    return " + ".join(similarity_weights(result.settings.similarity))


def _scene(fixed: Image, moving: Image, result: RegistrationResult) -> Scene:
    """Bring everything onto the fixed grid and to one scale of grey."""
    u, grid = result.displacement.detach().cpu(), fixed.grid
    placed = replace(moving, data=resample(moving, fixed).float(), grid=grid)
    warped = replace(moving, data=result.warped.detach().cpu().float(), grid=grid)
    greys = luminance(fixed).data, luminance(moving).data
    grey = to_unit(greys[0], greys[0])
    before, after = ((to_unit(luminance(image).data, greys[1]) - grey).abs() for image in (placed, warped))
    log_det = jacobian_determinant(u, grid).clamp(min=_SMALLEST).log()
    return Scene(
        fixed=to_unit(fixed.data, fixed.data),
        moving=to_unit(placed.data, moving.data),
        warped=to_unit(warped.data, moving.data),
        before=before,
        after=after,
        u=u,
        log_det=log_det,
        difference=max(_quantiles(before, 99.8)[0], 1e-3),
        limit=max(math.log(2), _quantiles(log_det.abs(), 99.8)[0]),
    )


def to_unit(values: Tensor, scale: Tensor) -> Tensor:
    """Return values with the dark and bright ends of ``scale`` at 0 and 1, all colours alike, alpha dropped."""
    colours = slice(0, 3) if scale.shape[1] > 1 else slice(0, 1)
    low, high = _quantiles(scale[:, colours], *_PERCENTILES)
    return ((values[:, colours] - low) / max(high - low, 1e-12)).clamp(0, 1)


def _quantiles(values: Tensor, *percent: float) -> list[float]:
    """Return percentiles of at most about a million values, taken at regular steps."""
    flat = values.reshape(-1)
    return [float(q) for q in np.percentile(flat[:: 1 + flat.numel() // 2**20].numpy(), percent)]


def middle_planes(image: Image) -> list[Plane]:
    """Return the planes to show: the image itself in 2D; axial, coronal and sagittal middle planes in 3D.

    Volumes are turned as radiologists look at them: superior up, anterior up or left, the patient's left on the right.
    """
    if image.grid.dim == 2:
        return [Plane(image.grid, (0, 1), (False, False))]
    z, y, x = _axes_along_world(image)
    against = [image.direction[world][2 - axis] < 0 for world, axis in ((2, z), (1, y), (0, x))]
    turned = dict(zip((z, y, x), (not against[0], against[1], against[2]), strict=True))
    return [Plane(image.grid, axes, (turned[axes[0]], turned[axes[1]])) for axes in ((y, x), (z, x), (z, y))]


def _axes_along_world(image: Image) -> tuple[int, ...]:
    """Return the array axes that lie most nearly along the world's z, y and x."""
    return max(
        permutations(range(3)),
        key=lambda axes: sum(abs(image.direction[2 - k][2 - axis]) for k, axis in enumerate(axes)),
    )


def _thin(plane: Plane, field: Tensor) -> NDArray[np.float32]:
    """Return a field's plane as ``(down, across, C)``, every so many pixels where there are more than can be seen."""
    step = 1 + max(plane.shape) // _LARGEST
    return plane.cut(field)[:, ::step, ::step].movedim(0, -1).float().numpy()


def _show(axes: "Axes", plane: Plane, field: Tensor, **how: Any) -> "AxesImage":
    """Show a field's plane in node coordinates: pixel (i, j) spans i ± 1/2, j ± 1/2."""
    down, across = plane.shape
    pixels = _thin(plane, field)
    shown = axes.imshow(
        pixels if pixels.shape[-1] == 3 else pixels[..., 0],
        extent=(-0.5, across - 0.5, down - 0.5, -0.5),
        aspect=plane.aspect,
        **how,
    )
    frame(axes, plane)
    return shown


def frame(axes: "Axes", plane: Plane) -> None:
    down, across = plane.shape
    axes.set_xlim(*_turn((-0.5, across - 0.5), plane.turned[1]))
    axes.set_ylim(*_turn((down - 0.5, -0.5), plane.turned[0]))
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#bbbbbb")


def _turn(ends: tuple[float, float], turned: bool) -> tuple[float, float]:
    return (ends[1], ends[0]) if turned else ends


def _draw_image(name: str) -> "Draw":
    def draw(axes: "Axes", scene: Scene, plane: Plane) -> None:
        _show(axes, plane, getattr(scene, name), cmap="gray", vmin=0, vmax=1)

    return draw


def _draw_difference(name: str) -> "Draw":
    def draw(axes: "Axes", scene: Scene, plane: Plane) -> None:
        _show(axes, plane, getattr(scene, name), cmap="inferno", vmin=0, vmax=scene.difference)

    return draw


def _draw_grid(axes: "Axes", scene: Scene, plane: Plane) -> None:
    """Draw where φ takes the lines of a regular grid, over the moving image it takes them to."""
    from matplotlib.collections import LineCollection

    _show(axes, plane, scene.moving.mean(1, keepdim=True), cmap="gray_r", vmin=0, vmax=3)
    u = plane.cut(scene.u)
    at = np.stack(np.meshgrid(*map(np.arange, plane.shape), indexing="ij")).astype(np.float32)
    for position, axis in enumerate(plane.axes):
        at[position] += (u[axis] / plane.grid.spacing[axis]).float().numpy()
    points = np.stack((at[1], at[0]), axis=-1)
    every = max(1, round(max(plane.shape) / _GRID_LINES[plane.grid.dim]))
    down, across = (_every(n, every) for n in plane.shape)
    lines = [*points[down], *points[:, across].swapaxes(0, 1)]
    axes.add_collection(LineCollection(lines, colors=_LINES, linewidths=0.7))


def _every(n: int, step: int) -> NDArray[np.int64]:
    """Return nodes at regular steps, centred in 0 .. n − 1."""
    return np.arange((n - 1) % step // 2, n, step)


def _draw_log_det(axes: "Axes", scene: Scene, plane: Plane) -> None:
    """Show log J; the bar in the corner is labelled with J itself, at powers of 2."""
    shown = _show(axes, plane, scene.log_det, cmap="PuOr_r", vmin=-scene.limit, vmax=scene.limit)
    place = axes.inset_axes((0.06, 0.13, 0.5, 0.035))
    bar = axes.figure.colorbar(shown, cax=place, orientation="horizontal")
    top = int(scene.limit / math.log(2) + 1e-6)
    powers = sorted({-top, 0, top})
    bar.set_ticks([k * math.log(2) for k in powers], labels=[f"{2.0**k:g}" for k in powers])
    place.tick_params(labelsize=8, colors=_INK, length=2, pad=1)


def _draw_similarity(axes: "Axes", result: RegistrationResult, plane: Plane) -> None:
    """Draw the similarity over the steps, one line per level."""
    start = 0
    for level in result.levels:
        values = [value.item() for value in level.similarity]
        axes.plot(range(start, start + len(values)), values, label="×".join(map(str, level.shape)), linewidth=1.6)
        start += max(len(values) - 1, 0)
    axes.set_title(f"{_measure(result)} over the steps", fontsize=10, color=_INK)
    axes.tick_params(labelsize=8, colors=_INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_box_aspect(plane.height_over_width)
    if result.levels:
        axes.legend(fontsize=7, frameon=False, loc="best")


_PANELS: "dict[str, Draw]" = {
    "fixed": _draw_image("fixed"),
    "moving": _draw_image("moving"),
    "warped": _draw_image("warped"),
    "grid moved by the map": _draw_grid,
    "difference before": _draw_difference("before"),
    "difference after": _draw_difference("after"),
    "volume: moving / fixed": _draw_log_det,
}
