"""Images in their physical place, taken onto one grid with everything that is known about them."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.image import Image, require_registrable, resample, same_place
from torchdeform.registration.guidance import Guidance, require_mask
from torchdeform.registration.intensities import corresponding_channels, fill
from torchdeform.registration.scene import Scene
from torchdeform.transform import Affine


@dataclass(frozen=True)
class Subject:
    """One of the two images as it is compared, in its own place.

    Attributes:
        image: channels that are compared, filled in where the mask is 0.
        mask: 0 and 1 on the image's grid, or None.
        points: landmarks in the world ``(1, D, n)``, float64, or None.
    """

    image: Image
    mask: Image | None
    points: Tensor | None

    def moved(self, affine: Affine) -> "Subject":
        """Return the subject at the place where an affine map of the world takes it."""
        mask = None if self.mask is None else moved(self.mask, affine)
        points = None if self.points is None else affine(self.points)
        return Subject(moved(self.image, affine), mask, points)


def moved(image: Image, affine: Affine) -> Image:
    """Return the image at the place where an affine map of the world takes it, pixel by pixel the same."""
    corner = image.to_world(torch.zeros(1, image.grid.dim, 1, dtype=torch.float64))
    direction = affine.matrix.double().cpu() @ torch.tensor(image.direction, dtype=torch.float64)
    return replace(
        image,
        origin=tuple(affine(corner).flatten().tolist()),
        direction=tuple(tuple(row) for row in direction.tolist()),
    )


def subjects(fixed: Image, moving: Image, guidance: Guidance) -> tuple[Subject, Subject]:
    """Return both images as they are compared.

    Raises:
        InputError: channels that do not correspond, masks that are empty, pixels that count but are NaN or all equal.
    """
    images = corresponding_channels(fixed, moving)
    first = _subject(images[0], guidance.fixed_mask, guidance.fixed_points)
    return first, _subject(images[1], guidance.moving_mask, guidance.moving_points)


def _subject(image: Image, mask: Tensor | Image | None, points: Tensor | None) -> Subject:
    points = None if points is None else points.double().to(image.data.device)
    if not isinstance(mask, Image):
        require_registrable(image)
        return Subject(image, None, points)
    inside = resample(replace(mask, data=(mask.data != 0).to(image.data)), image, mode="nearest")
    require_mask(inside, mask.name)
    image = replace(image, data=fill(image.data, inside))
    require_registrable(image)
    return Subject(image, replace(image, data=inside), points)


def place(fixed: Subject, moving: Subject, frame: Image) -> Scene:
    """Return the scene of both images sampled on the grid of ``frame``, each where it is in the world.

    An image that does not cover the frame has a mask there whether it came with one or not: beyond its edges there is
    nothing to compare.
    """
    like = fixed.image.data
    images = [resample(s.image, frame, outside=None).to(like) for s in (fixed, moving)]
    masks = [_mask_on(frame, s) for s in (fixed, moving)]
    points = [None if s.points is None else frame.to_grid(s.points).to(like) for s in (fixed, moving)]
    return Scene(frame.grid, *images, *(None if mask is None else mask.to(like) for mask in masks), *points)


def _mask_on(frame: Image, subject: Subject) -> Tensor | None:
    """Return the weights of a subject on the frame, None if they are 1 everywhere."""
    image, mask = subject.image, subject.mask
    if mask is None and same_place(image, frame):
        return None
    mask = replace(image, data=torch.ones_like(image.data[:, :1])) if mask is None else mask
    weights = resample(mask, frame)
    return None if bool((weights == 1).all()) else weights
