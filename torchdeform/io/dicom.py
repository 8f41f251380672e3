"""DICOM: one file, the series of a file, or a folder with one series. Errors name the slices that are missing."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import itk
from torchdeform.io.files import read_head
from torchdeform.io.gate import DAMAGED

if TYPE_CHECKING:
    import SimpleITK as sitk

# A file is read as its whole series when that has so many slices. With fewer it cannot be registered as a volume.
VOLUME_SLICES = 8

_MAGIC = 128, b"DICM"
_UNEVEN = 0.1  # share of a step by which the distances of neighbouring slices may differ
_SHEAR = 0.01  # share of a step by which neighbouring slices may be shifted sideways
_SAME = 1e-2  # mm; slices closer than this are at the same position

_POSITION, _SERIES, _TITLE, _FRAME_TIME = "0020|0032", "0020|000e", "0008|103e", ("0018|1063", "0018|1065")
_SPACINGS = ("0028|0030", "0018|1164", "0018|2010")  # of pixels; without any they are 1 apart
_MOMENT = ("0018|1060", "0008|0032")  # trigger time, acquisition time
_PARTS = ("0018|0086", "0020|0100")  # echo and time index, which distinguish volumes of one series

# Kinds of DICOM files without an image: directories, presentation states, reports, documents, plans, raw data.
_NO_IMAGE = re.compile(rb"1\.2\.840\.10008\.(1\.3\.10|5\.1\.4\.1\.1\.(11|88|104|66|481\.[3458])(\.|\0|$))")


@dataclass(frozen=True)
class Slice:
    """What the header of one file says.

    Attributes:
        path: the file.
        series: the values that all slices of one volume share.
        title: the series' description.
        size: pixels along x, y and z.
        position: world position of the first pixel, mm.
        moment: when it was acquired, as the header writes it.
        axes: world directions of x, y and z as columns ``(3, 3)``.
        cine: whether the frames of this file follow each other in time.
        grey: whether a pixel is one number.
    """

    path: Path
    series: tuple[object, ...]
    title: str
    size: tuple[int, ...]
    position: NDArray[np.float64]
    moment: tuple[str, ...]
    axes: NDArray[np.float64]
    cine: bool
    grey: bool

    @property
    def height(self) -> float:
        """Position along the normal of the slice, mm."""
        return float(self.axes[:, 2] @ self.position)


def is_dicom(path: Path) -> bool:
    """Return whether a file has the magic bytes of DICOM, whatever its name."""
    start, magic = _MAGIC
    return read_head(path, start + len(magic))[start:] == magic


def read_file(path: Path) -> Image:
    """Read a DICOM file: the volume of its series, or the file alone if the series is no volume.

    Args:
        path: one file.

    Raises:
        InputError: damaged, a cine, or of a series with slices that are missing, double, uneven or sheared.

    Notes:
        The series is all files of the same folder with the same series number, size, orientation and spacing. It is
        no volume if it has fewer than 8 slices, or several frames at one position (a beating heart). To read one
        slice of a volume, put it into a folder of its own.
    """
    here = _header(path)
    if here is None:
        raise InputError(f"{path} holds no DICOM image; give an image file, or the folder of the series")
    if here.cine:
        raise InputError(f"{path} is a cine of {here.size[2]} frames; export one frame and give that")
    if here.size[2] > 1 or _has_frames(series := _like(here)) or len(series) < VOLUME_SLICES:
        loaded = _load(path)
        image = itk.to_image(loaded, str(path))
        known = set(image.grid.spacing) != {1.0} or any(map(loaded.HasMetaDataKey, _SPACINGS))
        return image if known else replace(image, unit="px")
    return _volume(series, str(path))


def read_folder(folder: Path) -> Image:
    """Read the one DICOM series in a folder.

    Args:
        folder: where the files are; files that are no DICOM image are skipped.

    Raises:
        InputError: no series or several, a series of several frames, or slices that do not make a volume.
    """
    groups: dict[tuple[object, ...], list[Slice]] = {}
    for found in _headers(folder):
        groups.setdefault(found.series, []).append(found)
    if not groups:
        raise InputError(f"{folder} is a folder without DICOM images{_below(folder)}; give an image file")
    if len(groups) > 1:
        titles = ", ".join(f"'{g[0].title}' ({len(g)} files, {g[0].path.name} for one)" for g in groups.values())
        raise InputError(
            f"{folder} holds {len(groups)} DICOM series: {titles}; give one file of the series that you want"
        )
    (series,) = groups.values()
    if len(series) == 1:
        return read_file(series[0].path)
    if _has_frames(series):
        places = len(_steps(series)) + 1
        raise InputError(
            f"{folder} is a DICOM series over time, {len(series)} frames at {places} positions; give one of its files, "
            "or a folder with the files of one moment"
        )
    return _volume(series, str(folder))


def _below(folder: Path) -> str:
    names = [path.name for path in sorted(folder.iterdir()) if path.is_dir()][:3]
    return f" (it has the folders {', '.join(names)})" if names else ""


def _like(one: Slice) -> list[Slice]:
    return [found for found in _headers(one.path.parent) if found.series == one.series]


def _headers(folder: Path) -> list[Slice]:
    files = [path for path in sorted(folder.iterdir()) if path.is_file() and is_dicom(path)]
    return [header for header in map(_header, files) if header is not None]


def _header(path: Path) -> Slice | None:
    """Return what the header says, or None for a DICOM file without an image."""
    import SimpleITK as sitk

    if _NO_IMAGE.search(read_head(path, 2048)):
        return None
    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(str(path))
    error = itk.quietly(reader.ReadImageInformation)
    if isinstance(error, RuntimeError):
        raise InputError(f"{path} {DAMAGED}") from error
    return _slice(path, reader)


def _slice(path: Path, reader: "sitk.ImageFileReader") -> Slice:
    tags = {tag: reader.GetMetaData(tag).strip() for tag in reader.GetMetaDataKeys()}
    axes = np.array(reader.GetDirection()).reshape(3, 3)
    spacing = reader.GetSpacing()[:2]
    alone = path.name if reader.GetSize()[2] > 1 else ""
    alike = (alone, *reader.GetSize(), *np.round(axes[:, :2], 3).ravel() + 0.0, *np.round(spacing, 4))
    return Slice(
        path=path,
        series=(tags.get(_SERIES, ""), *(tags.get(tag, "") for tag in _PARTS), *alike),
        title=tags.get(_TITLE, "without a name"),
        size=reader.GetSize(),
        position=np.array(reader.GetOrigin()),
        moment=tuple(tags.get(tag, "") for tag in _MOMENT),
        axes=axes,
        cine=reader.GetSize()[2] > 1 and any(tag in tags for tag in _FRAME_TIME),
        grey=reader.GetNumberOfComponents() == 1,
    )


def _sorted(series: Sequence[Slice]) -> list[Slice]:
    return sorted(series, key=lambda s: (s.height, s.path.name))


def _steps(series: Sequence[Slice]) -> NDArray[np.float64]:
    """Return the distances between neighbouring positions that differ, mm."""
    steps = np.diff([s.height for s in _sorted(series)])
    return steps[steps > _SAME]


def _has_frames(series: Sequence[Slice]) -> bool:
    """Return whether positions repeat on purpose: at different times, or in 1.5 times as many files as positions."""
    again = [(one, two) for one, two in pairwise(_sorted(series)) if two.height - one.height <= _SAME]
    return any(one.moment != two.moment for one, two in again) or len(series) >= 1.5 * (len(_steps(series)) + 1)


def _volume(series: Sequence[Slice], name: str) -> Image:
    """Read the slices of one volume. Its third axis is the normal of the slices."""
    import SimpleITK as sitk

    slices = _sorted(series)
    step = _require_regular(slices, name)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(s.path) for s in slices])
    reader.SetImageIO("GDCMImageIO")
    if slices[0].grey:  # every slice may have its own scale, so the type of the first may be too small for the others
        reader.SetOutputPixelType(sitk.sitkFloat32)
    image = itk.quietly(reader.Execute)
    if isinstance(image, RuntimeError):
        for slice_ in slices:
            _load(slice_.path)
        raise InputError(f"{name} cannot be read ({itk.reason(image)}); export the series again") from image
    image.SetOrigin(slices[0].position.tolist())
    image.SetDirection(slices[0].axes.ravel().tolist())
    image.SetSpacing((*image.GetSpacing()[:2], step))
    return itk.to_image(image, name)


def _load(path: Path) -> "sitk.Image":
    try:
        return itk.load(path)
    except RuntimeError as error:
        raise InputError(f"{path} {DAMAGED}") from error


def _require_regular(slices: Sequence[Slice], name: str) -> float:
    """Return the distance of the slices; an `InputError` names the slices that do not fit."""
    pairs = list(pairwise(slices))
    steps = np.array([after.height - before.height for before, after in pairs])
    for (before, after), gap in zip(pairs, steps, strict=True):
        if gap <= _SAME:
            names = f"{before.path.name} and {after.path.name}"
            raise InputError(f"{name}: {names} are slices at the same position; remove one of them")
    step = float(np.median(steps))
    for (before, after), gap in zip(pairs, steps, strict=True):
        between = f"between {before.path.name} and {after.path.name}"
        if gap > 1.5 * step:
            count = round(gap / step) - 1
            raise InputError(f"{name}: {count} slices are missing {between}; fetch the whole series again")
        if abs(gap - step) > _UNEVEN * step:
            uneven = f"{gap:.3g} mm {between}, {step:.3g} mm elsewhere"
            raise InputError(f"{name}: its slices are unevenly spaced ({uneven}); resample it to even slices first")
    path = slices[-1].position - slices[0].position
    shift = np.linalg.norm(slices[0].axes[:, :2].T @ path) / len(pairs)
    if shift > _SHEAR * step:
        raise InputError(
            f"{name}: its slices are shifted sideways by {shift:.2g} mm each (a tilted gantry), so its axes are not at "
            "right angles; reslice it onto a rectangular grid first"
        )
    return float(slices[-1].height - slices[0].height) / len(pairs)
