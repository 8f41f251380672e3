"""Displacement fields and transforms on disk, as ITK reads them: LPS mm in x, y, z order, points fixed -> moving."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import torch
from torch import Tensor

from torchdeform.core.image import Image
from torchdeform.core.transform import Affine, Displacement, Stage, Transform
from torchdeform.errors import InputError
from torchdeform.io import elastix, itk, itk_maps, matrices
from torchdeform.io.files import atomic_file, native_stderr, read_head, require_space, suffix
from torchdeform.io.gate import require_file
from torchdeform.io.loading import reason
from torchdeform.io.maps import Linear, Spline
from torchdeform.io.volume import Volume
from torchdeform.io.volumes import read_volume

if TYPE_CHECKING:
    import SimpleITK as sitk

_Path = str | os.PathLike[str]

# Endings of files, by their content.
COMPOSITES = (".h5", ".hdf5")
AFFINES = (".tfm", ".txt", ".mat")
FIELDS = (".nii.gz", ".nii", ".mha", ".mhd", ".nrrd")


# NIfTI's intents of warps that FSL writes: fields and coefficients.
_FSL_INTENTS = (2006, 2007, 2008, 2009)
# Vectors that miss the places of their voxels by a smaller share of the places' spread are positions.
_POSITIONS = 0.2
# Voxels around the domain of a spline that still belong to it.
_NONE = 1e-6


def write_displacement(u: Tensor, fixed: Image, path: _Path) -> None:
    """Write u as an ITK displacement field: a vector image on the fixed grid, direction · (u_x, u_y, u_z) in mm.

    Args:
        u: displacement ``(1, D, *S)`` on the fixed grid, array order, units of spacing.
        fixed: the image whose grid u is given on.
        path: the file, ``.nii.gz``, ``.mha`` or ``.nrrd``; an existing one is replaced.

    Raises:
        InputError: shape, more than one item, or a folder that cannot be written.

    Notes:
        The world position of a voxel of the fixed image plus its vector is the world position in the moving image
        whose value belongs to that voxel, as in ITK and ANTs. Stored as float32.
    """
    _check_field(u, fixed, "write_displacement: u")
    itk.save(itk.from_values(itk.to_world_vectors(u, fixed, np.float32), fixed), Path(path))


def read_displacement(path: _Path) -> Image:
    """Read an ITK displacement field; the inverse of `write_displacement`.

    Returns:
        An image whose ``data`` is u ``(1, D, *S)`` in array order and units of spacing, with its grid and position.

    Raises:
        InputError: the file is missing, damaged, a field of FSL or of positions, or not a field of D components.

    Notes:
        The components may also stand on a fourth axis ``(x, y, z, 3)``, as arrays have them; they too are LPS mm.
    """
    file = Path(path)
    require_file(file, "displacement field")
    volume = read_volume(file, vectors=True)
    if volume.intent in _FSL_INTENTS:
        raise InputError(
            f"{path} is a warp of FSL; convert it with `wb_command -convert-warpfield -from-fnirt {file.name} "
            "moving.nii.gz -to-itk field.nii.gz`"
        )
    if volume.stacked:
        _require_displacements(volume, file)
    return _to_field(itk.volume_image(volume, str(path)))


def _require_displacements(volume: Volume, path: Path) -> None:
    """Raise `InputError` if vectors are rather the positions that nodes go to, in LPS or RAS, than displacements."""
    index = np.stack(np.meshgrid(*map(np.arange, volume.size), indexing="ij"), axis=-1) * volume.spacing
    places = index @ volume.direction.T + volume.origin
    values = volume.values.swapaxes(0, -2)[..., :2].astype(np.float64)
    for positions in (places[..., :2], -places[..., :2]):
        if np.std(values - positions) < _POSITIONS * np.std(positions):
            raise InputError(f"{path} holds positions, not displacements; subtract from each voxel its place in LPS mm")


def voxel_displacement(u: Tensor, fixed: Image, moving: Image) -> Tensor:
    """Return d with ``index of moving = index of fixed + d`` for φ = id + u, both images at their world position.

    Args:
        u: displacement ``(1, D, *S)`` on the fixed grid, array order, units of spacing.
        fixed: the image whose grid u is given on.
        moving: the image that φ maps to.

    Returns:
        ``(1, D, *S)`` in voxels, component k along array axis k, float64.
    """
    points = fixed.grid.points(dtype=torch.float64)
    target = moving.to_grid(fixed.to_world(points + u.cpu()))
    there = target / moving.grid.along(moving.grid.spacing, target)
    return there - points / fixed.grid.along(fixed.grid.spacing, points)


def write_voxel_displacement(u: Tensor, fixed: Image, moving: Image, path: Path) -> None:
    """Write the displacement as the challenge's evaluation reads it: an array ``(X, Y, Z, 3)`` of voxels (x, y, z).

    Args:
        u: displacement ``(1, D, *S)`` on the fixed grid, array order, units of spacing.
        fixed: the image whose grid u is given on.
        moving: the image that φ maps to.
        path: the file, ``.nii.gz``; an existing one is replaced.

    Raises:
        InputError: a folder that cannot be written.

    Notes:
        The evaluation computes ``map_coordinates(moving, identity + displacement)`` on arrays as nibabel returns them,
        whose axes are x, y, z. It reads no header. The type is float32, the smallest floating type of NIfTI.
    """
    import SimpleITK as sitk

    dim = fixed.grid.dim
    values = voxel_displacement(u, fixed, moving)[0].flip(0).numpy().astype(np.float32)
    image = sitk.GetImageFromArray(values, isVector=False)
    direction = np.eye(dim + 1)
    direction[:dim, :dim] = fixed.direction
    image.SetSpacing((*fixed.grid.spacing[::-1], 1.0))
    image.SetOrigin((*fixed.origin, 0.0))
    image.SetDirection(direction.flatten().tolist())
    itk.save(image, path)


@overload
def write_transform(transform: Transform, path: _Path, /) -> None: ...
@overload
def write_transform(transform: Tensor, fixed: Image, path: _Path, /) -> None: ...
def write_transform(transform: Transform | Tensor, *where: Any) -> None:
    """Write a transform for ITK, in the form of the file's ending; points go from fixed to moving.

    Args:
        transform: the chain; or a displacement u ``(1, D, *S)`` (array order, units of spacing) of φ = id + u, followed
            by the fixed image whose grid it is given on.
        where: the file; an existing one is replaced. ``.h5`` keeps every stage (ITK composite, float64). ``.tfm``,
            ``.txt`` and ``.mat`` hold affine maps only, joined into one. ``.nii.gz``, ``.mha`` and ``.nrrd`` hold the
            whole chain as one displacement field on its `reference` (float32).

    Raises:
        InputError: shape, an ending that cannot hold the transform, or a folder that cannot be written.

    Notes:
        `SimpleITK.ReadTransform`, ANTs and 3D Slicer read the file. It maps points of the fixed space to the moving
        space, as a resampler needs it to warp the moving image onto the fixed one.
    """
    *fixed, path = where
    if isinstance(transform, Tensor):
        _check_field(transform, fixed[0], "write_transform: u")
        transform = Transform.from_displacement(transform, fixed[0])
    file = Path(path)
    require_transform_file(file, transform)
    if suffix(file) in FIELDS:
        whole = transform.flatten().field
        write_displacement(whole.data, whole, file)
    elif suffix(file) in COMPOSITES:
        _save(_composite(transform), file)
    else:
        _save(_affine(reduce(Affine.then, (s for s in transform.stages if isinstance(s, Affine)))), file)


def require_transform_file(path: Path, transform: Transform | None = None) -> None:
    """Raise `InputError` unless files of this ending can hold transforms, and this transform if it is given."""
    ending = suffix(path)
    if ending not in (*COMPOSITES, *AFFINES, *FIELDS):
        known = ", ".join((*COMPOSITES, *AFFINES, *FIELDS))
        raise InputError(f"{path} has no ending that transforms are written with ({known}); use the ending .h5")
    if transform is None:
        return
    if ending in AFFINES and not all(isinstance(stage, Affine) for stage in transform.stages):
        raise InputError(
            f"{path}: {ending} files hold affine maps only, but this transform has a displacement; use .h5"
        )
    if ending in FIELDS and transform.reference is None:
        raise InputError(f"{path}: a displacement field needs a grid; give the fixed image as reference, or use .h5")


def read_transform(path: _Path) -> Transform:
    """Read a transform of ITK, ANTs, elastix, greedy, FreeSurfer or this library. It maps points from fixed to moving.

    Args:
        path: a file of ITK (``.h5``, ``.tfm``, ``.txt``, ``.mat``, such as ``0GenericAffine.mat`` of ANTs) with linear
            maps of any kind, displacement fields, B-splines, or composites of them; ``TransformParameters.0.txt`` of
            elastix; a matrix as text (RAS, as greedy and c3d write it); an LTA of FreeSurfer; or a displacement field
            as an image (``.nii.gz``, ``.mha``, ``.nrrd``, such as ``1Warp.nii.gz`` of ANTs).

    Returns:
        The transform, float64. Its `reference` is the grid of a displacement that comes first. A B-spline becomes a
        displacement on its domain, whose linear interpolation misses it by 0.02 mm at most, or by 0.01 of a cell of
        its mesh where that would take more than 2²⁴ nodes.

    Raises:
        InputError: the file is missing, damaged, of another kind, or holds a transform of another kind.

    Notes:
        Images go the other way than points.
    """
    file = Path(path)
    require_file(file, "transform")
    if suffix(file) in FIELDS:
        field = read_displacement(file)
        return Transform((Displacement(replace(field, data=field.data.double())),))
    return Transform(tuple(_stage(part, str(path)) for part in _maps(file)))


def _maps(path: Path) -> Sequence[Linear | Spline | Volume]:
    """Return the maps of a file by its content: a text of elastix, a matrix, else what ITK reads."""
    head = read_head(path, 4096)
    if elastix.is_elastix(head):
        return elastix.read(path)
    if matrices.is_matrix(head):
        return matrices.read(path)
    known = f"an ITK transform ({', '.join((*COMPOSITES, *AFFINES))}) or a displacement field"
    return itk_maps.read(path, known)


def _stage(part: Linear | Spline | Volume, name: str) -> Stage:
    if isinstance(part, Linear):
        try:
            return Affine(torch.from_numpy(part.matrix), torch.from_numpy(part.offset))
        except InputError as error:
            raise InputError(f"{name} cannot be used: {error}; make it again") from error
    field = part.dense(name) if isinstance(part, Spline) else part
    if not np.isfinite(field.values).all():
        raise InputError(f"{name} holds vectors that are not finite; make it again")
    u = _to_field(itk.volume_image(field, name, exact=True))
    return Displacement(u, margin=_NONE) if isinstance(part, Spline) else Displacement(u)


def _to_field(vectors: Image) -> Image:
    """Return ITK's vectors as u in array order and units of spacing."""
    if vectors.data.shape[1] != vectors.grid.dim:
        parts = f"{vectors.data.shape[1]} components on a {vectors.grid.dim}D grid"
        hint = "give a vector image like displacement.nii.gz"
        raise InputError(f"{vectors.name} has {parts}, so it is no displacement field; {hint}")
    return replace(vectors, data=itk.to_grid_vectors(vectors.data, vectors))


def _composite(transform: Transform) -> "sitk.Transform":
    import SimpleITK as sitk

    return sitk.CompositeTransform([_TO_ITK[type(stage)](stage) for stage in reversed(transform.stages)])


def _affine(affine: Affine) -> "sitk.Transform":
    import SimpleITK as sitk

    matrix = affine.matrix.detach().cpu().double().flatten().tolist()
    return sitk.AffineTransform(matrix, affine.offset.detach().cpu().double().tolist())


def _displacement(stage: Displacement) -> "sitk.Transform":
    import SimpleITK as sitk

    return sitk.DisplacementFieldTransform(
        itk.from_values(itk.to_world_vectors(stage.field.data, stage.field), stage.field)
    )


_TO_ITK: dict[type, Callable[[Any], "sitk.Transform"]] = {Affine: _affine, Displacement: _displacement}


def _save(transform: "sitk.Transform", path: Path) -> None:
    import SimpleITK as sitk

    with atomic_file(path) as new:
        require_space(new.parent, 8 * transform.GetNumberOfParameters())  # HDF5 cannot close a file on a full disk
        try:
            with native_stderr():
                sitk.WriteTransform(transform, str(new))
        except RuntimeError as error:
            raise InputError(f"{path} cannot be written: {reason(error)}; use the ending .h5") from error


def _check_field(u: Tensor, fixed: Image, name: str) -> None:
    fixed.grid.check_vector(u, name)
    if u.shape[0] != 1:
        raise InputError(f"{name} must hold one displacement, got a batch of {u.shape[0]}; write them one by one")
