"""One pair of image files: reading and checking, registration, and the folder of results."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.image import Image, resample
from torchdeform.core.memory import available, peak, readable
from torchdeform.core.resampling import restrict
from torchdeform.core.stages import begin
from torchdeform.core.transform import Transform
from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.io import read_image, write_displacement, write_image, write_transform
from torchdeform.io.files import atomic_folder, require_writable
from torchdeform.io.images import ending_like, read_labels, read_optional, require_storable, write_labels
from torchdeform.io.point_tables import FIXED, MOVING
from torchdeform.io.points import matched, read_points
from torchdeform.io.texts import read_json
from torchdeform.metrics.evaluation import common_labels
from torchdeform.pipeline.annotations import check_annotations, check_features
from torchdeform.pipeline.memory import Channels, advice, fitting_grid, footprint
from torchdeform.pipeline.preflight import WARNING, Finding, Report, preflight
from torchdeform.pipeline.tissue import check_tissue
from torchdeform.pipeline.tissue import contradiction as unexplained_tissue
from torchdeform.registration.annotations import PAIRED, Annotations
from torchdeform.registration.channels import contradiction, count_features, settled
from torchdeform.registration.deformable import resample_result
from torchdeform.registration.result import Callback, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report.figures import write_overview
from torchdeform.report.page import write_report
from torchdeform.report.record import describe, repeat_command, write_json
from torchdeform.report.report_data import ReportData, make_report_data
from torchdeform.report.thumbnail import write_thumbnail

DEVICES = ("auto", "cpu", "cuda")
REPORTS = ("none", "light", "full")
RECORD = "result.json"
REPORT = "report.html"
OVERVIEW = "overview.png"
THUMBNAIL = "thumb.jpg"
DISPLACEMENT, TRANSFORM, INVERSE = "displacement.nii.gz", "transform.h5", "inverse.h5"

_FIXED_NAMES = {RECORD, REPORT, OVERVIEW, THUMBNAIL, DISPLACEMENT, TRANSFORM, INVERSE}
_WARPED = re.compile(r"warped(_labels)?(\.[A-Za-z0-9]+){1,2}")


@dataclass(frozen=True, kw_only=True)
class PairFiles:
    """The files of a pair.

    Args:
        fixed: image that stays.
        moving: image that is warped onto it.
        out: folder for the results; created if missing. Results of an earlier run of this pair are replaced, other
            files stay.
        fixed_mask: where the fixed image counts (not 0).
        moving_mask: where the moving image counts (not 0).
        fixed_points: landmarks of the fixed image, see `read_points`.
        moving_points: the same landmarks in the moving image.
        fixed_labels: regions of the fixed image, whole numbers.
        moving_labels: the same regions of the moving image.
        fixed_features: channels of the fixed image that are compared.
        moving_features: the same channels of the moving image.
        tissue: labels of tissue, whole numbers, of the fixed image alone: the settings ``tissues`` and ``sliding`` say
            what they are.
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
    fixed_features: Path | None = None
    moving_features: Path | None = None
    tissue: Path | None = None

    def given(self) -> dict[str, Path]:
        """Return the files that are given, and the folder ``out``, by their names here."""
        return {field.name: path for field in fields(self) if (path := getattr(self, field.name)) is not None}

    def require_pairs(self) -> None:
        """Raise `InputError` if points, labels or features are given for one image only."""
        for what in PAIRED:
            given = [getattr(self, f"{side}_{what}") is not None for side in ("fixed", "moving")]
            if given[0] != given[1]:
                missing, other = ("moving", "fixed") if given[0] else ("fixed", "moving")
                raise InputError(f"--{other}-{what} needs --{missing}-{what} too; give both or neither")


@dataclass(frozen=True)
class Inputs:
    """What was read: two images, their annotations, how many features are compared, and what looks wrong."""

    fixed: Image
    moving: Image
    annotations: Annotations
    warnings: tuple[str, ...] = ()
    features: int = 0


@dataclass(frozen=True)
class Outcome:
    """The results of a pair.

    Attributes:
        result: the result of the registration.
        record: the content of ``result.json``, such as ``files``, ``seconds`` by stage and ``warnings``.
        folder: where the files are.
    """

    result: RegistrationResult
    record: dict[str, Any]
    folder: Path


def choose_device(name: str) -> torch.device:
    """Return the device for ``auto`` (CUDA if there is one), ``cpu`` or ``cuda``.

    Raises:
        InputError: another name, or ``cuda`` without a CUDA device.
    """
    require_choice(name, DEVICES, "device")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device: there is no CUDA device here; use cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def read_inputs(files: PairFiles, settings: RegistrationSettings, memory: int | None = None) -> Inputs:
    """Read all files of a pair and check that they can be registered at all.

    Args:
        files: the pair.
        settings: how it will be registered.
        memory: bytes that a coarser grid keeps the registration to, see `preflight`.

    Raises:
        InputError: a file cannot be read, `preflight` finds an error, landmarks, labels or features do not belong to
            their image, the settings do not go with the files, or a program makes no features.
    """
    files.require_pairs()
    known = {"features": files.fixed_features is not None, "labels": files.fixed_labels is not None}
    names = ("--fixed-features and --moving-features", "--fixed-labels and --moving-labels")
    if problem := unexplained_tissue(files.tissue is not None, settings) or contradiction(
        settings, **known, options=names
    ):
        raise InputError(problem)
    fixed, moving = read_image(files.fixed), read_image(files.moving)
    masks = [read_optional(path) for path in (files.fixed_mask, files.moving_mask)]
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
    require_storable(settings.outside, ending_like(files.moving, moving), moving)
    paths = (files.fixed_labels, files.moving_labels, files.tissue)
    labels = [None if path is None else read_labels(path) for path in paths]
    annotations = Annotations(
        fixed_mask=masks[0],
        moving_mask=masks[1],
        fixed_labels=labels[0],
        moving_labels=labels[1],
        tissue=labels[2],
        fixed_features=read_optional(files.fixed_features),
        moving_features=read_optional(files.moving_features),
        **_read_points(files, fixed, moving),
    )
    annotations.require_images(fixed.grid.dim)
    found = Report.made_of(*_check_annotations(files, (fixed, moving), annotations, settings))
    found.require_ok()
    if labels[0] is not None and labels[1] is not None:  # some must be the same, or nothing can be measured
        first = resample(labels[0], fixed, mode="nearest")
        common_labels(first, labels[1].data, names=(labels[0].name, labels[1].name))
    remarks = [text for image in labels if image is not None for text in image.remarks]
    features = count_features(settled(settings, annotations), fixed, moving, annotations)
    return Inputs(fixed, moving, annotations, (*report.of(WARNING), *found.of(WARNING), *remarks), features)


def _check_annotations(
    files: PairFiles, images: tuple[Image, Image], annotations: Annotations, settings: RegistrationSettings
) -> Iterator[Finding]:
    """Yield what looks wrong with the landmarks and the labels of both images, and with the tissue of the fixed one."""
    for side, image in zip((FIXED, MOVING), images, strict=True):
        points, labels = (getattr(annotations, f"{side}_{what}") for what in ("points", "labels"))
        positions = None if points is None else points[0].T
        yield from check_annotations(image, positions, getattr(files, f"{side}_points"), labels)
    if annotations.features:
        yield from check_features(images, annotations.features)
    if isinstance(annotations.tissue, Image):
        yield from check_tissue(images[0], annotations.tissue, settings)


def _read_points(files: PairFiles, fixed: Image, moving: Image) -> dict[str, Tensor]:
    """Return corresponding landmarks in the world, ``(1, D, n)`` each, by the names that `Annotations` has for them."""
    if files.fixed_points is None or files.moving_points is None:
        return {}
    first, second, _ = matched(
        read_points(files.fixed_points, fixed, side=FIXED), read_points(files.moving_points, moving, side=MOVING)
    )
    return {"fixed_points": first.T.unsqueeze(0), "moving_points": second.T.unsqueeze(0)}


def register_files(
    files: PairFiles,
    settings: RegistrationSettings,
    *,
    device: str = "auto",
    memory: int | None = None,
    report: str = "full",
    overwrite: bool = False,
    callback: Callback | None = None,
) -> Outcome:
    """Register two image files and write the results into a folder.

    Args:
        files: the pair and its folder of results.
        settings: how to register.
        device: ``auto``, ``cpu`` or ``cuda``.
        memory: bytes to use at most; the finest level is coarsened to fit. When None, all that is free, and a pair
            that does not fit is an error.
        report: ``full`` draws ``report.html`` and ``overview.png``; ``light`` draws the middle slices alone, and a
            ``thumb.jpg``; ``none`` draws nothing.
        overwrite: also replace results of another pair.
        callback: is called with every step.

    Raises:
        InputError: the files, the device or the folder cannot be used, the folder has results of another pair, or
            there is not enough memory. This is checked before any long work.
        ComputationError: the registration failed. Nothing is written then.
    """
    from torchdeform.registration.deformable import register
    from torchdeform.registration.placement import place

    where, start = choose_device(device), perf_counter()
    require_choice(report, REPORTS, "report")
    require_writable(files.out)
    if not overwrite:
        _require_own(files)
    _require_no_folders(files.out)
    begin("reading")
    inputs = read_inputs(files, settings, memory)
    settings = settled(settings, inputs.annotations)
    fixed, notes = _fit_to_memory(inputs, settings, memory, where)
    run = _Run(memory, {"read": perf_counter() - start}, {"read": peak()})
    moving, annotations = inputs.moving.to(where), inputs.annotations.to(where)
    placed = place(fixed.to(where), moving, settings, annotations)
    if placed.choice:  # what was chosen may take more
        fixed, notes = _fit_to_memory(inputs, placed.settings, memory, where)
    result = register(fixed.to(where), moving, settings, annotations=annotations, affine=placed, callback=callback)
    if fixed is not inputs.fixed:  # a coarser grid was registered
        result = resample_result(result, inputs.fixed.to(where), moving, annotations)
    _require_finite(result)
    run.peaks[next(reversed(result.seconds), "register")] = peak()
    result = replace(result, warnings=(*inputs.warnings, *notes, *result.warnings))
    return _write_results(files, inputs, result, run, report)


@dataclass(frozen=True)
class _Run:
    """The limit of memory of a run; seconds and peak memory (of the process so far) by stage."""

    memory: int | None
    seconds: dict[str, float]
    peaks: dict[str, int | None]


def _fit_to_memory(
    inputs: Inputs, settings: RegistrationSettings, memory: int | None, device: torch.device
) -> tuple[Image, tuple[str, ...]]:
    """Return the fixed image on the finest grid that memory allows, and a sentence if that grid is coarser."""
    fixed = inputs.fixed
    channels = Channels(fixed.data.shape[1], inputs.features)
    need, free = footprint(fixed.grid, channels, settings), available(device)
    if memory is None:
        if free is not None and need > free:
            raise InputError(
                f"{fixed.name}: registering it takes about {readable(need)} of memory and {readable(free)} are free; "
                f"{advice(fixed.grid, free, channels, settings)}"
            )
        return fixed, ()
    grid = fitting_grid(fixed.grid, memory, channels, settings)
    if grid == fixed.grid:
        return fixed, ()
    sizes = f"{grid.size_text} instead of {fixed.grid.size_text}"
    note = f"to stay below {readable(memory)} of memory the finest level has {sizes} nodes"
    return replace(fixed, data=restrict(fixed.data, fixed.grid, grid), grid=grid), (note,)


def _require_finite(result: RegistrationResult) -> None:
    if not all(bool(field.isfinite().all()) for field in (result.displacement, result.inverse, result.warped)):
        raise ComputationError("the registration diverged: its map is not finite; try --preset default without --set")


def _write_results(files: PairFiles, inputs: Inputs, result: RegistrationResult, run: _Run, report: str) -> Outcome:
    """Write all files of a result into the folder, or none."""
    begin("writing")
    out, start = files.out, perf_counter()
    with atomic_folder(out, lambda: _earlier_files(out)) as folder:
        _write_images(folder, files, inputs, result)
        written = perf_counter()
        begin("drawing")
        data = _draw(folder, inputs, result, report)
        pages = [] if data is None else [REPORT]
        names = (*sorted([*(path.name for path in folder.iterdir()), *pages]), RECORD)
        run.seconds.update(result.seconds, write=written - start, draw=perf_counter() - written)
        run.peaks["draw"] = peak()
        record = _record(files, inputs, result, run) | {"files": names}
        if data is not None:
            write_report(folder / REPORT, data, record)
        write_json(record, folder / RECORD)
    return Outcome(result, record, out)


def _draw(folder: Path, inputs: Inputs, result: RegistrationResult, report: str) -> ReportData | None:
    """Draw the pictures of a report, and return its data; None if there is none."""
    if report == "none":
        return None
    light, annotations = report == "light", inputs.annotations
    data = make_report_data(inputs.fixed, inputs.moving, result, annotations=annotations, light=light)
    write_overview(folder / OVERVIEW, data)
    if light:
        write_thumbnail(folder / THUMBNAIL, data)
    return data


def _record(files: PairFiles, inputs: Inputs, result: RegistrationResult, run: _Run) -> dict[str, Any]:
    """Return the record of a result, with the files and the figures of the run."""
    given = {name: str(path) for name, path in files.given().items()}
    device = result.displacement.device.type
    return describe(result, inputs.fixed, inputs.moving) | {
        "inputs": given,
        "seconds": run.seconds,
        "memory": run.peaks,
        "command": repeat_command(given, result.settings, device, run.memory),
        "folder": str(Path.cwd()),
    }


def _write_images(folder: Path, files: PairFiles, inputs: Inputs, result: RegistrationResult) -> None:
    fixed, moving = inputs.fixed, inputs.moving
    transform = Transform.from_displacement(
        result.displacement.cpu(), fixed, inverse=result.inverse.cpu(), affine=result.affine, moving=moving
    )
    warped = replace(fixed, data=result.warped, name="warped", pixel_type=moving.pixel_type)
    write_image(warped, folder / f"warped{ending_like(files.moving, warped)}")
    write_displacement(transform.flatten(fixed).field.data, fixed, folder / DISPLACEMENT)
    write_transform(transform, folder / TRANSFORM)
    write_transform(transform.inverse(), folder / INVERSE)
    if files.moving_labels is not None and isinstance(inputs.annotations.moving_labels, Image):
        labels = transform.labels(inputs.annotations.moving_labels, fixed)
        write_labels(labels, folder / f"warped_labels{ending_like(files.moving_labels, labels)}")


def _earlier_record(out: Path) -> dict[str, Any]:
    """Return the record that an earlier run left in ``out``; empty if there is none, or none that can be read."""
    try:
        record = read_json(out / RECORD, "record of a registration")
    except InputError:
        return {}
    return record if isinstance(record, dict) else {}


def is_result(name: object) -> bool:
    """Return whether `register_files` writes files of this name; no others are ever removed."""
    return isinstance(name, str) and (name in _FIXED_NAMES or _WARPED.fullmatch(name) is not None)


def _earlier_files(out: Path) -> set[str]:
    """Return the names that an earlier run recorded in ``out``, so that none of its results stays."""
    record = _earlier_record(out)
    names, made_by = record.get("files"), record.get("versions")
    if not isinstance(names, list) or not isinstance(made_by, dict) or "torchdeform" not in made_by:
        return set()
    return set(filter(is_result, names))


def _require_no_folders(out: Path) -> None:
    """Raise `InputError` if there are folders with the names of results in ``out``; they are never replaced."""
    for path in sorted(out.iterdir()) if out.is_dir() else ():
        if is_result(path.name) and path.is_dir() and not path.is_symlink():
            raise InputError(f"{path} is a folder where a file is to be written; move it away")


def _require_own(files: PairFiles) -> None:
    """Raise `InputError` if the folder has results of something else than these two images."""
    record = _earlier_record(files.out)
    if not record:
        return
    given = record.get("inputs")
    known = {side: given.get(side) for side in ("fixed", "moving")} if isinstance(given, dict) else {}
    start = Path(str(record.get("folder", "")))  # where the command ran; its paths may be relative to it
    if any((start / str(known.get(side))).resolve() != getattr(files, side).resolve() for side in ("fixed", "moving")):
        of = " to ".join(str(known[side]) for side in ("moving", "fixed")) if known else "another command"
        raise InputError(f"{files.out} has the results of {of}; choose another folder with --out, or add --overwrite")
