"""What is compared: channels that correspond, intensities on one scale, and nothing of what a mask leaves out."""

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.image import Image, luminance, opaque
from torchdeform.core.resampling import AVERAGE_POOL, LINEAR_MODES
from torchdeform.errors import InputError

# Values of one channel that its percentiles are taken from, at most.
_SAMPLES = 2**20


def corresponding_channels(fixed: Image, moving: Image) -> tuple[Image, Image]:
    """Return both images with the channels that are compared: all of them, channel by channel.

    Colours are compared as they are, what is transparent counting as black. If one image is grey and the other in
    colours, the luminance of the latter is taken; so it is if all colours of both are shades of grey.

    Raises:
        InputError: numbers of channels that do not correspond.
    """
    both = [opaque(image) for image in (fixed, moving)]
    if all(bool((image.data == image.data[:, :1]).all()) for image in both):
        both = [replace(image, data=image.data[:, :1]) for image in both]
    counts = [image.data.shape[1] for image in both]
    if counts[0] == counts[1]:
        return both[0], both[1]
    if set(counts) != {1, 3}:
        named = f"{fixed.name} has {counts[0]} channels and {moving.name} {counts[1]}"
        raise InputError(f"{named}, which do not correspond; give images with the same channels, or grey ones")
    return luminance(both[0]), luminance(both[1])


def require_finite(fixed: Tensor, moving: Tensor, where: str) -> None:
    """Raise `InputError`, which names ``where``, unless all values of two images are finite."""
    for name, image in (("fixed", fixed), ("moving", moving)):
        if not bool(image.isfinite().all()):
            raise InputError(f"{where}: {name} has values that are NaN or infinite; replace or mask them first")


def fill(image: Tensor, mask: Tensor) -> Tensor:
    """Return the image with new values where the mask is 0: means of known ones, taken from ever larger cells.

    Args:
        image: ``(B, C, *S)``; anything, NaN too, where the mask is 0.
        mask: ``(B or 1, 1, *S)``, positive somewhere in every item.

    Returns:
        ``(B, C, *S)``, continuous and without edges of its own, so that smoothing and sampling near the mask's border
        bring in nothing foreign.
    """
    known = (mask > 0).expand(image.shape[0], -1, *image.shape[2:])
    return _fill(torch.where(known, image, 0), known)


def _fill(image: Tensor, known: Tensor) -> Tensor:
    if bool(known.all()):
        return image
    pool, weight = AVERAGE_POOL[image.dim() - 2], known.to(image.dtype)
    cell = tuple(min(2, n) for n in image.shape[2:])
    share = pool(weight, cell, ceil_mode=True)
    mean = pool(image * weight, cell, ceil_mode=True) / share.clamp(min=torch.finfo(image.dtype).tiny)
    coarse = _fill(mean, share > 0)
    finer = F.interpolate(coarse, size=image.shape[2:], mode=LINEAR_MODES[image.dim() - 2], align_corners=False)
    return torch.where(known, image, finer)


def intensity_range(values: Tensor, *, low: float = 0.005, high: float = 0.995) -> Tensor:
    """Return two percentiles of each row of values, or its extremes where these are equal.

    Args:
        values: ``(C, n)``, finite.
        low: the lower percentile, 0 to 1.
        high: the higher one.

    Returns:
        ``(2, C)``: values of the rows, taken at regular steps where there are more than a million.
    """
    values = values[:, :: max(1, values.shape[1] // _SAMPLES)]
    ranks = (1 + round(share * (values.shape[1] - 1)) for share in (low, high))
    ends = torch.stack([values.kthvalue(rank, dim=1).values for rank in ranks])  # quantile() stops at 2^24 values
    return torch.where(ends[1] > ends[0], ends, torch.stack(values.aminmax(dim=1)))


def to_common_scale(
    images: tuple[Tensor, Tensor], masks: tuple[Tensor | None, Tensor | None], *, jointly: bool
) -> tuple[Tensor, Tensor]:
    """Return both images with the 0.5 and 99.5 percentiles of every channel inside the mask taken to 0 and 1.

    Args:
        images: fixed and moving, both ``(B, C, *S)``.
        masks: of each, ``(B or 1, 1, *S)``, or None.
        jointly: one scale for both images, as a squared difference needs; otherwise each has its own.

    Returns:
        Both images. A channel without contrast becomes 0.

    Raises:
        InputError: an image has no contrast in any channel.
    """
    values = [_inside(image, mask) for image, mask in zip(images, masks, strict=True)]
    if jointly:
        joined = [torch.cat(pair, dim=1) for pair in zip(*values, strict=True)]
        ranges = [_ranges(joined, "fixed and moving")] * 2
    else:
        ranges = [_ranges(items, name) for items, name in zip(values, ("fixed", "moving"), strict=True)]
    fixed, moving = (_scaled(image, ends) for image, ends in zip(images, ranges, strict=True))
    return fixed, moving


def _inside(image: Tensor, mask: Tensor | None) -> list[Tensor]:
    """Return for each item its values where the mask is positive, ``(C, n)``."""
    if mask is None:
        return list(image.flatten(2))
    known = (mask > 0).expand(image.shape[0], -1, *image.shape[2:]).flatten(1)
    return [item[:, where] for item, where in zip(image.flatten(2), known, strict=True)]


def _ranges(items: list[Tensor], name: str) -> Tensor:
    """Return both ends of the `intensity_range` of every channel, ``(2, B, C)``."""
    ranges = torch.stack([intensity_range(values) for values in items], dim=1)
    if not bool((ranges[1] > ranges[0]).any(1).all()):
        raise InputError(f"register: {name} is constant, so there is nothing to align")
    return ranges


def _scaled(image: Tensor, ends: Tensor) -> Tensor:
    low, high = (end.view(*end.shape, *([1] * (image.dim() - 2))) for end in ends)
    return (image - low).div_(torch.where(high > low, high - low, 1))
