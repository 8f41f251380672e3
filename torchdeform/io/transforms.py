"""Displacement fields and transforms on disk as ITK reads them: LPS millimetres, x, y, z, points fixed -> moving."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.image import Image
from torchdeform.io import itk
from torchdeform.io.complaints import require_sound
from torchdeform.io.files import native_stderr, staged


def write_displacement(u: Tensor, fixed: Image, path: str | os.PathLike[str]) -> None:
    """Write u as an ITK displacement field: a vector image on the fixed grid, direction · (u_x, u_y, u_z) in mm.

    Args:
        u: displacement ``(1, D, *S)`` on the fixed grid, array order, units of spacing.
        fixed: the image whose grid it lives on.
        path: the file, ``.nii.gz``, ``.mha`` or ``.nrrd``; replaced whole.

    Raises:
        InputError: shape, more than one item, or a place that cannot be written.

    Notes:
        Adding the vector to the world position of a voxel of the fixed image gives the world position in the moving
        image whose value belongs there, as in ITK and ANTs. float32.
    """
    file = Path(path)
    field = _world_field(u, fixed, "write_displacement: u").astype(np.float32)
    with staged(file.parent) as folder:
        itk.save(itk.from_values(field, fixed), folder / file.name)


def read_displacement(path: str | os.PathLike[str]) -> Image:
    """Read an ITK displacement field; the inverse of `write_displacement`.

    Returns:
        An image whose ``data`` is u ``(1, D, *S)`` in array order and units of spacing, in the place of its grid.

    Raises:
        InputError: the file is missing, damaged, or not a field of D components.
    """
    file = Path(path)
    require_sound(file)
    try:
        field = itk.to_image(itk.load(file), str(path))
    except RuntimeError as error:
        raise InputError(f"{path} cannot be read ({itk.reason(error)}); it may be damaged: write it again") from error
    if field.data.shape[1] != field.grid.dim:
        parts = f"{field.data.shape[1]} components on a {field.grid.dim}D grid"
        raise InputError(
            f"{path} has {parts}, so it is no displacement field; give a vector image like displacement.nii.gz"
        )
    return replace(field, data=itk.to_grid_vectors(field.data, field))


def write_transform(u: Tensor, fixed: Image, path: str | os.PathLike[str]) -> None:
    """Write φ = id + u as an ITK composite transform, x -> x + u(x) in LPS mm.

    Args:
        u: displacement ``(1, D, *S)`` on the fixed grid, array order, units of spacing.
        fixed: the image whose grid it lives on.
        path: the file, ``.h5`` (or ``.tfm``); replaced whole.

    Raises:
        InputError: shape, more than one item, or a place that cannot be written.

    Notes:
        `SimpleITK.ReadTransform`, ANTs and 3D Slicer read it. It takes points of the fixed space to the moving
        space, which is what a resampler needs to bring the moving image onto the fixed one. float64.
    """
    import SimpleITK as sitk

    file = Path(path)
    field = sitk.DisplacementFieldTransform(itk.from_values(_world_field(u, fixed, "write_transform: u"), fixed))
    with staged(file.parent) as folder:
        try:
            with native_stderr():
                sitk.WriteTransform(sitk.CompositeTransform([field]), str(folder / file.name))
        except RuntimeError as error:
            raise InputError(f"{path} cannot be written: {itk.reason(error)}; use the ending .h5") from error


def _world_field(u: Tensor, fixed: Image, name: str) -> "np.ndarray[tuple[int, ...], np.dtype[np.float64]]":
    fixed.grid.check_vector(u, name)
    if u.shape[0] != 1:
        raise InputError(f"{name} must hold one displacement, got a batch of {u.shape[0]}; write them one by one")
    return itk.to_world_vectors(u, fixed)
