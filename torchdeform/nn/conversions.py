"""Displacements of other libraries, from and to ours: ``(B, D, *S)``, array-axis order, units of spacing.

VoxelMorph and MONAI (`Warp`, a dense displacement field) count in voxels, components in array order, channels first:
one pair of functions serves both. kornia and `torch.nn.functional.grid_sample` want positions in the box [−1, 1],
components x, y, z last; kornia's elastic transforms want displacements in that box. ITK has vectors x, y, z last in
world millimetres (LPS). All of them pull images back, warped(x) = moving(x + u(x)), so nothing is inverted here.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError


def to_voxels(u: Tensor, grid: Grid) -> Tensor:
    """Return u / spacing, what VoxelMorph's `SpatialTransformer` and MONAI's `Warp` take.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``(B, D, *S)`` in voxels, component k along array axis k.

    Raises:
        InputError: shape.

    Notes:
        Both continue images by 0 unless told otherwise: give MONAI's ``padding_mode="border"`` for our default.
    """
    grid.check_vector(u, "to_voxels: u")
    return u / grid.along(grid.spacing, u)


def from_voxels(voxels: Tensor, grid: Grid) -> Tensor:
    """Return the displacement in units of spacing of one in voxels; the inverse of `to_voxels`.

    Args:
        voxels: displacement ``(B, D, *S)`` in voxels, component k along array axis k.
        grid: its grid.

    Returns:
        u ``(B, D, *S)`` in units of spacing.

    Raises:
        InputError: shape.
    """
    grid.check_vector(voxels, "from_voxels: voxels")
    return voxels * grid.along(grid.spacing, voxels)


def to_grid_sample(u: Tensor, grid: Grid, *, displacement: bool = False) -> Tensor:
    """Return the positions x + u(x) in the box [−1, 1], for ``grid_sample(image, .., align_corners=True)``.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.
        displacement: return the displacement in that box instead, as kornia's `elastic_transform2d` holds it.

    Returns:
        ``(B, *S, D)``, components x, y, z: the last array axis first.

    Raises:
        InputError: shape.
    """
    grid.check_vector(u, "to_grid_sample: u")
    scaled = (2 * u / grid.along(grid.extent, u)).flip(1).movedim(1, -1)
    return scaled if displacement else scaled + _box(grid, u)


def from_grid_sample(positions: Tensor, grid: Grid, *, displacement: bool = False) -> Tensor:
    """Return the displacement ``(B, D, *S)`` in units of spacing of positions in the box [−1, 1]; see `to_grid_sample`.

    Args:
        positions: ``(B, *S, D)``, components x, y, z.
        grid: the grid.
        displacement: what is given are displacements in that box.

    Returns:
        u ``(B, D, *S)`` in units of spacing.

    Raises:
        InputError: shape.
    """
    _check_last(positions, grid, "from_grid_sample: positions")
    scaled = positions if displacement else positions - _box(grid, positions)
    u = scaled.movedim(-1, 1).flip(1)
    return u * grid.along(grid.extent, u) / 2


def _check_last(vectors: Tensor, grid: Grid, name: str) -> None:
    if not isinstance(vectors, Tensor) or tuple(vectors.shape[1:]) != (*grid.shape, grid.dim):
        want = ", ".join(map(str, (*grid.shape, grid.dim)))
        raise InputError(f"{name} must have shape (B, {want}), got {tuple(vectors.shape)}")


def _box(grid: Grid, like: Tensor) -> Tensor:
    """Return the nodes in the box [−1, 1], ``(*S, D)``, components x, y, z."""
    lines = [torch.linspace(-1, 1, n, dtype=like.dtype, device=like.device) for n in grid.shape]
    return torch.stack(torch.meshgrid(*lines, indexing="ij")[::-1], dim=-1)


def to_itk(u: Tensor, grid: Grid, direction: Sequence[Sequence[float]] = ()) -> Tensor:
    """Return the vectors direction · (u_x, u_y, u_z) that ITK keeps in a displacement field.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing, which are mm.
        grid: its grid.
        direction: ITK's direction matrix of the image, rows as in `Image.direction`; the identity by default.

    Returns:
        ``(B, *S, D)`` in mm; item 0 as a numpy array is what ``sitk.GetImageFromArray(.., isVector=True)`` takes. Set
        the spacing, in the order x, y, z, the origin and the direction of the fixed image on it.

    Raises:
        InputError: shape, or a direction of another size.
    """
    grid.check_vector(u, "to_itk: u")
    return torch.einsum("ij,b...j->b...i", _direction(direction, grid, u), u.flip(1).movedim(1, -1))


def from_itk(vectors: Tensor, grid: Grid, direction: Sequence[Sequence[float]] = ()) -> Tensor:
    """Return the displacement ``(B, D, *S)`` in units of spacing of ITK's vectors; the inverse of `to_itk`.

    Args:
        vectors: ``(B, *S, D)`` in mm, components x, y, z of the world.
        grid: the grid.
        direction: as in `to_itk`.

    Returns:
        u ``(B, D, *S)`` in units of spacing.

    Raises:
        InputError: shape, or a direction of another size.
    """
    _check_last(vectors, grid, "from_itk: vectors")
    back = torch.linalg.inv(_direction(direction, grid, vectors))
    return torch.einsum("ij,b...j->b...i", back, vectors).movedim(-1, 1).flip(1)


def _direction(direction: Sequence[Sequence[float]], grid: Grid, like: Tensor) -> Tensor:
    if not direction:
        return torch.eye(grid.dim, dtype=like.dtype, device=like.device)
    if len(direction) != grid.dim or {len(row) for row in direction} != {grid.dim}:
        raise InputError(f"itk: direction must be a matrix of {grid.dim}×{grid.dim} numbers, got {direction}")
    return torch.tensor(direction, dtype=like.dtype, device=like.device)
