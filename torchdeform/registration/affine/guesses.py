"""How large things may be in one image against another: what headers and contents make plausible."""

import math
from dataclasses import dataclass

import torch

from torchdeform.registration.affine.objective import MaskedImage, NormalisedFrame
from torchdeform.registration.affine.search import contents_ratio, image_moments

# Fields of view whose sizes differ by more than this are those of a whole and a part, or in different units; voxels
# whose sizes differ by more than that may be in different units.
_FIELDS, _VOXELS = 1.75, 2.0

# Guesses nearer to each other than this are one, and how far the size of a map may be from its guess.
_ALIKE, _REACH = 1.2, 2.0

# Voxels along a side for the spread of the contents.
_COARSE = 64


@dataclass(frozen=True)
class Guess:
    """How much larger things may be in one image than in the other, and which of them is the smaller field then.

    Attributes:
        fixed: the image whose nodes are compared: the smaller one where they differ much.
        moving: the other one.
        size: how much larger things are in ``moving``; None where the files leave no doubt that it is about 1.
        part: whether ``fixed`` shows a part of what ``moving`` shows.
        swapped: whether ``fixed`` is the moving image of the alignment.
    """

    fixed: MaskedImage
    moving: MaskedImage
    size: float | None = None
    part: bool = False
    swapped: bool = False

    @property
    def sizes(self) -> tuple[float, float]:
        """Smallest and largest factor of length that is plausible."""
        return (0.0, math.inf) if self.size is None else (self.size / _REACH, self.size * _REACH)


def guessed(fixed: MaskedImage, moving: MaskedImage, *, scale: bool) -> list[Guess]:
    """Return the sizes that are plausible: that of the headers, and where those look odd some more.

    Args:
        fixed: image that stays.
        moving: the other one.
        scale: whether a map may change sizes.

    Notes:
        The others are equal voxels, equal fields of view, and equal spread of the contents: the first holds for parts
        of an image whose spacing was lost, the others for the same content in other units.
    """
    grids = fixed.image.grid, moving.image.grid
    field, voxel = (
        float((second / first) ** (1 / grids[0].dim))
        for first, second in ([g.volume for g in grids], [g.cell_volume for g in grids])
    )
    if not (_differ(field, _FIELDS) or (scale and _differ(voxel, _VOXELS))):
        return [Guess(fixed, moving)]
    sizes = [1.0]
    for size in (_contents(fixed, moving), field, voxel) if scale else ():
        if all(_differ(size / other, _ALIKE) for other in sizes):
            sizes.append(size)
    return [_guess(fixed, moving, size, field) for size in sizes]


def _differ(ratio: float, limit: float) -> bool:
    return max(ratio, 1 / ratio) > limit


def _guess(fixed: MaskedImage, moving: MaskedImage, size: float, field: float) -> Guess:
    """Return a guess whose fixed image is no larger than the moving one."""
    if size > _FIELDS * field:
        return Guess(moving, fixed, 1 / size, part=True, swapped=True)
    return Guess(fixed, moving, size, part=field > _FIELDS * size)


def _contents(*images: MaskedImage) -> float:
    frame = NormalisedFrame.of(images[0].image)
    coarse = (image.coarser(max(image.image.grid.extent) / _COARSE) for image in images)
    return contents_ratio(*(image_moments(image, frame) for image in coarse))
