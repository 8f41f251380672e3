"""TIFF: known by content; pages as a volume, the full picture of a slide, channels, colours, and a scale if meant."""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray

from torchdeform.core.grid import Grid
from torchdeform.core.image import UNITS, Image
from torchdeform.core.memory import available
from torchdeform.errors import InputError
from torchdeform.io.gate import CROP, DAMAGED, reading, require_beside, require_room
from torchdeform.io.tiff_pixels import orientation_of, require_colours, shown, unpacked
from torchdeform.io.tiff_scale import Scale, scale
from torchdeform.io.volume import held_type

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPageSeries

    Series = Sequence[TiffPageSeries]

_NAMES = {"px": "pixel", "µm": "micron"}  # of ImageJ, whose descriptions are in ASCII
_DEPTH, _CHANNELS = "ZQI", "CS"  # letters of tifffile for axes: depth or unnamed pages; channels or samples
_DAMAGE_SIGNS = (
    "invalid offset",
    "invalid value offset",
    "invalid page offset",
    "corrupted",
    "Missing data are zeroed",
)

# Formats of slide scanners, by tifffile's names, whose pages do not all show the tissue; the largest does.
_SLIDES = {"svs", "ndpi", "scn", "bif", "philips", "qpi"}
_ASIDE = ("label", "macro", "thumbnail", "overview")  # names of images that are not the slide's
_REDUCED, _MASK = 1, 4  # bits of NewSubfileType
_PLAIN = 1  # of Compression
_TABLES = 1 << 16  # bytes that a packing may take beside the pixels
_KEPT = 4  # bytes of a number of float32, which all become
_TYPES = ("uint8", "uint16", "float32")  # of ImageJ
_NO_DEPTH = (
    "does not say how far apart its pages are; they are taken to be as far apart as its columns: save it with the "
    "distance of its pages if they are not"
)


def read_tiff(path: Path, *, exact: bool = False) -> Image:
    """Read a TIFF: one page as a 2D image, pages as a volume, a slide at its full size.

    Args:
        path: the file.
        exact: whether the pixels become float64 where float32 would merge values of their type.

    Raises:
        InputError: damaged, larger than what is free, packed or coloured in a way that is unknown here, pages of
            different sizes, several time points, or complex numbers.

    Notes:
        The scale is that of `tiff_scale.scale`; without one, pixels and pages are 1 apart. Colours, white-is-zero and
        orientation are as a viewer shows them. Labels, macros, thumbnails and smaller levels of slides are left out.
    """
    with _opened(path) as (file, series):
        axes, shape = _require_one(series, path)
        page = series[0].keyframe
        found = scale(file, page)
        _require_room(series, path, found)
        values = unpacked(series, path).reshape(shape)
        if np.iscomplexobj(values):
            raise InputError(f"{path} holds complex numbers; save their magnitude and give that")
        pixels = shown(_ordered(axes, values), page)
        if orientation_of(page) > 4:
            found = ((found[0][0], found[0][2], found[0][1]), found[1])
        return _image(pixels, found, str(path), held_type(pixels.dtype, exact=exact))


def tiff_size(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the shape, without axes of one sample, and the number of channels of a TIFF, from its header.

    Raises:
        InputError: as `read_tiff`, as far as the header tells.
    """
    with _opened(path) as (_, series):
        axes, shape = _require_one(series, path)
        lengths = dict(zip(axes, shape, strict=True))
        channels = math.prod(n for axis, n in lengths.items() if axis in _CHANNELS)
        spatial = [math.prod(n for axis, n in lengths.items() if axis not in "YX" + _CHANNELS)]
        spatial += [lengths.get(axis, 1) for axis in ("YX" if orientation_of(series[0].keyframe) <= 4 else "XY")]
        one = np.zeros((channels, 1, 1, 1), series[0].dtype)
        return tuple(n for n in spatial if n > 1), len(shown(one, series[0].keyframe))


def tiff_parts(path: Path) -> list[Path]:
    """Return the other files that hold pixels of an OME-TIFF.

    Raises:
        InputError: one of them is missing, or not beside or below the first.
    """
    import tifffile

    with reading(path), _log_messages(), tifffile.TiffFile(path, is_ome=False) as file:
        text = file.pages.first.description
    return _parts(text, path) if text.rstrip().endswith("OME>") else []


def _parts(text: str, path: Path) -> list[Path]:
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return []
    others = [e for e in root.iterfind(".//{*}TiffData/{*}UUID") if e.text is None or e.text != root.get("UUID")]
    names = dict.fromkeys(e.get("FileName", path.name) for e in others)
    parts = [path.parent / name for name in names if name.lower() != path.name.lower()]
    try:
        for part in parts:
            require_beside(part, path)
    except InputError as error:
        raise InputError(f"{path} is an image in several files: {error}") from None
    return parts


@contextmanager
def _opened(path: Path) -> "Iterator[tuple[TiffFile, Series]]":
    """Open a file and find the series that make the image; what goes wrong becomes one sentence."""
    import tifffile

    tiff_parts(path)
    with reading(path), _log_messages() as messages:
        # tifffile would follow Micro-Manager's index into other files, that nobody named and nothing checks.
        with tifffile.TiffFile(path, is_ndtiff=False, is_mmstack=False) as file:
            yield file, _shown_series(file)
        if any(sign in line for line in messages for sign in _DAMAGE_SIGNS):
            raise InputError(f"{path} {DAMAGED}")


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


def _shown_series(file: "TiffFile") -> "Series":
    """Return the series of pages that show what the file is of: no smaller copies, masks, labels or macros."""
    full = [one for one in file.series if not int(one.keyframe.subfiletype) & (_REDUCED | _MASK)] or file.series
    largest = max(full, key=lambda one: one.size)
    if file.flags & _SLIDES:
        return [largest]
    return [one for one in full if one.size == largest.size or not any(word in one.name.lower() for word in _ASIDE)]


def _require_one(series: "Series", path: Path) -> tuple[str, tuple[int, ...]]:
    """Return the letters and lengths of the axes; `InputError` unless the series are one image or volume."""
    first, *others = series
    require_colours(first.keyframe, path)
    if any(s.shape != first.shape for s in others):
        sizes = ", ".join("×".join(map(str, s.shape)) for s in series[:3])
        raise InputError(f"{path} has pages of different sizes ({sizes}); save the page that you want and give that")
    several = {axis: n for axis, n in zip(first.axes, first.shape, strict=True) if n > 1}
    if others and first.kind != "ome" and not set(several) & set(_DEPTH):  # pages written one by one
        return _DEPTH[0] + first.axes, (1 + len(others), *first.shape)
    other = [n for axis, n in several.items() if axis not in "YX" + _DEPTH + _CHANNELS]
    if other or others:
        count = math.prod(other) * len(series)
        raise InputError(f"{path} is a series of {count} images or time points; save one of them and give that")
    return first.axes, first.shape


def _require_room(series: "Series", path: Path, found: Scale) -> None:
    """Raise `InputError` unless the pixels can be in the file and fit into memory, and the largest piece too."""
    page, count = series[0].keyframe, sum(one.size for one in series)
    size = np.dtype(page.dtype).itemsize
    piece = math.prod(page.chunks) * size
    require_room(path, piece)
    if int(page.compression) != _PLAIN and max(page.databytecounts, default=0) > 2 * piece + _TABLES:
        raise InputError(f"{path} {DAMAGED}")  # unpacked, it would be far longer than its piece of the picture
    packed = count * page.bitspersample // 8
    require_room(path, packed, held=count * (size + _KEPT), remedy=_smaller(series[0], path, size + _KEPT, found))


def _smaller(series: "TiffPageSeries", path: Path, size: int, found: Scale) -> str:
    """Return what to do with a slide that is too large, or with any other image."""
    pages = [level.keyframe for level in series.levels]
    if len(pages) < 2:
        return CROP
    names = [f"{k} ({page.imagewidth}×{page.imagelength})" for k, page in enumerate(pages)]
    room = available() or math.inf
    best = next((k for k, level in enumerate(series.levels) if k and level.size * size <= room), len(pages) - 1)
    (_, down, across), unit = found
    factor = UNITS[unit] * pages[0].imagewidth / pages[best].imagewidth
    scale_of = f"resolution=({1 / (across * factor):.9g}, {1 / (down * factor):.9g})"
    return (
        f"save one of its smaller levels {', '.join(names[1:])} and give that: import tifffile; "
        f"tifffile.imwrite('level.tif', tifffile.imread('{path}', level={best}), imagej=True, {scale_of}, "
        f"metadata={{'unit': '{_NAMES.get(unit, unit)}'}})"
    )


def _ordered(axes: str, values: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return pixels whose axes have letters as channels, depth, rows, columns."""
    order = sorted(range(len(axes)), key=lambda k: (axes[k] not in _CHANNELS, axes[k] in "YX", axes[k] == "X"))
    ordered = np.transpose(values, order)
    channels = math.prod(n for n, axis in zip(values.shape, axes, strict=True) if axis in _CHANNELS)
    return ordered.reshape(channels, -1, *ordered.shape[-2:])


def _image(pixels: NDArray[np.generic], found: Scale, name: str, held: np.dtype[Any]) -> Image:
    """Return pixels ``(C, Z, Y, X)`` as an image without axes of one sample."""
    used = [k for k in range(3) if pixels.shape[k + 1] > 1]
    if len(used) < 2:
        raise InputError(f"{name} has size {list(pixels.shape[1:])}; give an image with at least two axes")
    ((depth, down, across), unit), shape = found, tuple(pixels.shape[k + 1] for k in used)
    told = () if depth > 0 or 0 not in used else (f"{name} {_NO_DEPTH}",)
    spacing = (depth if depth > 0 else across, down, across)
    data = torch.from_numpy(np.ascontiguousarray(pixels, dtype=held).reshape(1, -1, *shape))
    kind = "uint8" if pixels.dtype.kind == "b" else pixels.dtype.name
    grid = Grid(shape, tuple(spacing[k] for k in used))
    return Image(data, grid, name=name, pixel_type=kind, unit=unit, remarks=told)


def can_page(values: NDArray[np.generic], dim: int) -> bool:
    """Return whether `write_tiff` can write values ``(C, *S)``: ImageJ has no colours in 2D but those of 8 bits."""
    return values.dtype.name in _TYPES and (dim == 3 or values.dtype == np.uint8 or len(values) not in (3, 4))


def write_tiff(values: NDArray[np.generic], spacing: Sequence[float], unit: str, path: Path) -> None:
    """Write an image as the pages of a TIFF for ImageJ, with its scale in the description.

    Args:
        values: ``(C, Y, X)`` or ``(C, Z, Y, X)`` of a type that ImageJ has: uint8, uint16 or float32.
        spacing: distances of pages, if there are any, rows and columns in ``unit``.
        unit: one of `UNITS`.
        path: the file.
    """
    import tifffile

    depth, down, across = (1.0, *spacing)[-3:]
    values = values.reshape(len(values), -1, *values.shape[-2:])
    colour = values.dtype == np.uint8 and len(values) in (3, 4)
    tifffile.imwrite(
        path,
        np.moveaxis(values, 0, -1 if colour else 1),
        imagej=True,
        photometric="rgb" if colour else "minisblack",
        resolution=(1 / across, 1 / down),
        metadata={"axes": "ZYXS" if colour else "ZCYX", "spacing": depth, "unit": _NAMES.get(unit, unit)},
    )
