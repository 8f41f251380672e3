"""Displacement fields as the Learn2Reg challenge reads them: in voxels, for the NumPy arrays of NIfTI files."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchdeform.core.image import Image
from torchdeform.io import itk


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
