"""TIFF: pages as a volume, channels, colour tables, and the spacing from the tags that microscopes write."""

import logging
import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import itk
from torchdeform.io.gate import DAMAGED

if TYPE_CHECKING:
    from tifffile import TiffFile

# Length of a unit in millimetres, by the names that ImageJ and OME write. Shorter ones than 0.1 mm are shown in µm.
_MILLIMETRES = {
    "nm": 1e-6, "nanometer": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "\\u00b5m": 1e-3, "micron": 1e-3,
    "microns": 1e-3, "micrometer": 1e-3, "mm": 1.0, "millimeter": 1.0, "cm": 10.0, "centimeter": 10.0, "m": 1e3,
    "inch": 25.4, "in": 25.4,
}  # fmt: skip
_RESOLUTION_UNITS = {2: 25.4, 3: 10.0}  # of the resolution tag: inch and centimetre in mm
_NAMES = {"px": "pixel", "µm": "micron"}  # of ImageJ, whose descriptions are in ASCII
_ONE = 1e-6  # mm by which sizes of pixels may differ from 1 and count as none
_DEPTH, _CHANNELS = "ZQI", "CS"  # letters of tifffile for axes: depth or unnamed pages; channels or samples
_DAMAGE_SIGNS = ("invalid offset", "invalid value offset", "invalid page offset", "corrupted")
_ERRORS = (OSError, ValueError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError, struct.error)


def read_tiff(path: Path) -> Image:
    """Read a TIFF: one page as a 2D image, pages as a volume. Spacing in mm from its tags, 1 without such tags.

    Args:
        path: the file.

    Raises:
        InputError: damaged, pages of different sizes, several time points, or complex numbers.

    Notes:
        Understands the spacing of ImageJ, of OME and of the resolution tags, and colour tables.
    """
    import tifffile

    try:
        with _log_messages() as messages, tifffile.TiffFile(path) as file:
            axes, shape = _require_one(file, path)
            values, (spacing, unit) = _values(file, path, shape), _spacing(file)
            table = file.series[0].keyframe.colormap
    except InputError:
        raise
    except _ERRORS as error:
        raise InputError(f"{path} {DAMAGED}") from error
    if any(sign in line for line in messages for sign in _DAMAGE_SIGNS):
        raise InputError(f"{path} {DAMAGED}")
    if table is not None and values.dtype.kind == "u" and values.max() < table.shape[1]:
        colours = np.take(table // 256, values.astype(np.intp), axis=1)  # a table has 16 bits, the picture 8
        axes, values = axes + "S", np.moveaxis(colours, 0, -1).astype(np.uint8)
    if np.iscomplexobj(values):
        raise InputError(f"{path} holds complex numbers; save their magnitude and give that")
    return replace(_image(axes, values, spacing, str(path)), unit=unit)


@contextmanager
def _log_messages() -> Iterator[list[str]]:
    """Collect what tifffile logs, so that it is not printed."""
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())
    log = logging.getLogger("tifffile")
    before, log.propagate = log.propagate, False
    log.addHandler(handler)
    try:
        yield lines
    finally:
        log.removeHandler(handler)
        log.propagate = before


def _require_one(file: "TiffFile", path: Path) -> tuple[str, tuple[int, ...]]:
    """Return the letters and lengths of the axes; `InputError` unless the file is one image or volume."""
    first, *others = file.series
    if any(s.shape != first.shape for s in others):
        sizes = ", ".join("×".join(map(str, s.shape)) for s in file.series[:3])
        raise InputError(f"{path} has pages of different sizes ({sizes}); save the page that you want and give that")
    several = {axis: n for axis, n in zip(first.axes, first.shape, strict=True) if n > 1}
    if others and not set(several) & set(_DEPTH):  # pages written one by one
        return _DEPTH[0] + first.axes, (1 + len(others), *first.shape)
    other = [n for axis, n in several.items() if axis not in "YX" + _DEPTH + _CHANNELS]
    if other or others:
        count = math.prod(other) * len(file.series)
        raise InputError(f"{path} is a series of {count} images or time points; save one of them and give that")
    return first.axes, first.shape


def _values(file: "TiffFile", path: Path, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """Return the pixels. ITK reads compressions (LZW, JPEG) that tifffile does not know without further packages."""
    try:
        return np.stack([series.asarray() for series in file.series]).reshape(shape)
    except ValueError as error:
        if "imagecodecs" not in str(error):
            raise
    values = itk.values(path)
    if values.size != math.prod(shape):  # ITK adds alpha to the colours of JPEG
        values = values[..., :3]
    return values.reshape(shape)


def _spacing(file: "TiffFile") -> tuple[tuple[float, float, float], str]:
    """Return the distances of pages, rows and columns in mm, 1 without tags, and the unit to show them in."""
    ome, imagej, page = file.ome_metadata, file.imagej_metadata, file.series[0].keyframe
    if ome and (found := _ome_spacing(ome)):
        return found
    tagged = "XResolution" in page.tags and page.resolution != (1, 1)
    down, across = (1 / r if 0 < r < math.inf else 1.0 for r in reversed(page.resolution))
    depth, unit, shown = 1.0, _RESOLUTION_UNITS.get(int(page.resolutionunit)) if tagged else None, "mm"
    if imagej and imagej.get("unit"):
        known = _MILLIMETRES.get(str(imagej["unit"]).lower())
        unit, shown = known or 1.0, _shown(known)
        depth = float(imagej.get("spacing", 1.0)) * unit
    if unit is None or (abs(down * unit - 1) + abs(across * unit - 1) < _ONE and not imagej):
        return (1.0, 1.0, 1.0), "px"  # ITK writes the resolution of 1 mm where an image has none
    return (abs(depth) or 1.0, down * unit, across * unit), shown


def _shown(millimetres: float | None) -> str:
    """Return the unit to show lengths in, by the length of the file's unit."""
    return "px" if millimetres is None else "µm" if millimetres < 0.1 else "mm"


def _ome_spacing(text: str) -> tuple[tuple[float, float, float], str] | None:
    """Return PhysicalSizeZ, Y, X in mm and their unit; None if the description has no sizes or cannot be read."""
    try:
        pixels = ElementTree.fromstring(text).find(".//{*}Pixels")
    except ElementTree.ParseError:
        return None
    if pixels is None or "PhysicalSizeX" not in pixels.attrib:
        return None
    units = [_MILLIMETRES.get(pixels.get(f"PhysicalSize{axis}Unit", "µm"), 1.0) for axis in "ZYX"]
    sizes = [float(pixels.get(f"PhysicalSize{axis}", "nan")) * unit for axis, unit in zip("ZYX", units, strict=True)]
    down, across, depth = sizes[1], sizes[2], sizes[0] if sizes[0] > 0 else 1.0
    return ((depth, down, across), _shown(units[2])) if down > 0 and across > 0 else None


def _image(axes: str, values: NDArray[np.generic], spacing: tuple[float, float, float], name: str) -> Image:
    """Return pixels whose axes have letters as an image: channels, depth, rows, columns."""
    order = sorted(range(len(axes)), key=lambda k: (axes[k] not in _CHANNELS, axes[k] in "YX", axes[k] == "X"))
    ordered = np.transpose(values, order)
    channels = math.prod(n for n, axis in zip(values.shape, axes, strict=True) if axis in _CHANNELS)
    pixels = ordered.reshape(channels, -1, *ordered.shape[-2:])
    used = [k for k in range(3) if pixels.shape[k + 1] > 1]
    if len(used) < 2:
        raise InputError(f"{name} has size {list(pixels.shape[1:])}; give an image with at least two axes")
    shape = tuple(pixels.shape[k + 1] for k in used)
    if channels == 2 and axes[-1] == "S":  # grey with alpha
        pixels = pixels[[0, 0, 0, 1]]
    data = torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32).reshape(1, -1, *shape))
    kind = "uint8" if values.dtype.kind == "b" else values.dtype.name
    return Image(data, Grid(shape, tuple(spacing[k] for k in used)), name=name, pixel_type=kind)


def write_tiff(values: NDArray[np.generic], spacing: Sequence[float], unit: str, path: Path) -> None:
    """Write a volume as the pages of a TIFF for ImageJ, with the distance of the pages in its description.

    Args:
        values: ``(C, Z, Y, X)`` of a type that ImageJ has: uint8, uint16 or float32.
        spacing: distances of pages, rows and columns in ``unit``.
        unit: one of `UNITS`.
        path: the file.
    """
    import tifffile

    depth, down, across = spacing
    colour = values.dtype == np.uint8 and values.shape[0] in (3, 4)
    tifffile.imwrite(
        path,
        np.moveaxis(values, 0, -1 if colour else 1),
        imagej=True,
        photometric="rgb" if colour else "minisblack",
        resolution=(1 / across, 1 / down),
        metadata={"axes": "ZYXS" if colour else "ZCYX", "spacing": depth, "unit": _NAMES.get(unit, unit)},
    )
