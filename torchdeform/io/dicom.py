"""DICOM: one file, the series of a file, or a folder with one series. Errors name the slices that are missing.

A slice is a file or a frame of an enhanced file: both go through the same checks.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import itk
from torchdeform.io.dicom_header import DCM2NIIX, Slice, is_dicom, no_image, slices
from torchdeform.io.dicom_pixels import pixels
from torchdeform.io.gate import DAMAGED
from torchdeform.io.volume import NOT_FINITE, Volume

_UNEVEN = 0.1  # share of a step by which the distances of neighbouring slices may differ
_SHEAR = 0.01  # share of a step by which neighbouring slices may be shifted sideways
_SAME = 1e-2  # mm; slices closer than this are at the same position


def read_file(path: Path) -> Image:
    """Read a DICOM file: the volume of its frames or of its series, or the file alone if the series is no volume.

    Args:
        path: one file.

    Raises:
        InputError: damaged, a cine, several volumes, or slices that are missing, double, uneven or sheared.

    Notes:
        The series is all files of the same folder with the same series number, size, orientation and spacing. It is
        no volume if it has several images at one position (a beating heart). To read one slice of a volume, put it
        into a folder of its own.
    """
    return _image(_of_file(path), str(path))


def read_folder(folder: Path) -> Image:
    """Read the one DICOM series in a folder.

    Args:
        folder: where the files are; files that are no DICOM image are skipped.

    Raises:
        InputError: no series or several, a series of several frames, or slices that do not make a volume.
    """
    return _image(_of_folder(folder), str(folder))


def size(path: Path) -> tuple[tuple[int, int, int], int]:
    """Return slices, rows and columns, and the numbers of a pixel, of what `read_file` or `read_folder` reads.

    Raises:
        InputError: as they do, except for pixels.
    """
    found = _of_folder(path) if path.is_dir() else _of_file(path)
    rows, columns, channels = found[0].size
    return (len(found), rows, columns), channels


def files(path: Path) -> list[Path]:
    """Return the files that `read_file` reads for a file, sorted.

    Raises:
        InputError: as it does, except for pixels.
    """
    return sorted({found.path for found in _of_file(path)})


def _of_file(path: Path) -> list[Slice]:
    """Return the slices that are read for a file, sorted."""
    here = slices(path)
    if not here:
        raise InputError(no_image(path))
    if here[0].frames > 1:
        return _of_frames(path, here)
    series = next(volume for volume in _volumes(_headers(path.parent)) if any(s.path == path for s in volume))
    return here if _repeats(series) else _sorted(series)


def _of_frames(path: Path, here: Sequence[Slice]) -> list[Slice]:
    """Return the frames of a file, and of the files that continue it, as one volume."""
    together = here if dict(here[0].series)["file"] == path.name else _headers(path.parent)
    files = {s.series[:2] for s in here}
    found = _volumes(s for s in together if s.series[:2] in files)
    if len(found) > 1:
        raise InputError(f"{path} holds {len(found)} volumes that differ in {_differences(found)}; {DCM2NIIX}")
    (volume,) = found
    if not all(s.placed for s in volume) and _repeats(volume):
        raise InputError(f"{path} does not say where its {len(volume)} frames are; {DCM2NIIX}, or export one frame")
    if _repeats(volume):
        raise InputError(f"{path} is {_over_time(volume)}; {DCM2NIIX}")
    return _sorted(volume)


def _differences(volumes: Sequence[Sequence[Slice]]) -> str:
    """Return what tells volumes apart, such as ``echo time (10.0, 20.0)``."""
    firsts = [dict((*volume[0].series, *volume[0].kind)) for volume in volumes]
    values = {name: list(dict.fromkeys(str(first[name]) for first in firsts)) for name in firsts[0]}
    told = {name: found for name, found in values.items() if len(found) > 1}
    return " and ".join(
        name if name == "orientation" else f"{name} ({', '.join(found[:4])}{', ...' if len(found) > 4 else ''})"
        for name, found in told.items()
    )


def _of_folder(folder: Path) -> list[Slice]:
    """Return the slices of the one series in a folder, sorted."""
    volumes = _volumes(_headers(folder))
    if not volumes:
        raise InputError(f"{folder} is a folder without DICOM images; give {_below(folder)}an image file")
    first, *others = [one for volume in volumes for one in volume]
    if not others or (first.frames > 1 and all(one.series[:2] == first.series[:2] for one in others)):
        return _of_file(first.path)
    if len(volumes) > 1:
        titles = ", ".join(f"'{v[0].title}' ({_count(v)}, {v[0].path.name} for one)" for v in volumes)
        raise InputError(
            f"{folder} holds {len(volumes)} DICOM series: {titles}; give one file of the series that you want"
        )
    (series,) = volumes
    if not any(s.placed for s in series):
        raise InputError(f"{folder} holds {len(series)} DICOM images that do not say where they are; give one of them")
    if _repeats(series):
        raise InputError(
            f"{folder} is {_over_time(series)}; give one of its files, or a folder with the files of one moment"
        )
    return _sorted(series)


def _count(volume: Sequence[Slice]) -> str:
    files = len({s.path for s in volume})
    count, what = (files, "file") if files == len(volume) else (len(volume), "frame")
    return f"{count} {what}{'s' if count > 1 else ''}"


def _over_time(series: Sequence[Slice]) -> str:
    return f"a DICOM series over time, {len(series)} frames at {len(_steps(series)) + 1} positions"


def _below(folder: Path) -> str:
    names = [path.name for path in sorted(folder.iterdir()) if path.is_dir()][:3]
    return f"the folder of one series (it has {', '.join(names)}), or " if names else ""


def _headers(folder: Path) -> list[Slice]:
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and is_dicom(path)]
    return [found for path in files for found in slices(path)]


def _volumes(found: Iterable[Slice]) -> list[list[Slice]]:
    """Return slices in groups that belong together."""
    return [part for series in _split(found, lambda s: s.series) for part in _parts(series)]


def _parts(series: list[Slice]) -> list[list[Slice]]:
    """Return the volumes of a series: several if images at one position differ in what their headers say."""
    parts = _split(series, lambda s: s.kind)
    apart = len(_steps(series)) + 1 < len(series) and min(map(len, parts)) > 1
    return parts if apart else [series]


def _split(found: Iterable[Slice], key: Callable[[Slice], Hashable]) -> list[list[Slice]]:
    groups: dict[Hashable, list[Slice]] = {}
    for one in found:
        groups.setdefault(key(one), []).append(one)
    return list(groups.values())


def _sorted(series: Sequence[Slice]) -> list[Slice]:
    return sorted(series, key=lambda s: (s.height, s.path.name, s.frame))


def _steps(series: Sequence[Slice]) -> NDArray[np.float64]:
    """Return the distances between neighbouring positions that differ, mm."""
    steps = np.diff([s.height for s in _sorted(series)])
    return steps[steps > _SAME]


def _repeats(series: Sequence[Slice]) -> bool:
    """Return whether positions repeat on purpose: at different times, or in half as many slices more as positions."""
    again = [(one, two) for one, two in pairwise(_sorted(series)) if two.height - one.height <= _SAME]
    positions = len(_steps(series)) + 1
    often = 1.5 if positions > 2 else 2.0  # three slices at two positions are one copy
    return any(one.moment != two.moment for one, two in again) or len(series) >= often * positions


def _image(slices: Sequence[Slice], name: str) -> Image:
    """Return the pixels of sorted slices in their place. The third axis of a volume is the normal of its slices."""
    step = _require_regular(slices, name) if len(slices) > 1 else 1.0
    first, unit = slices[0], "px" if slices[0].spacing is None else "mm"
    spacing = (*(first.spacing or (1.0, 1.0)), step)
    return itk.volume_image(Volume(_values(slices, name), spacing, tuple(first.position), first.axes, unit), name)


def _values(slices: Sequence[Slice], name: str) -> NDArray[np.generic]:
    """Return the values ``(slices, rows, columns, samples)``, each slice in its own scale."""
    parts = [one for path, group in groupby(slices, lambda s: s.path) for one in _scaled(pixels(path), list(group))]
    if len({part.shape for part in parts}) > 1:
        raise InputError(f"{name} {DAMAGED}")
    values = np.stack(parts)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(f"{name} {NOT_FINITE}")
    return values


def _scaled(stored: NDArray[np.generic], slices: Sequence[Slice]) -> list[NDArray[np.generic]]:
    """Return the frames of a file that are wanted, in the stored type where no scale is set."""
    if all(s.scale == (1.0, 0.0) for s in slices):
        return [stored[s.frame] for s in slices]
    with np.errstate(over="ignore"):  # what is too large becomes infinite, which is refused
        return [(stored[s.frame] * s.scale[0] + s.scale[1]).astype(np.float32) for s in slices]


def _require_regular(slices: Sequence[Slice], name: str) -> float:
    """Return the distance of the slices; an `InputError` names the slices that do not fit."""
    pairs = list(pairwise(slices))
    steps = np.array([after.height - before.height for before, after in pairs])
    for (before, after), gap in zip(pairs, steps, strict=True):
        if gap <= _SAME:
            names = f"{before.label} and {after.label}"
            raise InputError(f"{name}: {names} are slices at the same position; remove one of them")
    step = float(np.median(steps))
    for (before, after), gap in zip(pairs, steps, strict=True):
        between = f"between {before.label} and {after.label}"
        if gap > 1.5 * step:
            count = round(gap / step) - 1
            missing = "1 slice is" if count == 1 else f"{count} slices are"
            raise InputError(f"{name}: {missing} missing {between}; fetch the whole series again")
        if abs(gap - step) > _UNEVEN * step:
            uneven = f"{gap:.3g} mm {between}, {step:.3g} mm elsewhere"
            raise InputError(f"{name}: its slices are unevenly spaced ({uneven}); resample it to even slices first")
    sideways = [float(np.linalg.norm(one.axes[:, :2].T @ (two.position - one.position))) for one, two in pairs]
    path = slices[-1].position - slices[0].position
    shift = float(np.linalg.norm(slices[0].axes[:, :2].T @ path)) / len(pairs)
    if shift > _SHEAR * step or max(sideways) > _UNEVEN * step:
        raise InputError(
            f"{name}: its slices are shifted sideways by {max(shift, *sideways):.2g} mm each (a tilted gantry), so its "
            "axes are not at right angles; reslice it onto a rectangular grid first"
        )
    return float(slices[-1].height - slices[0].height) / len(pairs)
