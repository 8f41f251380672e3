"""What a map does to a label: how near to a rigid motion it is there, and what becomes of the volume."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.regions import Crop, all_but_few, require_labels
from torchdeform.deformation.rigid import fit_rigid
from torchdeform.deformation.volumes import nodal_volumes
from torchdeform.errors import InputError


class LabelFit(NamedTuple):
    """What a map does to a label, one entry per item ``(B,)``; NaN where an item does not have it.

    Attributes:
        rigid: largest distance between φ and the rigid motion nearest to it over the nodes of the label, in voxels.
        determinant: largest |det ∇φ − 1| but for one node in a thousand, see `jacobian_determinant`.
        volume: of the label after over before, see `nodal_volumes`.
    """

    rigid: Tensor
    determinant: Tensor
    volume: Tensor


@torch.no_grad()
def label_fit(u: Tensor, inside: Tensor, grid: Grid) -> LabelFit:
    """Return how near φ = id + u is to a rigid motion on a label, and what it does to its volume.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        inside: the label, ``(B or 1, 1, *S)`` of bool.
        grid: the grid.

    Returns:
        `LabelFit`.

    Raises:
        InputError: shapes, types, batch sizes, or fewer than 3 nodes along an axis.

    Notes:
        In float64. Costs as much as the box around the label.
    """
    grid.check_vector(u, "label_fit: u")
    require_labels(inside, grid, "label_fit: inside")
    if inside.shape[1] != 1 or inside.shape[0] not in (1, len(u)):
        raise InputError(f"label_fit: inside must be one label of {len(u)} items or 1, got {tuple(inside.shape)}")
    fits = [_fit(u[i : i + 1], inside[i % len(inside), 0], grid) for i in range(len(u))]
    return LabelFit(*(u.new_tensor(values) for values in zip(*fits, strict=True)))


def _fit(u: Tensor, inside: Tensor, grid: Grid) -> tuple[float, float, float]:
    if not bool(inside.any()):
        return math.nan, math.nan, math.nan
    crop = Crop.around(inside, grid, 1)
    u, inside = crop.of(u).double(), crop.of(inside)
    points = crop.grid.points(dtype=torch.float64, device=u.device)[0, :, inside]
    move = u[:, :, inside]
    motion = fit_rigid(points, points + move, torch.ones_like(move[:, 0]))
    away = (motion.at(points) - move) / grid.along(grid.spacing, u).flatten(2)
    off = (jacobian_determinant(u, crop.grid)[0, 0, inside] - 1).abs()
    volumes = [nodal_volumes(field, crop.grid)[0, 0, inside].sum() for field in (u, torch.zeros_like(u))]
    return float(away.norm(dim=1).max()), float(all_but_few(off)), float(volumes[0] / volumes[1])
