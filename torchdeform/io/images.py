"""Reading and writing images with their exact position in the world; labels keep every value and their type."""

import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import dicom, itk
from torchdeform.io.dicom_header import may_be_dicom
from torchdeform.io.files import atomic_file, is_tiff, suffix
from torchdeform.io.gate import require_file
from torchdeform.io.kinds import GZIP, kind_of, known_otherwise
from torchdeform.io.packed import unpack
from torchdeform.io.pictures import is_picture, picture_size, read_picture
from torchdeform.io.tiff import can_page, read_tiff, tiff_size, write_tiff
from torchdeform.io.volumes import read_volume, volume_size


@dataclass(frozen=True)
class Format:
    """What a file format can hold: pixel types, the widest last, and numbers of channels (any when empty)."""

    types: tuple[str, ...]
    channels: tuple[int, ...] = ()


_EIGHT_BITS = Format(("uint8",), (1, 3))
_TIFF = Format(("uint8", "uint16", "int16", "float32"))
_VOLUME = Format(("float32",))

FORMATS: dict[str, Format] = {
    ".png": Format(("uint8", "uint16"), (1, 3, 4)),
    ".jpg": _EIGHT_BITS,
    ".jpeg": _EIGHT_BITS,
    ".bmp": Format(("uint8",), (1, 3, 4)),
    ".tif": _TIFF,
    ".tiff": _TIFF,
    ".nii": _VOLUME,
    ".nii.gz": _VOLUME,
    ".mha": _VOLUME,
    ".mhd": _VOLUME,
    ".nrrd": _VOLUME,
    ".nhdr": _VOLUME,
}

# Pictures that are not written: as PNG instead. And slides: as TIFF.
_PICTURES = (".gif", ".webp", ".jp2", ".j2k")
_SLIDES = (".svs", ".ndpi", ".scn", ".bif", ".qptiff", ".lsm", ".btf", ".tf8")


def read_image(path: str | os.PathLike[str]) -> Image:
    """Read a 2D or 3D image: DICOM, NIfTI, MGH, MetaImage, NRRD, PNG, JPEG, TIFF, slides and other formats of ITK.

    Args:
        path: the file, plain or compressed with gzip; a folder with one DICOM series; or one file of a series. What
            it holds counts, not its name.

    Returns:
        The image: float32 pixels, one or several channels, with origin, spacing and direction (LPS mm) of the file.

    Raises:
        InputError: the file is missing, empty, damaged, of an unknown format, has several volumes or complex numbers;
            a header that makes no sense; axes that are not at right angles; a folder without DICOM files or with
            several series; slices that are missing or double; or a NIfTI file with NaN or infinite voxels.

    Notes:
        An axis with one sample is dropped, so a volume of one slice is a 2D image. It keeps its position if it is at a
        right angle to the dropped world axis; an oblique slice gets the coordinates of its own plane.
        One DICOM file is read as its whole series if that is a volume, see `dicom.read_file`.
        TIFF and pictures are known by content, whatever their name, and turned and coloured as a viewer shows them. The
        pages of a TIFF are a volume. The dots per inch of a print are no scale, see `tiff_scale.scale`.
    """
    return _read(Path(path))


def _read(file: Path, *, exact: bool = False) -> Image:
    """Read by the reader of what the file holds; ``exact`` as in `volume_image`."""
    if file.is_dir():
        return dicom.read_folder(file)
    require_file(file, "image file")
    if may_be_dicom(file):
        return dicom.read_file(file)
    if is_tiff(file):
        return read_tiff(file, exact=exact)
    if is_picture(file):
        return read_picture(file)
    if kind_of(file) == GZIP:
        return _read_gzip(file, exact=exact)
    return itk.volume_image(read_volume(file), str(file), exact=exact)


def read_optional(path: Path | None) -> Image | None:
    """Return the image of a file that may be left out."""
    return None if path is None else read_image(path)


def _read_gzip(path: Path, *, exact: bool) -> Image:
    """Unpack a file into a temporary folder and read it there."""
    if found := known_otherwise(path):
        raise InputError(f"{path} {found}")
    with tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder) / (path.name.removesuffix(".gz") or "image")
        unpack(path, unpacked)
        try:
            return replace(_read(unpacked, exact=exact), name=str(path))
        except InputError as error:
            raise InputError(str(error).replace(str(unpacked), str(path))) from error


def write_image(image: Image, path: str | os.PathLike[str]) -> None:
    """Write an image with its position in the world, in the format of the file's ending.

    Args:
        image: 2D or 3D. Picture formats that can hold its ``pixel_type`` keep it (rounded and clamped for integers);
            volume formats (NIfTI, MetaImage, NRRD) get float32.
        path: the file; an existing one is replaced, missing folders are created.

    Raises:
        InputError: unknown ending, pixels that the format cannot hold, or a folder that cannot be written.

    Notes:
        The file appears complete or not at all. JPEG and BMP keep no spacing.
    """
    file = Path(path)
    pixels = _stored(image, file)
    if suffix(file) in (".tif", ".tiff") and can_page(pixels, image.grid.dim):
        with atomic_file(file) as new:
            write_tiff(pixels, list(map(image.in_unit, image.grid.spacing)), image.unit, new)
    else:
        itk.save(itk.from_values(pixels, image), file)


def _stored(image: Image, path: Path) -> NDArray[np.generic]:
    """Return the pixels ``(C, *S)`` in the type to store; `InputError` if the format cannot hold them."""
    ending = suffix(path)
    if ending not in FORMATS:
        raise InputError(f"{path} has no ending that can be written; use one of {', '.join(FORMATS)}")
    if not can_hold(ending, image):
        what = f"{image.grid.dim}D {image.pixel_type} images of {image.data.shape[1]} channels"
        raise InputError(f"{path}: {ending} files cannot hold {what}; use .tif or .nii.gz")
    kind, values = _stored_type(ending, image), image.data[0].detach().cpu().numpy()
    if kind.kind == "f":
        return values.astype(kind)
    limits = np.iinfo(kind)
    return np.rint(values).clip(limits.min, limits.max).astype(kind)


def _stored_type(ending: str, image: Image) -> np.dtype[Any]:
    """Return the type in which files of this ending store the image."""
    types = FORMATS[ending].types
    return np.dtype(image.pixel_type if image.pixel_type in types else types[-1])


def require_storable(value: float | str, ending: str, image: Image, *, labels: bool = False) -> None:
    """Raise `InputError` unless a value outside of the image fits into files of this ending; words always do."""
    kind: np.dtype[Any] = np.dtype(image.pixel_type) if labels else _stored_type(ending, image)
    if isinstance(value, str) or kind.kind == "f":
        return
    limits = np.iinfo(kind)
    if not limits.min <= value <= limits.max:
        raise InputError(
            f"outside: {image.name} is stored as {kind}, which holds {limits.min} to {limits.max}, so {value:g} does "
            "not fit; choose another value, or auto"
        )


def can_hold(ending: str, image: Image) -> bool:
    """Return whether files of this ending can hold the image's dimension, channels and pixel type."""
    form = FORMATS.get(ending)
    if form is None or (form.channels and (image.grid.dim != 2 or image.data.shape[1] not in form.channels)):
        return False
    return image.pixel_type in form.types or form.types[-1] == "float32"


def ending_like(path: Path, image: Image) -> str:
    """Return the ending that stores ``image`` like the file ``path``, ``.nii.gz`` if that format cannot hold it."""
    ending = suffix(path)
    endings = (ending, ".png") if ending in _PICTURES else (ending, ".tif") if ending in _SLIDES else (ending,)
    return next((e for e in endings if can_hold(e, image)), ".nii.gz")


def image_size(path: Path) -> tuple[tuple[int, ...], int] | None:
    """Return the shape (z, y, x; without axes of one sample) and the channels of an image file, None if unknown.

    Args:
        path: a file, or a folder with a DICOM series.

    Notes:
        Reads no pixels, so the file may still be damaged. What is packed with gzip is unknown, but for NIfTI and MGH.
    """
    try:
        require_file(path, "image file", folder=True)
        found = _size(path)
    except InputError:  # reading will say why
        return None
    if found is None:
        return None
    shape = tuple(n for n in found[0] if n > 1)
    return (shape, found[1]) if len(shape) in (2, 3) else None


def _size(path: Path) -> tuple[tuple[int, ...], int] | None:
    if path.is_dir() or may_be_dicom(path):
        return dicom.size(path)
    if is_tiff(path):
        return tiff_size(path)
    if is_picture(path):
        return picture_size(path)
    found = volume_size(path)
    return found and (found[0][::-1], found[1])


def read_labels(path: str | os.PathLike[str]) -> Image:
    """Read a label image: like `read_image`, but in float64 if float32 would merge labels above 2²⁴.

    Args:
        path: the file, any format that `read_image` reads.

    Returns:
        The image. A picture with three equal channels, as drawing programs save grey values, becomes one channel.

    Raises:
        InputError: as `read_image`.
    """
    image = _read(Path(path), exact=True)
    if image.data.shape[1] == 3 and bool((image.data == image.data[:, :1]).all()):
        return replace(image, data=image.data[:, :1].contiguous())
    return image


def write_labels(image: Image, path: str | os.PathLike[str]) -> None:
    """Write a label image in its own ``pixel_type``, volumes too; complete or not at all.

    Args:
        image: whole numbers, with their position in the world.
        path: the file, any format that `write_image` writes.

    Raises:
        InputError: a format that cannot hold that type, or a folder that cannot be written.
    """
    ending = suffix(Path(path))
    if FORMATS.get(ending) is _VOLUME:
        values = image.data[0].detach().cpu().numpy().astype(image.pixel_type)
        itk.save(itk.from_values(values, image), Path(path))
    elif ending in FORMATS and image.pixel_type not in FORMATS[ending].types:
        raise InputError(f"{path}: {ending} files cannot hold labels of type {image.pixel_type}; use .nii.gz")
    else:
        write_image(image, path)
