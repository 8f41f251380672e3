"""One pair of image files, from reading to the folder of results."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import torch

from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.image import Image, luminance, overlap, require_registrable
from torchdeform.io import read_image, write_displacement, write_image, write_transform
from torchdeform.io.files import require_writable, staged
from torchdeform.io.images import ending_like
from torchdeform.registration.result import Callback, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report.overview import write_overview
from torchdeform.report.record import describe, write_json

DEVICES = ("auto", "cpu", "cuda")
RECORD = "result.json"


@dataclass(frozen=True)
class Pair:
    """Two images to register and where they came from."""

    fixed: Image
    moving: Image
    fixed_path: Path
    moving_path: Path


@dataclass(frozen=True)
class Outcome:
    """What became of a pair.

    Attributes:
        result: the registration's result.
        record: what ``result.json`` holds.
        folder: where the files are.
        files: their names.
        seconds: wall time per stage, reading and writing among them.
    """

    result: RegistrationResult
    record: dict[str, object]
    folder: Path
    files: tuple[str, ...]
    seconds: dict[str, float]


def choose_device(name: str) -> torch.device:
    """Return the device for ``auto`` (CUDA where there is one), ``cpu`` or ``cuda``.

    Raises:
        InputError: another name, or CUDA asked for where there is none.
    """
    require_choice(name, DEVICES, "device")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device: there is no CUDA device here; use cpu or auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def read_pair(fixed: Path, moving: Path) -> Pair:
    """Read two images and check that they can be registered at all.

    Raises:
        InputError: either cannot be read, is constant or has NaN pixels; one is 2D and the other 3D; or they lie
            apart in physical space.
    """
    pair = Pair(read_image(fixed), read_image(moving), fixed, moving)
    for image in (pair.fixed, pair.moving):
        require_registrable(luminance(image))
    if overlap(pair.fixed, pair.moving) == 0.0:
        raise InputError(
            f"{fixed} and {moving} do not overlap in physical space; correct the origin in one of the headers, "
            "or align the images first"
        )
    return pair


def register_files(
    fixed: Path,
    moving: Path,
    out: Path,
    settings: RegistrationSettings,
    *,
    device: str = "auto",
    callback: Callback | None = None,
) -> Outcome:
    """Register two image files and write the results into a folder.

    Args:
        fixed: image that stays.
        moving: image that is warped onto it.
        out: folder for the results; made if need be. Results of an earlier run are replaced, other files left alone.
        settings: how to register.
        device: ``auto``, ``cpu`` or ``cuda``.
        callback: is shown every step.

    Raises:
        InputError: the files, the device or the folder will not do; found out before any long work.
        ComputationError: the registration failed. Nothing is written then.
    """
    from torchdeform.registration.deformable import register

    where, start = choose_device(device), perf_counter()
    require_writable(out)
    pair = read_pair(fixed, moving)
    read = perf_counter() - start
    result = register(pair.fixed.to(where), pair.moving.to(where), settings, callback=callback)
    _require_finite(result)
    return _publish(pair, result, out, read)


def _require_finite(result: RegistrationResult) -> None:
    if not all(bool(field.isfinite().all()) for field in (result.displacement, result.inverse, result.warped)):
        raise ComputationError("the registration diverged: its map is not finite; try --preset default without --set")


def _publish(pair: Pair, result: RegistrationResult, out: Path, read: float) -> Outcome:
    """Write every file of a result into ``out``, all of them or none."""
    former = _former_files(out)
    start = perf_counter()
    with staged(out) as folder:
        _write_images(folder, pair, result)
        files = (*sorted(path.name for path in folder.iterdir()), RECORD)
        seconds = {"read": read, **result.seconds, "write": perf_counter() - start}
        record = describe(result, pair.fixed, pair.moving) | {"seconds": seconds, "files": files}
        write_json(record, folder / RECORD)
    for name in former - set(files):
        (out / name).unlink(missing_ok=True)
    return Outcome(result, record, out, files, seconds)


def _write_images(folder: Path, pair: Pair, result: RegistrationResult) -> None:
    fixed = pair.fixed
    warped = replace(fixed, data=result.warped, name="warped", pixel_type=pair.moving.pixel_type)
    write_image(warped, folder / f"warped{ending_like(pair.moving_path, warped)}")
    write_displacement(result.displacement, fixed, folder / "displacement.nii.gz")
    write_transform(result.displacement, fixed, folder / "transform.h5")
    write_transform(result.inverse, fixed, folder / "inverse.h5")
    write_overview(folder / "overview.png", fixed, pair.moving, result)


def _former_files(out: Path) -> set[str]:
    """Return the names that an earlier run recorded in ``out``, so that none of its results outlives it."""
    try:
        names = json.loads((out / RECORD).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {name for name in names if isinstance(name, str) and Path(name).name == name}
