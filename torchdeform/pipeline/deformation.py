"""The deformation method from file to folder: adapted grids, reconstructions, simulated changes of volume."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchdeform.core.derivatives import curl, divergence, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, luminance, require_same_place, resample
from torchdeform.core.warp import invert, sample, voxels
from torchdeform.deformation.monitors import (
    MonitorSettings,
    curvature_monitor,
    density_monitor,
    gradient_monitor,
    normalise_monitor,
    smooth,
)
from torchdeform.deformation.reconstruction import reconstruct
from torchdeform.deformation.velocity import VelocityName
from torchdeform.deformation.versions import grid_from_target_monitor
from torchdeform.deformation.volumes import simulate_volume_change
from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.io import read_displacement, read_image, write_displacement, write_image, write_transform
from torchdeform.io.files import atomic_folder, require_writable
from torchdeform.io.images import ending_like, read_optional
from torchdeform.report.grids import write_grids
from torchdeform.report.record import describe_map, versions, write_json
from torchdeform.report.sampling import grey, to_unit
from torchdeform.solvers.base import Status

MonitorName = Literal["gradient", "curvature", "density", "value"]

Record = dict[str, Any]


@dataclass(frozen=True)
class GridSettings:
    """How a grid is adapted to an image.

    Args:
        monitor: where cells are small: ``gradient`` (edges), ``curvature`` (bends), ``density`` (bright regions), or
            ``value`` for an image that is the monitor f itself.
        f_min: size of the smallest cells, positive.
        f_max: size of the largest cells; only the ratio of the two matters.
        smoothing: standard deviation of the Gaussian that smooths image or monitor, units of spacing; twice the largest
            spacing when None.
        velocity: how the velocity is found, see `find_velocity`.

    Raises:
        InputError: an unknown name, or a number out of range.
    """

    monitor: MonitorName = "gradient"
    f_min: float = 0.2
    f_max: float = 1.0
    smoothing: float | None = None
    velocity: VelocityName = "div_curl"

    def __post_init__(self) -> None:
        require_choice(self.monitor, get_args(MonitorName), "monitor")
        require_choice(self.velocity, get_args(VelocityName), "velocity")
        MonitorSettings(f_min=self.f_min, f_max=self.f_max, smoothing=self.smoothing or 0.0)

    def build(self, image: Image) -> Tensor:
        """Return the monitor f ``(1, 1, *S)`` of an image, float64."""
        smoothing = 2 * max(image.grid.spacing) if self.smoothing is None else self.smoothing
        data = luminance(image).data.double()
        if self.monitor == "value":
            return smooth(data, image.grid, smoothing)
        build = {"gradient": gradient_monitor, "curvature": curvature_monitor, "density": density_monitor}[self.monitor]
        return build(data, image.grid, MonitorSettings(f_min=self.f_min, f_max=self.f_max, smoothing=smoothing))


def adapt_grid_to_file(image: Path, out: Path, settings: GridSettings, device: torch.device) -> Record:
    """Adapt a grid to an image file: J(φ) = f(φ), where a small f makes small cells (Version 2).

    Writes ``displacement.nii.gz`` (u of φ = id + u), ``monitor.nii.gz`` (f, with mean of 1/f one), ``grid.png`` and
    ``result.json`` into ``out``, all or none.

    Args:
        image: the image.
        out: folder for the results; created if missing.
        settings: monitor and velocity.
        device: where to compute.

    Returns:
        The content of ``result.json``.

    Raises:
        InputError: the file, the folder, or a monitor that is not positive.
        ComputationError: no grid was found.
    """
    require_writable(out)
    picture = read_image(image)
    grid = picture.grid
    f = normalise_monitor(settings.build(picture).to(device), grid, "reciprocal_mean")
    u = grid_from_target_monitor(f, grid, velocity=settings.velocity)
    points = grid.points(dtype=u.dtype, device=u.device) + u
    error = (jacobian_determinant(u, grid) / sample(f, points, grid) - 1).abs()
    record = _described(image, u, picture) | {
        "settings": vars(settings),
        "monitor_min": f.min().item(),
        "monitor_max": f.max().item(),
        "determinant_error_mean": error.mean().item(),
        "determinant_error_max": error.max().item(),
    }
    with atomic_folder(out) as folder:
        write_displacement(u.cpu(), picture, folder / "displacement.nii.gz")
        write_image(replace(picture, data=f.cpu(), pixel_type="float32"), folder / "monitor.nii.gz")
        write_grids(folder / "grid.png", {"adapted grid": points.cpu()}, _background(picture))
        _finish(record, folder)
    return record


def reconstruct_file(
    displacement: Path, out: Path, order: int, refine: bool, steps: int | None, device: torch.device
) -> Record:
    """Compute divergence, curl and boundary values of a displacement file, and reconstruct the map from them.

    Writes ``displacement.nii.gz``, with ``steps`` also ``step_01.nii.gz`` and so on, ``grids.png`` and
    ``result.json`` into ``out``, all or none.

    Args:
        displacement: an ITK displacement field.
        out: folder for the results; created if missing.
        order: order of the finite differences, 2 or 4.
        refine: correct the map until the finite differences of the result agree with those given.
        steps: time steps from the identity to the map; none when None.
        device: where to compute.

    Returns:
        The content of ``result.json``; ``distance_max`` is the largest distance between given and reconstructed nodes.

    Raises:
        InputError: the file, the folder, order or steps.
        ComputationError: the reconstruction did not converge.
    """
    require_writable(out)
    given = read_displacement(displacement)
    grid, u = given.grid, given.data.double().to(device)
    data = divergence(u, grid, order), curl(u, grid, order)
    solution = reconstruct(*data, grid, u, order=order, refine=refine, steps=steps)
    if solution.status[0] not in (Status.CONVERGED, Status.ROUNDING):
        raise ComputationError(f"{displacement}: the reconstruction did not converge: {solution.status[0].value}")
    distance = (solution.value - u).norm(dim=1)
    record = _described(displacement, solution.value, given) | {
        "settings": {"order": order, "refine": refine, "steps": steps},
        "distance_max": distance.max().item(),
        "distance_mean": distance.mean().item(),
        "distance_max_voxels": voxels(solution.value - u, grid).max().item(),
        "misfit": solution.misfit.item(),
    }
    trajectory = [] if solution.trajectory is None else list(solution.trajectory.cpu())
    with atomic_folder(out) as folder:
        write_displacement(solution.value.cpu(), given, folder / "displacement.nii.gz")
        for step, moved in enumerate(trajectory, start=1):
            write_displacement(moved, given, folder / f"step_{step:0{len(str(len(trajectory)))}}.nii.gz")
        write_grids(folder / "grids.png", _reconstruction_grids(u.cpu(), solution.value.cpu(), trajectory, grid))
        _finish(record, folder)
    return record


def _reconstruction_grids(given: Tensor, value: Tensor, trajectory: list[Tensor], grid: Grid) -> dict[str, Tensor]:
    """Return the grids to draw: the given one, the middle time step if there are steps, and the last."""
    nodes, middle = grid.points(dtype=given.dtype), len(trajectory) // 2
    between = {f"time step {middle}": nodes + trajectory[middle - 1]} if middle else {}
    last = f"time step {len(trajectory)}" if trajectory else "reconstructed"
    return {"given": nodes + given} | between | {last: nodes + value}


def simulate_file(
    image: Path, labels: Path, factors: Mapping[int, float], out: Path, rigid: Path | None, smoothing: float | None
) -> Record:
    """Change the volumes of labelled regions of an image file by given factors.

    Writes ``simulated.*`` and ``labels.*`` (image and labels after the change), ``displacement.nii.gz`` and
    ``transform.h5`` (points after the change -> points before, as a resampler needs it), ``inverse.h5`` (before ->
    after), ``grid.png`` and ``result.json`` into ``out``, all or none.

    Args:
        image: the image.
        labels: its labels, on the same grid.
        factors: new volume over old volume by label.
        out: folder for the results; created if missing.
        rigid: mask of what must not move (not 0 there), on the same grid.
        smoothing: standard deviation of the Gaussian that smooths borders, units of spacing; the spacing when None.

    Returns:
        The content of ``result.json``.

    Raises:
        InputError: the files, positions that differ, labels or factors.
        ComputationError: the volumes could not be reached, or the map folds beside the rigid region.
    """
    require_writable(out)
    picture, regions = read_image(image), read_image(labels)
    mask = read_optional(rigid)
    for other in (regions, mask):
        if other is not None:
            require_same_place(other, picture)
    grid, values = picture.grid, _whole(regions)
    where = None if mask is None else mask.data != 0
    change = simulate_volume_change(values, factors, grid, rigid_mask=where, smoothing=smoothing)
    if change.status[0] is not Status.CONVERGED:
        off = f"the volumes differ by {change.residual.item():.2%} from those asked for"
        raise ComputationError(f"{labels}: {off}; ask for less, or lower --smoothing")
    u, back = change.value, invert(change.value, grid)
    record = _described(image, u, picture) | {
        "labels": str(labels),
        "volumes": [
            {"label": label, "asked": factors[label], "reached": reached.item()}
            for label, reached in change.factors.items()
        ],
    }
    changed = replace(picture, data=resample(picture, picture, back, outside=None).to(picture.data.dtype))
    moved = replace(regions, data=resample(regions, regions, back, mode="nearest", outside=None).to(values.dtype))
    with atomic_folder(out) as folder:
        write_image(changed, folder / f"simulated{ending_like(image, changed)}")
        write_image(moved, folder / f"labels{ending_like(labels, moved)}")
        write_displacement(back, picture, folder / "displacement.nii.gz")
        write_transform(back, picture, folder / "transform.h5")
        write_transform(u, picture, folder / "inverse.h5")
        write_grids(folder / "grid.png", {"moved grid": grid.points(dtype=u.dtype) + u}, _background(changed))
        _finish(record, folder)
    return record


def _whole(regions: Image) -> Tensor:
    """Return label values ``(1, 1, *S)``; `InputError` unless they are whole numbers in one channel."""
    if regions.data.shape[1] != 1 or not bool((regions.data == regions.data.round()).all()):
        raise InputError(f"{regions.name} is no label image; give an image of whole numbers with one channel")
    return regions.data


def _background(image: Image) -> Tensor | None:
    """Return a 2D image as grey values from 0 to 1; None in 3D."""
    return to_unit(grey(image), grey(image)) if image.grid.dim == 2 else None


def _finish(record: Record, folder: Path) -> None:
    """Write the record of a folder of results, with the names of its files."""
    record["files"] = [*sorted(path.name for path in folder.iterdir()), "result.json"]
    write_json(record, folder / "result.json")


def _described(source: Path, u: Tensor, place: Image) -> Record:
    """Return what the records of all three commands have in common."""
    grid = place.grid
    return {
        "source": str(source),
        "size": grid.shape[::-1],
        "unit": place.unit,
        "spacing": [place.in_unit(length) for length in grid.spacing[::-1]],
        **describe_map(diagnose(u, grid)),
        "displacement_max_voxels": voxels(u, grid).max().item(),
        "versions": versions(),
    }
