"""Conversion between tensors (array order z, y, x) and SimpleITK's images (x, y, z, LPS mm); the only place for it."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from torchdeform.core.grid import Grid, slabs
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io.files import atomic_folder, native_stderr
from torchdeform.io.gate import DAMAGED
from torchdeform.io.validation import NOT_SQUARE

if TYPE_CHECKING:
    import SimpleITK as sitk

# What the libraries below ITK print, instead of raising an error, when a file is cut off.
_DAMAGE_SIGNS = ("TIFFReadDirectory", "TIFFFetchDirectory", "TIFFFillStrip", "not read completely")

# How much the columns of a direction matrix may deviate from unit length and right angles.
_SQUARE = 1e-3

# NIfTI's units of space are the last three bits of this number. ITK gives mm whatever they are.
_NIFTI_UNITS, _SPACE_BITS, _MICROMETRES = "xyzt_units", 7, 3

_Result = TypeVar("_Result")


def load(path: Path, kind: str = "") -> "sitk.Image":
    """Read a file with SimpleITK. A fourth axis is dropped if it holds only one volume.

    Args:
        path: the file.
        kind: name of the reader of ITK, say ``PNGImageIO``; by default ITK chooses by the name of the file.

    Raises:
        InputError: the file is cut off, or holds a series.
        RuntimeError: ITK cannot read it, in ITK's own words; the caller may try another reader.
    """
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO(kind)
    with native_stderr() as printed, _no_warnings():
        image = _execute(reader)
    if any(sign in line for line in printed for sign in _DAMAGE_SIGNS):
        raise InputError(f"{path} {DAMAGED}")
    if isinstance(image, RuntimeError):
        raise image
    return image


def values(path: Path) -> NDArray[np.generic]:
    """Return the pixels of a file as SimpleITK gives them, channels last; raises like `load`."""
    import SimpleITK as sitk

    return sitk.GetArrayFromImage(load(path))


def _execute(reader: "sitk.ImageFileReader") -> "sitk.Image | RuntimeError":
    """Read the reader's file, a series of one volume as that volume. ITK's error is returned, not raised."""
    try:
        reader.ReadImageInformation()
        size = reader.GetSize()
        if max(size[3:], default=1) > 1:
            file, frame = reader.GetFileName(), "[:, :, :, 0]" if len(size) == 4 else "[:, :, :, 0, 0]"
            raise InputError(
                f"{file} is a series of {math.prod(size[3:])} volumes, size {size}; take one out and give that: "
                f'SimpleITK.WriteImage(SimpleITK.ReadImage("{file}"){frame}, "frame.nii.gz")'
            )
        reader.SetExtractSize([*size[:3], *[0] * len(size[3:])])
        return reader.Execute()
    except RuntimeError as error:
        return error


def quietly(work: Callable[[], _Result]) -> "_Result | RuntimeError":
    """Return what ``work`` returns, or the error that it raises. What ITK prints is dropped."""
    with native_stderr(), _no_warnings():
        try:
            return work()
        except RuntimeError as error:
            return error


def save(image: "sitk.Image", path: Path) -> None:
    """Write a file with SimpleITK, complete or not at all, compressed if the format can.

    Raises:
        InputError: the format cannot hold the image, or the folder cannot be written.
    """
    import SimpleITK as sitk

    with atomic_folder(path.parent) as folder, native_stderr(), _no_warnings():
        try:
            sitk.WriteImage(image, str(folder / path.name), useCompression=True)
        except RuntimeError as error:
            said = f"{path.name} cannot be written: {reason(error)}; choose another format or folder"
            raise InputError(said) from error


def reason(error: RuntimeError) -> str:
    """Return the last line of an error message of ITK, without memory addresses."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1].rpartition("): ")[2].removeprefix("sitk::ERROR: ").rstrip(". ")


class _no_warnings:
    """Switch the warnings of ITK off inside the block."""

    def __enter__(self) -> None:
        import SimpleITK as sitk

        self.before = sitk.ProcessObject.GetGlobalWarningDisplay()
        sitk.ProcessObject.SetGlobalWarningDisplay(False)

    def __exit__(self, *_: object) -> None:
        import SimpleITK as sitk

        sitk.ProcessObject.SetGlobalWarningDisplay(self.before)


def to_image(itk: "sitk.Image", name: str) -> Image:
    """Return a SimpleITK image as an `Image` with float32 pixels, without axes of one sample.

    Notes:
        A slice of a volume becomes a 2D image. It keeps its position if it is at a right angle to the dropped world
        axis. An oblique slice gets the coordinates of its own plane: distances along its rows and columns.
    """
    import SimpleITK as sitk

    values = sitk.GetArrayFromImage(itk)
    if np.iscomplexobj(values):
        raise InputError(f"{name} holds complex numbers; save their magnitude and give that")
    _require_square(itk, name)
    origin, direction, spacing = _drop_single_axes(itk)
    channels = itk.GetNumberOfComponentsPerPixel()
    shape = tuple(n for n in reversed(itk.GetSize()) if n > 1)
    if len(shape) < 2:
        raise InputError(f"{name} has size {list(itk.GetSize())}; give an image with at least two axes")
    data = torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32).reshape(1, *shape, channels))
    grid = Grid(shape, tuple(reversed(spacing)))
    rows = tuple(tuple(map(float, row)) for row in direction)
    return Image(data.movedim(-1, 1).contiguous(), grid, tuple(origin), rows, name, values.dtype.name, _unit(itk))


def _unit(itk: "sitk.Image") -> str:
    """Return the unit to show lengths in: µm for NIfTI files that say so."""
    code = itk.GetMetaData(_NIFTI_UNITS) if itk.HasMetaDataKey(_NIFTI_UNITS) else ""
    return "µm" if code.isdigit() and int(code) & _SPACE_BITS == _MICROMETRES else "mm"


def _require_square(itk: "sitk.Image", name: str) -> None:
    """Raise `InputError` unless the axes are at right angles: MetaImage and NRRD can hold any matrix."""
    axes = np.array(itk.GetDirection()).reshape(itk.GetDimension(), -1)
    if np.abs(axes.T @ axes - np.eye(len(axes))).max() > _SQUARE:
        raise InputError(f"{name} {NOT_SQUARE}")


def _drop_single_axes(itk: "sitk.Image") -> tuple[list[float], NDArray[np.float64], list[float]]:
    """Return origin, direction and spacing of the axes (x, y, z) that have more than one sample."""
    dim = itk.GetDimension()
    keep = [k for k in range(dim) if itk.GetSize()[k] > 1]
    drop = [k for k in range(dim) if k not in keep]
    origin, direction = np.array(itk.GetOrigin()), np.array(itk.GetDirection()).reshape(dim, dim)
    columns = direction[:, keep]
    if np.abs(columns[drop]).max(initial=0.0) < 1e-5:
        return [float(origin[k]) for k in keep], columns[keep], [itk.GetSpacing()[k] for k in keep]
    return list(map(float, columns.T @ origin)), np.eye(len(keep)), [itk.GetSpacing()[k] for k in keep]


def from_values(values: NDArray[np.generic], place: Image) -> "sitk.Image":
    """Return an array ``(C, *S)`` at the position of an `Image` as a SimpleITK image, a vector image if C > 1."""
    import SimpleITK as sitk

    vector = values.shape[0] > 1
    itk = sitk.GetImageFromArray(np.ascontiguousarray(np.moveaxis(values, 0, -1) if vector else values[0]), vector)
    itk.SetOrigin(place.origin)
    itk.SetSpacing(place.grid.spacing[::-1])
    itk.SetDirection([entry for row in place.direction for entry in row])
    return itk


def to_world_vectors(u: Tensor, place: Image, kind: DTypeLike = np.float64) -> NDArray[np.floating]:
    """Return u ``(1, D, *S)`` (array order, units of spacing) as ITK's vectors ``(D, *S)``: direction · (x, y, z).

    They are computed in float64. Their memory layout is that of ITK: the components of one node are adjacent.
    """
    dim, shape = place.grid.dim, place.grid.shape
    found = np.empty((*shape, dim), dtype=kind)
    for rows in slabs(shape, u.device):
        vectors = u[0, :, rows].detach().cpu().to(torch.float64).flip(0).numpy()
        found[rows] = np.einsum("ij,j...->...i", _matrix(place.direction), vectors)
    return np.moveaxis(found, -1, 0)


def to_grid_vectors(vectors: Tensor, place: Image) -> Tensor:
    """Return ITK's vectors ``(1, D, *S)`` as u in array order and units of spacing; inverse of `to_world_vectors`."""
    inverse = torch.from_numpy(np.linalg.inv(_matrix(place.direction)))
    return torch.einsum("ij,bj...->bi...", inverse, vectors.double()).flip(1).to(vectors.dtype)


def _matrix(rows: Sequence[Sequence[float]]) -> NDArray[np.float64]:
    return np.array(rows, dtype=np.float64)
