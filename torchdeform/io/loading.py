"""Files read by ITK, without torch, so that a process of its own can do it."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.files import is_tiff, native_stderr
from torchdeform.io.gate import DAMAGED, require_room
from torchdeform.io.volume import Volume, is_stack, require_one

if TYPE_CHECKING:
    import SimpleITK as sitk

# What the libraries below ITK print, instead of raising an error, when a file is cut off.
_DAMAGE_PRINTED = ("not read completely",)

# What the readers of ITK say about a file that is cut off, each in its own words.
_DAMAGE_SAID = (
    "fread got only",
    "inflate",
    "Cannot read requested file",
    "unexpected end",
    "couldn't parse",
    "Success",
)

_TOO_LARGE = "is, by its header, larger than the memory here; if it is not, the header is damaged"

_Result = TypeVar("_Result")


def load(path: Path, reader: str = "", vectors: bool = False) -> "sitk.Image":
    """Read a file with SimpleITK. A fourth axis is dropped if it holds only one volume.

    Args:
        path: the file.
        reader: the name of ITK's reader; by default the one that takes the file.
        vectors: whether a fourth axis that can hold vectors is kept.

    Raises:
        InputError: the file is cut off, holds a series, or is a TIFF, at which ITK may crash: see `tiff`.
        RuntimeError: ITK cannot read it, in ITK's own words; the caller may try another reader.
    """
    if is_tiff(path):
        raise InputError(f"{path} is a TIFF, which cannot hold what is needed here; convert it to .nii.gz")
    with native_stderr(stdout=True) as printed, no_warnings():
        image = _execute(_reader(path, reader), vectors)
    if any(sign in line for line in printed for sign in _DAMAGE_PRINTED):
        raise InputError(f"{path} {DAMAGED}")
    if isinstance(image, RuntimeError):
        raise image
    return image


def read_by_itk(path: Path, reader: str = "", vectors: bool = False) -> Volume:
    """Read a file with SimpleITK as a `Volume`.

    Args:
        path: the file.
        reader: the name of ITK's reader; by default the one that takes the file.
        vectors: whether a fourth axis that can hold vectors does.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        return volume_of(load(path, reader, vectors))
    except RuntimeError as error:
        raise InputError(f"{path} {_fault(reason(error))}") from error
    except MemoryError as error:
        raise InputError(f"{path} {_TOO_LARGE}") from error


def size_by_itk(path: Path) -> tuple[tuple[int, ...], int] | None:
    """Return the size (x, y, z) and the number of channels that ITK finds in the header, None if it finds none."""
    reader = _reader(path)
    if isinstance(quietly(reader.ReadImageInformation), RuntimeError):
        return None
    return reader.GetSize(), reader.GetNumberOfComponents()


def volume_of(image: "sitk.Image") -> Volume:
    """Return the pixels and the place of a SimpleITK image; numbers on a fourth axis become those of one pixel."""
    import SimpleITK as sitk

    dim = image.GetDimension()
    values = sitk.GetArrayFromImage(image).reshape(*reversed(image.GetSize()), image.GetNumberOfComponentsPerPixel())
    direction = np.array(image.GetDirection()).reshape(dim, dim)
    if dim == 4:
        values = np.moveaxis(values, 0, -2).reshape(*values.shape[1:4], -1)
    return Volume(values, image.GetSpacing()[:3], image.GetOrigin()[:3], direction[:3, :3], stacked=dim == 4)


def _reader(path: Path, name: str = "") -> "sitk.ImageFileReader":
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO(name)
    return reader


def _execute(reader: "sitk.ImageFileReader", vectors: bool) -> "sitk.Image | RuntimeError":
    """Read the reader's file, a series of one volume as that volume. ITK's error is returned, not raised."""
    try:
        reader.ReadImageInformation()
        path, size = Path(reader.GetFileName()), reader.GetSize()
        if not reader.GetImageIO():  # else its header was checked before
            require_room(path, math.prod(size) * reader.GetNumberOfComponents())
        if vectors and reader.GetNumberOfComponents() == 1 and is_stack(size):
            return reader.Execute()
        require_one(path, size)
        reader.SetExtractSize([*size[:3], *[0] * len(size[3:])])
        return reader.Execute()
    except RuntimeError as error:
        return error


def quietly(work: Callable[[], _Result]) -> "_Result | RuntimeError":
    """Return what ``work`` returns, or the error that it raises. What ITK prints is dropped."""
    with native_stderr(), no_warnings():
        try:
            return work()
        except RuntimeError as error:
            return error


def reason(error: RuntimeError) -> str:
    """Return the last line of an error message of ITK, without memory addresses."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].rpartition("): ")[2].removeprefix("sitk::ERROR: ").rstrip(". ") if lines else "no reason given"


def _fault(said: str) -> str:
    """Return what is wrong with a file that ITK refuses, and what to do."""
    if any(sign in said for sign in _DAMAGE_SAID):
        return DAMAGED
    if "llocate memory" in said or "bad_alloc" in said:
        return _TOO_LARGE
    if "determine ImageIO" in said:
        return "is no image of a known format; convert it to PNG, TIFF, NIfTI, MetaImage or NRRD"
    return f"cannot be read ({said}); export it again, or as another format"


class no_warnings:
    """Switch the warnings of ITK off inside the block."""

    def __enter__(self) -> None:
        import SimpleITK as sitk

        self.before = sitk.ProcessObject.GetGlobalWarningDisplay()
        sitk.ProcessObject.SetGlobalWarningDisplay(False)

    def __exit__(self, *_: object) -> None:
        import SimpleITK as sitk

        sitk.ProcessObject.SetGlobalWarningDisplay(self.before)
