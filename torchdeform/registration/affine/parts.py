"""Where a small image may lie in a large one: correlations with the large one in all places at once."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, box_corners, resample
from torchdeform.registration.affine.lie import scale_of
from torchdeform.registration.affine.objective import MaskedImage

# Nodes of the large image at most, and the factor by which voxels grow until it has no more.
_NODES = {2: 2**16, 3: 2**19}
_COARSER = 1.2

# Share of the small image that must lie in the large one.
_COVERED = 0.8

# Spread of the large image, as a share of that of the small one, below which there is nothing to see.
_FLAT = 0.1


def part_places(fixed: MaskedImage, moving: MaskedImage, linear: Tensor, most: int) -> list[tuple[float, Tensor]]:
    """Return where the centre of the fixed image's box may lie in the moving image, and how well it fits, best first.

    Args:
        fixed: the small image.
        moving: the large one.
        linear: matrix of the world ``(D, D)`` from the fixed to the moving image.
        most: number of places at most.

    Returns:
        Squared correlations, and points of the world ``(D,)``; none where one image is a speck beside the other.
    """
    size = float(scale_of(linear))
    voxel = max(fixed.image.grid.spacing)
    part, frame = fixed, _frame(fixed.image, moving.image, linear)
    while math.prod(frame.grid.shape) > _NODES[frame.grid.dim]:
        voxel *= _COARSER
        if voxel > max(fixed.image.grid.extent):  # too small beside the large image to be looked for in it
            return []
        part = fixed.coarser(voxel)
        frame = _frame(part.image, moving.image, linear)
    return list(_peaks(_fits(part, _on(frame, moving.coarser(voxel * size))), part.image.grid, frame, most))


def _frame(part: Image, whole: Image, linear: Tensor) -> Image:
    """Return an empty image over the box of the large one, whose voxels are those of the small one, mapped."""
    axes = linear @ torch.tensor(part.direction, dtype=torch.float64, device="cpu")
    grid, blank = part.grid, part.data.new_zeros(())
    frame = Image(blank.expand(1, 1, *grid.shape), grid, (), tuple(map(tuple, axes.tolist())))
    corners = frame.to_grid(whole.to_world(box_corners(whole.grid)))[0]
    low, high = corners.amin(1), corners.amax(1)
    shape = [max(2, math.ceil(side / h) + 1) for side, h in zip((high - low).tolist(), grid.spacing, strict=True)]
    origin = frame.to_world(low.view(1, -1, 1)).flatten().tolist()
    return replace(frame, data=blank.expand(1, 1, *shape), grid=Grid(tuple(shape), grid.spacing), origin=tuple(origin))


def _on(frame: Image, whole: MaskedImage) -> tuple[Tensor, Tensor]:
    """Return the large image on the frame, 0 outside, and its weight."""
    weight = torch.ones_like(whole.image.data[:, :1]) if whole.weight is None else whole.weight
    inside = resample(replace(whole.image, data=weight), frame)
    return resample(whole.image, frame) * (inside > 0), inside


def _fits(part: MaskedImage, whole: tuple[Tensor, Tensor]) -> Tensor:
    """Return the squared correlation of the small image with the large one, whose node k lies at its node 0.

    Places k run from 0, those below 0 from the end.
    """
    image, inside = whole
    weight = torch.ones_like(part.image.data[:, :1]) if part.weight is None else part.weight
    axes, ones = part.image.grid.axes, [1] * part.image.grid.dim
    middle = (weight * part.image.data).flatten(2).sum(2) / weight.sum()
    template = weight * (part.image.data - middle.view(1, -1, *ones))
    power = (template * part.image.data).flatten(2).sum(2).view(1, -1, *ones)
    shape = [a + b - 1 for a, b in zip(image.shape[2:], template.shape[2:], strict=True)]
    first = [torch.fft.rfftn(field, shape, axes).conj() for field in (weight, template)]
    second = [torch.fft.rfftn(field, shape, axes) for field in (inside, inside * image, inside * image.square())]
    covered, total, squares = (torch.fft.irfftn(first[0] * field, shape, axes) for field in second)
    product, offset = (torch.fft.irfftn(first[1] * field, shape, axes) for field in (second[1], second[0]))
    count = covered.clamp(min=_COVERED * float(weight.sum()))
    mean = total / count
    spread = (squares - count * mean.square()).clamp(min=_FLAT**2 * power)
    fit = (product - mean * offset).square() / (power * spread)
    return torch.where(covered < count, 0.0, fit.mean(1, keepdim=True))


def _peaks(fits: Tensor, part: Grid, frame: Image, most: int) -> Iterator[tuple[float, Tensor]]:
    """Yield the highest values, no two nearer than a quarter of the small image, and where its centre is then."""
    for _ in range(most):
        top = int(fits.argmax())
        value = float(fits.flatten()[top])
        if value <= 0:
            return
        at = torch.unravel_index(torch.tensor(top, device="cpu"), fits.shape[2:])
        place = [
            k if k < n else k - size for k, n, size in zip(map(int, at), frame.grid.shape, fits.shape[2:], strict=True)
        ]
        middle = [side / 2 + k * h for side, k, h in zip(part.extent, place, part.spacing, strict=True)]
        middle = torch.tensor(middle, dtype=torch.float64, device="cpu")
        yield value, frame.to_world(middle.view(1, -1, 1)).flatten()
        fits = _without(fits, place, part)


def _without(fits: Tensor, place: Sequence[int], part: Grid) -> Tensor:
    """Return the values with 0 near a place."""
    near = torch.ones((), dtype=torch.bool, device="cpu")
    for n, size, k in zip(fits.shape[2:], part.shape, place, strict=True):
        away = (torch.arange(n, device="cpu") - k).remainder(n)
        near = near.unsqueeze(-1) & (away.minimum(n - away) <= size / 4)
    return fits.masked_fill(near.to(fits.device), 0.0)
