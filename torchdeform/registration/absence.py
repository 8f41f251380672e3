"""Tissue that one image has and the other does not: resected, torn off, cut off; the similarity lets go of it."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.grid import Grid, per_item
from torchdeform.core.image import AUTO
from torchdeform.core.intensities import fill
from torchdeform.core.resampling import prolong, restrict, with_nodes
from torchdeform.core.warp import warp
from torchdeform.metrics.base import weighted
from torchdeform.metrics.correlation import local_contrast
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import RegistrationSettings

# Regions are looked for on a grid of at most so many nodes to the power of D; narrower ones than 2 · radius + 1 of its
# voxels are left to the map, which can close them.
_NODES, _RADIUS = 64, 2

# Of images scaled to [0, 1], voxels this near to the background show nothing, and those this far from it tissue, if
# windows of this width around them have this standard deviation.
_EMPTY, _FULL, _WINDOW, _TEXTURE = 0.03, 0.1, 5, 0.03

# Of more than this share of the tissue it is not believed that it is absent: the images are not aligned then.
_MOST = 0.35

# Nor where the other image is empty at other places over more than this share of it: things are displaced then.
_BACK = 0.2

# Share of a voxel of that grid that has to be empty for it to be: lung tissue is full of holes.
_PURE = 0.9

# Share of the border that must have one value for it to be that of the background.
_BORDER = 0.5

Regions = tuple[Tensor, Tensor]


def let_go(problem: RegistrationProblem, settings: RegistrationSettings) -> tuple[RegistrationProblem, Regions | None]:
    """Return the problem without what only one image shows, and where the fixed and the moving image show nothing.

    Args:
        problem: images scaled to about [0, 1], in the place where the deformation begins.
        settings: whether to.

    Returns:
        The problem with that left out of the masks and filled in, and two regions ``(B, 1, *S)`` of 0 and 1; None in
        place of them where there is nothing of the kind.

    Notes:
        Nothing corresponds where one image is empty, as its border is, over a width that a map would have to close or
        to open as a whole, and the other has contrast throughout. Each region is fixed to the image that is empty
        there, so a map carries that of the moving image with it. Costs some passes over both images.
    """
    regions = absent_regions(problem) if settings.absent == AUTO else []
    if not any(bool(region.any()) for region in regions):
        return problem, None
    # What the moving image does not show goes along with it, and nothing is asked of the fixed one there: the tissue
    # around would else be pulled into the hole. Where both are warped, both ask nothing of each other.
    both = torch.maximum(*regions)
    kept = [1 - both, 1 - (both if settings.symmetric else regions[1])]
    given = (problem.fixed_mask, problem.moving_mask)
    masks = [weighted(keep, mask) for keep, mask in zip(kept, given, strict=True)]
    images = [fill(x, 1 - region) for x, region in zip((problem.fixed, problem.moving), regions, strict=True)]
    problem = replace(problem, fixed=images[0], moving=images[1], fixed_mask=masks[0], moving_mask=masks[1])
    return problem, (regions[0], regions[1])


def absent_regions(problem: RegistrationProblem) -> list[Tensor]:
    """Return where the fixed image is empty and the moving one is not, and the other way round, ``(B, 1, *S)``."""
    grid, images = problem.grid, (problem.fixed, problem.moving)
    if not any(bool(_border(image)[1].any()) for image in images):  # soon known, and usual for crops
        return [torch.zeros_like(image[:, :1]) for image in images]
    coarse = with_nodes(grid, _NODES**grid.dim)
    empty = [_background(image, _EMPTY) for image in images]
    shares = [restrict(region, grid, coarse) for region in empty]
    tissue = [_tissue(restrict(image, grid, coarse)) for image in images]
    if problem.mask is not None:
        seen = (restrict(problem.mask, grid, coarse) > 0.5).to(problem.fixed)
        tissue = [region * seen for region in tissue]
    cores = [_opened((share > _PURE) * other) for share, other in zip(shares, reversed(tissue), strict=True)]
    sizes = [core.flatten(1).sum(1) for core in cores]
    found = []
    for k, (full, other) in enumerate(zip(empty, reversed(tissue), strict=True)):
        believed = (sizes[k] < _MOST * other.flatten(1).sum(1)) & (sizes[1 - k] <= _BACK * sizes[k])
        core = cores[k] * per_item(believed.to(full), full)
        found.append(full * (prolong(_dilated(core, 2 * _RADIUS), grid) > 0.5))
    return found


def moved_with(regions: Regions | None, u: Tensor, grid: Grid) -> Tensor | None:
    """Return where the similarity was let go on the fixed grid ``(B, 1, *S)``, 0 to 1, after the map u."""
    return None if regions is None else torch.maximum(torch.maximum(*regions), warp(regions[1], u, grid))


def _border(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the grey value of the border ``(B, C)``, and whether most of it has that value ``(B,)``."""
    faces = [image.select(axis, end).flatten(2) for axis in range(2, image.dim()) for end in (0, -1)]
    border = torch.cat(faces, dim=2)
    level = border.median(dim=2).values
    return level, ((border - level.unsqueeze(2)).abs().amax(1) < _EMPTY).to(image).mean(1) > _BORDER


def _background(image: Tensor, within: float) -> Tensor:
    """Return where all channels are as the border is ``(B, 1, *S)``; nowhere if the border is not of one value."""
    level, pure = _border(image)
    away = (image - level.view(*level.shape, *[1] * (image.dim() - 2))).abs().amax(1, keepdim=True)
    return (away < within).to(image) * per_item(pure.to(image), image)


def _tissue(image: Tensor) -> Tensor:
    """Return where an image shows something, ``(B, 1, *S)``."""
    return (local_contrast(image, _WINDOW, _TEXTURE) > 0.5).to(image) * (1 - _background(image, _FULL))


def _opened(region: Tensor) -> Tensor:
    """Return the parts of a region that are wider than 2 · radius voxels."""
    return _dilated(1 - _dilated(1 - region, _RADIUS), _RADIUS)


def _dilated(region: Tensor, radius: int) -> Tensor:
    """Return the union of all cubes of that radius around the region, axis by axis."""
    for axis in range(2, region.dim()):
        lines = region.movedim(axis, -1)
        pooled = F.max_pool1d(lines.reshape(-1, 1, lines.shape[-1]), 2 * radius + 1, 1, radius)
        region = pooled.view(lines.shape).movedim(-1, axis)
    return region
