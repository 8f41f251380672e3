"""Coarse to fine: grids of one box Ω with fewer nodes, images smoothed onto them, displacements brought up again."""

import torch.nn.functional as F
from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.registration.banded import multiply, restriction

# A level keeps at least this many nodes along an axis.
MIN_NODES = 8

# A level has at least this many along its longest axis: hippocampi (36×51×36) gain 0.008 Dice without their third one.
_MIN_LONGEST = 16

# Standard deviation of the smoothing before a level, in voxels of that level.
_BLUR = 0.5

_INTERPOLATION = {2: "bilinear", 3: "trilinear"}


def pyramid_grids(grid: Grid, levels: int) -> list[Grid]:
    """Return the grids of the levels, coarse to fine, the last being ``grid``.

    Args:
        grid: the finest grid.
        levels: number of levels wanted.

    Returns:
        Grids of the same box. Each level aims at twice the voxel size of the next, starting from the finest spacing, so
        thick slices are thinned out last. Levels with fewer than 16 nodes along every axis are left out.
    """
    grids = [grid]
    for level in range(1, levels):
        coarser = thinned(grid, 2**level)
        if coarser.shape != grids[0].shape and max(coarser.shape) >= _MIN_LONGEST:
            grids.insert(0, coarser)
    return grids


def thinned(grid: Grid, times: float) -> Grid:
    """Return the grid of the same box whose voxels are about so many times as wide as the narrowest of ``grid``."""
    return with_voxels(grid, min(grid.spacing) * times)


def with_voxels(grid: Grid, width: float) -> Grid:
    """Return the grid of the same box with voxels of about this width, at least 8 nodes an axis where there are."""
    shape = tuple(
        n if h >= width else min(n, max(MIN_NODES, round(side / width) + 1))
        for n, h, side in zip(grid.shape, grid.spacing, grid.extent, strict=True)
    )
    if shape == grid.shape:
        return grid
    return Grid(shape, tuple(side / (n - 1) for side, n in zip(grid.extent, shape, strict=True)))


def restrict(image: Tensor, grid: Grid, coarse: Grid) -> Tensor:
    """Return the image on a coarser grid of the same box, smoothed first so that nothing aliases.

    Args:
        image: ``(B, C, *S)`` on ``grid``.
        grid: its grid.
        coarse: the grid wanted.
    """
    counts = zip(grid.shape, coarse.shape, strict=True)
    return multiply(image, [restriction(many, few, _BLUR, image) for many, few in counts])


def prolong(u: Tensor, grid: Grid) -> Tensor:
    """Return a displacement on a finer grid of the same box, by linear interpolation between its nodes.

    Args:
        u: ``(B, D, *S)`` in units of spacing.
        grid: the grid wanted.
    """
    if tuple(u.shape[2:]) == grid.shape:
        return u
    return F.interpolate(u, size=grid.shape, mode=_INTERPOLATION[grid.dim], align_corners=True)
