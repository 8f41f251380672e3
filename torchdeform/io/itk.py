"""Conversion between tensors (array order z, y, x) and SimpleITK's images (x, y, z, LPS mm); the only place for it."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from torchdeform.core.grid import Grid, slabs
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io.files import atomic_file, native_stderr
from torchdeform.io.loading import no_warnings, reason, volume_of
from torchdeform.io.volume import Volume, held_type, squared

if TYPE_CHECKING:
    import SimpleITK as sitk


def save(image: "sitk.Image", path: Path) -> None:
    """Write a file with SimpleITK, complete or not at all, compressed if the format can.

    Raises:
        InputError: the format cannot hold the image, or the folder cannot be written.
    """
    import SimpleITK as sitk

    with atomic_file(path) as new, native_stderr(), no_warnings():
        try:
            sitk.WriteImage(image, str(new), useCompression=True)
        except RuntimeError as error:
            said = f"{path.name} cannot be written: {reason(error)}; choose another format or folder"
            raise InputError(said) from error


def to_image(itk: "sitk.Image", name: str) -> Image:
    """Return a SimpleITK image as `volume_image` does."""
    return volume_image(volume_of(itk), name)


def volume_image(volume: Volume, name: str, *, exact: bool = False) -> Image:
    """Return a volume as an `Image` with float32 pixels, without axes of one sample.

    Args:
        volume: what a reader found.
        name: of the image.
        exact: whether the pixels become float64 where float32 would merge values of their type.

    Notes:
        A slice of a volume becomes a 2D image. It keeps its position if it is at a right angle to the dropped world
        axis. An oblique slice gets the coordinates of its own plane: distances along its rows and columns.
        Directions that were rounded are replaced by the nearest at right angles.
    """
    values = volume.values
    if np.iscomplexobj(values):
        raise InputError(f"{name} holds complex numbers; save their magnitude and give that")
    origin, direction, spacing = _drop_single_axes(volume, squared(volume.direction, name))
    shape = tuple(n for n in volume.size[::-1] if n > 1)
    if len(shape) < 2:
        raise InputError(f"{name} has size {list(volume.size)}; give an image with at least two axes")
    kind = held_type(values.dtype, exact=exact)
    with np.errstate(over="ignore"):
        data = torch.from_numpy(np.ascontiguousarray(values, dtype=kind).reshape(1, *shape, values.shape[-1]))
    grid = Grid(shape, tuple(reversed(spacing)))
    rows = tuple(tuple(map(float, row)) for row in direction)
    data = data.movedim(-1, 1).contiguous()
    return Image(data, grid, tuple(origin), rows, name, values.dtype.name, volume.unit, volume.remarks)


def _drop_single_axes(
    volume: Volume, direction: NDArray[np.float64]
) -> tuple[list[float], NDArray[np.float64], list[float]]:
    """Return origin, direction and spacing of the axes (x, y, z) that have more than one sample."""
    keep = [k for k, n in enumerate(volume.size) if n > 1]
    drop = [k for k, n in enumerate(volume.size) if n == 1]
    columns, spacing = direction[:, keep], [volume.spacing[k] for k in keep]
    if np.abs(columns[drop]).max(initial=0.0) < 1e-5:
        return [float(volume.origin[k]) for k in keep], columns[keep], spacing
    return list(map(float, columns.T @ np.array(volume.origin))), np.eye(len(keep)), spacing


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
