"""How alike two images are at a glance: on coarse grids, centres of mass together, the moving image turned over."""

from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.image import Image
from torchdeform.warp import sample

_COARSE = {2: 48, 3: 24}  # blocks along an axis at least, where there are so many voxels


def likeness_turned_over(fixed: Image, moving: Image) -> dict[tuple[float, ...], float]:
    """Return |correlation| of two images with their centres of mass together, for every way to turn one over.

    Args:
        fixed: image that stays.
        moving: image that is turned over; 2D or 3D like the fixed one.

    Returns:
        By the signs (1 or −1) of the world's axes x, y, z about the centre of mass, a number from 0 to 1. All signs 1
        is the image as it lies; an odd number of −1 is a mirror image.
    """
    one, other = _coarse(fixed), _coarse(moving)
    points = one.grid.points(dtype=torch.float64, device=one.data.device)
    world = one.to_world(points) - _centre(one)
    return {
        signs: _correlation(one.data, _at(other, world * one.grid.along(signs, world) + _centre(other)))
        for signs in product((1.0, -1.0), repeat=fixed.grid.dim)
    }


def _coarse(image: Image) -> Image:
    """Return means over blocks of voxels and over channels, the median of the faces at 0."""
    grey, count = image.data.float().mean(1, keepdim=True), _COARSE[image.grid.dim]
    blocks = [max(1, n // count) for n in image.grid.shape]
    for axis, block in zip(image.grid.axes, blocks, strict=True):
        whole = grey.shape[axis] // block
        grey = grey.narrow(axis, 0, whole * block).unflatten(axis, (whole, block)).mean(axis + 1)
    first = [h * (block - 1) / 2 for h, block in zip(image.grid.spacing, blocks, strict=True)]
    origin = image.to_world(torch.tensor(first, dtype=torch.float64).view(1, -1, 1)).flatten().tolist()
    spacing = tuple(h * block for h, block in zip(image.grid.spacing, blocks, strict=True))
    faces = torch.cat([grey.select(axis, end).flatten() for axis in image.grid.axes for end in (0, -1)])
    return replace(image, data=grey - faces.median(), grid=Grid(tuple(grey.shape[2:]), spacing), origin=tuple(origin))


def _centre(image: Image) -> Tensor:
    """Return the centre of mass ``(1, D, 1, ..)`` of what stands out from the faces, in world mm."""
    world = image.to_world(image.grid.points(dtype=torch.float64, device=image.data.device))
    weight = image.data.abs().double()
    mass = weight.sum().clamp(min=torch.finfo(torch.float64).tiny)
    return (world * weight).sum(image.grid.axes, keepdim=True) / mass


def _at(image: Image, world: Tensor) -> Tensor:
    return sample(image.data, image.to_grid(world), image.grid, outside=0.0)


def _correlation(a: Tensor, b: Tensor) -> float:
    both = torch.stack((a.flatten().double(), b.flatten().double()))
    both = both - both.mean(1, keepdim=True)
    norms = both.norm(dim=1).prod().clamp(min=torch.finfo(torch.float64).tiny)
    return float((both[0] @ both[1]).abs() / norms)
