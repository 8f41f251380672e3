"""One pair of image files, from reading to the folder of results."""

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import perf_counter

import torch

from torchdeform.core.image import Image, resample
from torchdeform.core.intensities import corresponding_channels
from torchdeform.core.resampling import restrict
from torchdeform.core.transform import Transform
from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.io import read_image, write_displacement, write_image, write_transform
from torchdeform.io.files import atomic_folder, require_writable
from torchdeform.io.images import ending_like
from torchdeform.io.labels import read_labels, write_labels
from torchdeform.io.points import matched, read_points
from torchdeform.metrics.evaluation import common_labels
from torchdeform.pipeline.memory import available, fitting_grid, footprint, peak, readable
from torchdeform.pipeline.preflight import WARNING, preflight
from torchdeform.registration.deformable import resample_result
from torchdeform.registration.problem import Guidance
from torchdeform.registration.result import Callback, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report.command_lines import repeat_command
from torchdeform.report.figures import write_overview
from torchdeform.report.page import write_report
from torchdeform.report.record import describe, write_json
from torchdeform.report.report_data import make_report_data

DEVICES = ("auto", "cpu", "cuda")
RECORD = "result.json"
REPORT = "report.html"


@dataclass(frozen=True, kw_only=True)
class PairFiles:
    """The files of a pair.

    Args:
        fixed: image that stays.
        moving: image that is warped onto it.
        out: folder for the results; made if need be. Results of an earlier run are replaced, other files left alone.
        fixed_mask: where the fixed image counts (not 0).
        moving_mask: where the moving image counts (not 0).
        fixed_points: landmarks of the fixed image, see `read_points`.
        moving_points: the same landmarks in the moving image.
        fixed_labels: regions of the fixed image, whole numbers.
        moving_labels: the same regions of the moving image.
    """

    fixed: Path
    moving: Path
    out: Path
    fixed_mask: Path | None = None
    moving_mask: Path | None = None
    fixed_points: Path | None = None
    moving_points: Path | None = None
    fixed_labels: Path | None = None
    moving_labels: Path | None = None

    def require_pairs(self) -> None:
        """Raise `InputError` if points or labels are given for one image only."""
        for what in ("points", "labels"):
            given = [getattr(self, f"{side}_{what}") is not None for side in ("fixed", "moving")]
            if given[0] != given[1]:
                missing, other = ("moving", "fixed") if given[0] else ("fixed", "moving")
                raise InputError(f"--{other}-{what} needs --{missing}-{what} too; give both or neither")


@dataclass(frozen=True)
class Inputs:
    """What was read: two images, what guides them, and what looks wrong with them."""

    fixed: Image
    moving: Image
    guidance: Guidance
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """What became of a pair.

    Attributes:
        result: the registration's result.
        record: what ``result.json`` holds.
        folder: where the files are.
        files: their names.
        seconds: wall time per stage, reading and writing among them.
        warnings: sentences about what looks wrong.
    """

    result: RegistrationResult
    record: dict[str, object]
    folder: Path
    files: tuple[str, ...]
    seconds: dict[str, float]
    warnings: tuple[str, ...] = ()


def choose_device(name: str) -> torch.device:
    """Return the device for ``auto`` (CUDA where there is one), ``cpu`` or ``cuda``.

    Raises:
        InputError: another name, or CUDA asked for where there is none.
    """
    require_choice(name, DEVICES, "device")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device: there is no CUDA device here; use cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def read_inputs(files: PairFiles, settings: RegistrationSettings, memory: int | None = None) -> Inputs:
    """Read all files of a pair and check that they can be registered at all.

    Raises:
        InputError: a file cannot be read, or what `preflight` calls an error.
    """
    files.require_pairs()
    fixed, moving = read_image(files.fixed), read_image(files.moving)
    masks = [None if path is None else read_image(path) for path in (files.fixed_mask, files.moving_mask)]
    report = preflight(
        fixed,
        moving,
        fixed_mask=masks[0],
        moving_mask=masks[1],
        aligned=settings.align.kind != "none",
        settings=settings,
        memory=memory,
    )
    report.require_ok()
    corresponding_channels(fixed, moving)
    labels = _read_labels(files, fixed)
    points = _read_points(files, fixed, moving)
    guidance = Guidance(
        fixed_mask=masks[0],
        moving_mask=masks[1],
        fixed_points=points[0],
        moving_points=points[1],
        fixed_labels=labels[0],
        moving_labels=labels[1],
    )
    guidance.require_images(fixed.grid.dim)
    return Inputs(fixed, moving, guidance, report.of(WARNING))


def _read_labels(files: PairFiles, fixed: Image) -> tuple[Image, Image] | tuple[None, None]:
    """Return the labels of both images, which must have some in common where the fixed image is."""
    if files.fixed_labels is None or files.moving_labels is None:
        return None, None
    first, second = read_labels(files.fixed_labels), read_labels(files.moving_labels)
    Guidance(fixed_labels=first, moving_labels=second).require_images(fixed.grid.dim)
    common_labels(resample(first, fixed, mode="nearest"), second.data, names=(first.name, second.name))
    return first, second


def _read_points(
    files: PairFiles, fixed: Image, moving: Image
) -> tuple[torch.Tensor, torch.Tensor] | tuple[None, None]:
    """Return corresponding landmarks in the world, ``(1, D, n)`` each."""
    if files.fixed_points is None or files.moving_points is None:
        return None, None
    first, second, _ = matched(read_points(files.fixed_points, fixed), read_points(files.moving_points, moving))
    return first.T.unsqueeze(0), second.T.unsqueeze(0)


def register_files(
    files: PairFiles,
    settings: RegistrationSettings,
    *,
    device: str = "auto",
    memory: int | None = None,
    callback: Callback | None = None,
) -> Outcome:
    """Register two image files and write the results into a folder.

    Args:
        files: the pair and its folder of results.
        settings: how to register.
        device: ``auto``, ``cpu`` or ``cuda``.
        memory: bytes to take at most; the finest level is coarsened to fit. What the machine has free when None, and
            a pair that does not fit is refused.
        callback: is shown every step.

    Raises:
        InputError: the files, the device or the folder will not do, or memory does not suffice; found out before any
            long work.
        ComputationError: the registration failed. Nothing is written then.
    """
    from torchdeform.registration.deformable import register

    where, start = choose_device(device), perf_counter()
    require_writable(files.out)
    inputs = read_inputs(files, settings, memory)
    work, notes = _fitted(inputs.fixed, settings, memory, where)
    run = _Run(memory, {"read": perf_counter() - start}, {"read": peak()})
    result = register(
        work.to(where), inputs.moving.to(where), settings, guidance=inputs.guidance.to(where), callback=callback
    )
    if work is not inputs.fixed:
        result = resample_result(result, inputs.fixed.to(where), inputs.moving.to(where), inputs.guidance.to(where))
    _require_finite(result)
    run.held[next(reversed(result.seconds), "register")] = peak()
    return _publish(files, replace(inputs, warnings=(*inputs.warnings, *notes)), result, run)


@dataclass(frozen=True)
class _Run:
    """What a run was allowed, what its stages took, and the most that the process had held when they ended."""

    memory: int | None
    seconds: dict[str, float]
    held: dict[str, int | None]


def _fitted(
    fixed: Image, settings: RegistrationSettings, memory: int | None, device: torch.device
) -> tuple[Image, tuple[str, ...]]:
    """Return the fixed image on the finest grid that memory allows, and a sentence if that is a coarser one."""
    channels = fixed.data.shape[1]
    need, free = footprint(fixed.grid, channels, settings), available(device)
    if memory is None:
        if free is not None and need > free:
            raise InputError(
                f"{fixed.name}: registering it takes about {readable(need)} of memory and {readable(free)} are free; "
                f"use --memory {readable(free, spaced=False)} to register it on a coarser grid"
            )
        return fixed, ()
    grid = fitting_grid(fixed.grid, memory, channels, settings)
    if grid == fixed.grid:
        return fixed, ()
    sizes = " instead of ".join("×".join(map(str, g.shape[::-1])) for g in (grid, fixed.grid))
    note = f"to stay below {readable(memory)} of memory the finest level has {sizes} nodes"
    return replace(fixed, data=restrict(fixed.data, fixed.grid, grid), grid=grid), (note,)


def _require_finite(result: RegistrationResult) -> None:
    if not all(bool(field.isfinite().all()) for field in (result.displacement, result.inverse, result.warped)):
        raise ComputationError("the registration diverged: its map is not finite; try --preset default without --set")


def _publish(files: PairFiles, inputs: Inputs, result: RegistrationResult, run: _Run) -> Outcome:
    """Write every file of a result into the folder, all of them or none."""
    out, start = files.out, perf_counter()
    former = _former_files(out)
    with atomic_folder(out) as folder:
        _write_images(folder, files, inputs, result)
        written = perf_counter()
        data = make_report_data(inputs.fixed, inputs.moving, result)
        write_overview(folder / "overview.png", data)
        names = (*sorted([*(path.name for path in folder.iterdir()), REPORT]), RECORD)
        run.seconds.update(result.seconds, write=written - start, draw=perf_counter() - written)
        run.held["draw"] = peak()
        record = _record(files, inputs, result, run) | {"files": names}
        write_report(folder / REPORT, data, record)
        write_json(record, folder / RECORD)
    for name in former - set(names):
        (out / name).unlink(missing_ok=True)
    return Outcome(result, record, out, names, run.seconds, _warnings(inputs, result))


def _record(files: PairFiles, inputs: Inputs, result: RegistrationResult, run: _Run) -> dict[str, object]:
    """Return the record of a result, with what is known of the files and the run."""
    given = {f.name: str(path) for f in fields(files) if (path := getattr(files, f.name)) is not None}
    device = result.displacement.device.type
    return describe(result, inputs.fixed, inputs.moving) | {
        "inputs": given,
        "warnings": _warnings(inputs, result),
        "seconds": run.seconds,
        "memory": run.held,
        "command": repeat_command(given, result.settings, device, run.memory),
        "folder": str(Path.cwd()),
    }


def _warnings(inputs: Inputs, result: RegistrationResult) -> tuple[str, ...]:
    return (*inputs.warnings, *(result.alignment.warnings if result.alignment else ()))


def _write_images(folder: Path, files: PairFiles, inputs: Inputs, result: RegistrationResult) -> None:
    fixed, moving = inputs.fixed, inputs.moving
    transform = Transform.from_displacement(
        result.displacement.cpu(), fixed, inverse=result.inverse.cpu(), affine=result.affine, moving=moving
    )
    warped = replace(fixed, data=result.warped, name="warped", pixel_type=moving.pixel_type)
    write_image(warped, folder / f"warped{ending_like(files.moving, warped)}")
    write_displacement(transform.flatten(fixed).field.data, fixed, folder / "displacement.nii.gz")
    write_transform(transform, folder / "transform.h5")
    write_transform(transform.inverse(), folder / "inverse.h5")
    if files.moving_labels is not None and isinstance(inputs.guidance.moving_labels, Image):
        carried = transform.labels(inputs.guidance.moving_labels, fixed)
        write_labels(carried, folder / f"warped_labels{ending_like(files.moving_labels, carried)}")


def _former_files(out: Path) -> set[str]:
    """Return the names that an earlier run recorded in ``out``, so that none of its results outlives it."""
    try:
        names = json.loads((out / RECORD).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {name for name in names if isinstance(name, str) and Path(name).name == name}
