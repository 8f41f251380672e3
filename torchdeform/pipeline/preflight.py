"""The check of two images before they are registered: what looks wrong with them, and what to do about it."""

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, background, centre_of_mass, overlap, require_same_place, resample
from torchdeform.core.intensities import corresponding_channels, intensity_range
from torchdeform.core.memory import available, readable
from torchdeform.core.resampling import MIN_NODES
from torchdeform.core.warp import sample
from torchdeform.errors import InputError
from torchdeform.io.files import stem
from torchdeform.metrics.similarity import needs_common_scale
from torchdeform.pipeline.memory import advice, footprint
from torchdeform.registration.settings import RegistrationSettings

ERROR, WARNING, NOTE = "error", "warning", "note"

_LITTLE_OVERLAP = 0.3
_SPACINGS = (1e-3, 100.0)  # mm
_SIZE_RATIO = 3.0
_SCALE_RATIO = 20.0  # of the ranges of grey values
_MOSTLY = 0.95  # share of voxels that are exactly 0
_FAINT = 0.02  # share of the range of grey values that a slice without contrast may have
_FILLED = 0.5  # share of the image without its empty margins
_FITS = 0.6  # correlation that a flipped image must reach
_BETTER = 0.25  # and it must be this much better than the image as it is, or this share closer to 1
_BLOCKS = {2: 48, 3: 24}  # blocks along an axis of the images that are flipped

# What is taken for labels: by the name of the file, by the number of values, by the share of equal neighbours.
_LABEL_NAME = re.compile(r"(?<![a-z])(a?seg|segmentation|labels?|masks?|parcellation)(?![a-z])")
_MOST_LABELS, _SAME = 1000, 0.5


@dataclass(frozen=True)
class Finding:
    """One thing that the check found.

    Attributes:
        severity: ``error`` (registration is impossible), ``warning`` (the result is probably not what is meant) or
            ``note``.
        text: one sentence that says what is wrong and what to do.
    """

    severity: str
    text: str


@dataclass(frozen=True)
class Report:
    """All findings, errors first."""

    findings: tuple[Finding, ...] = ()

    @classmethod
    def made_of(cls, *findings: Finding) -> "Report":
        """Return the report of findings in any order."""
        order = (ERROR, WARNING, NOTE)
        return cls(tuple(sorted(findings, key=lambda finding: order.index(finding.severity))))

    def of(self, severity: str) -> tuple[str, ...]:
        """Return the sentences of one severity."""
        return tuple(finding.text for finding in self.findings if finding.severity == severity)

    def require_ok(self) -> None:
        """Raise `InputError` with the first error, if there is one."""
        for text in self.of(ERROR):
            raise InputError(text)


def preflight(
    fixed: Image,
    moving: Image,
    *,
    fixed_mask: Image | None = None,
    moving_mask: Image | None = None,
    aligned: bool = False,
    settings: RegistrationSettings | None = None,
    memory: int | None = None,
) -> Report:
    """Return what looks wrong with a pair of images before it is registered.

    Args:
        fixed: image that stays.
        moving: image that is warped onto it.
        fixed_mask: where the fixed image counts (not 0); it may have another grid than the image.
        moving_mask: the same for the moving image.
        aligned: whether the images are aligned before the deformation. Images that do not overlap are then no error.
        settings: how they will be registered; the defaults when None.
        memory: bytes that a coarser grid keeps the registration to; None for all that is free.

    Returns:
        `Report`. Errors are not raised; `Report.require_ok` does that.

    Notes:
        Images are compared on coarse grids and every voxel is read only for its value: less than a second at 128³.
    """
    settings = settings or RegistrationSettings()
    given = [image for image in (fixed, moving, fixed_mask, moving_mask) if image is not None]
    found = [
        *(Finding(WARNING, text) for image in given for text in image.remarks),
        *_check_values(fixed),
        *_check_values(moving),
        *_check_nodes(fixed),
        *_check_nodes(moving),
        *_check_spacing(fixed, moving),
        *_check_spacing(moving, fixed),
    ]
    if fixed.grid.dim != moving.grid.dim:
        kinds = f"{fixed.name} is {fixed.grid.dim}D but {moving.name} is {moving.grid.dim}D"
        found.append(Finding(ERROR, f"{kinds}; give two of one kind"))
    # The other checks compare the images, so they need two that are sound and of one dimension.
    if not any(finding.severity == ERROR for finding in found):
        found += [
            *_check_slices(fixed),
            *_check_slices(moving),
            *_check_size(fixed, moving),
            *_check_overlap(fixed, moving, aligned),
            *_check_scale(fixed, moving, settings),
            *_check_channels(fixed, moving),
            *_check_orientation(fixed, moving),
            *([] if memory else _check_memory(fixed, settings)),
        ]
    for image, mask in ((fixed, fixed_mask), (moving, moving_mask)):
        found += [] if mask is None else _check_mask(image, mask)
    return Report.made_of(*found)


def looks_like_labels(image: Image) -> bool:
    """Return whether an image seems to hold labels, whose values must not be mixed.

    Args:
        image: as `read_image` reads it.

    Notes:
        Its name says so, or its values are whole numbers of which most have a neighbour with the same value, the
        commonest value, the background, left aside. Grey values differ from their neighbours.
    """
    if _LABEL_NAME.search(stem(Path(image.name)).lower()):
        return True
    data = image.data
    if data.shape[1] > 1 or not bool((data == data.round()).all()):
        return False
    values, counts = data.unique(return_counts=True)
    inside = data != values[counts.argmax()]
    same = (data[..., 1:] == data[..., :-1])[inside[..., 1:]]
    return len(values) <= _MOST_LABELS and bool(same.float().mean() > _SAME)


def _check_values(image: Image) -> Iterator[Finding]:
    """NaN, infinity, constant images, images that are 0 nearly everywhere."""
    low, high = (float(end) for end in image.data.aminmax())
    if not math.isfinite(low) or not math.isfinite(high):
        count = int((~image.data.isfinite()).sum())
        text = f"{image.name} has {count} pixels that are NaN or infinite; replace them first, for instance by 0"
        yield Finding(ERROR, text)
    elif low == high:
        text = f"{image.name} is constant, so there is nothing to align; check that it is the right file"
        yield Finding(ERROR, text)
    elif (zeros := float((image.data == 0).float().mean())) > _MOSTLY:
        yield Finding(WARNING, f"{image.name} is 0 in {zeros:.1%} of its pixels; crop it to what is to be aligned")


def _check_nodes(image: Image) -> Iterator[Finding]:
    if min(image.grid.shape) < MIN_NODES:
        text = (
            f"{image.name} has the size {image.grid.size_text}; nothing is moved along axes of fewer than {MIN_NODES}"
        )
        yield Finding(NOTE, f"{text} voxels")


def _check_spacing(image: Image, partner: Image) -> Iterator[Finding]:
    least, most = _SPACINGS
    if min(image.grid.spacing) < least or max(image.grid.spacing) > most:
        shown = "×".join(f"{image.in_unit(h):.4g}" for h in image.grid.spacing[::-1])
        text = f"{image.name} has a spacing of {shown} {image.unit}; if that is not so, correct it in the header"
        yield Finding(WARNING, text)
    if set(image.grid.spacing) == {1.0} and set(partner.grid.spacing) != {1.0}:
        text = (
            f"{image.name} has spacing 1 on all axes, as files without a spacing have, but {partner.name} has another"
        )
        yield Finding(WARNING, f"{text}; set the spacing in its header if it is in pixels")


def _check_slices(image: Image) -> Iterator[Finding]:
    """Slices without contrast, inside an image or as a wide margin, which may have the noise of a JPEG."""
    least = _FAINT * float(image.data.amax() - image.data.amin())
    contrasts = {axis: _contrast(image, axis) for axis in image.grid.axes}
    for axis, contrast in contrasts.items():
        filled = (contrast > least).nonzero().flatten().tolist() or [0]  # none in a ramp along the axis
        empty = contrast[filled[0] : filled[-1]] == 0
        if gaps := int(empty.sum()):
            name, index = "zyx"[axis - 2 - image.grid.dim], filled[0] + int(empty.nonzero()[0])
            text = f"{image.name} has {gaps} slices along {name} that are constant, between others that are not"
            yield Finding(WARNING, f"{text} (the first has index {index}); export it again")
    kept = math.prod(float((contrast > least).float().mean()) for contrast in contrasts.values())
    if kept < _FILLED:
        text = f"{image.name} has margins without contrast in {1 - kept:.0%} of it; crop it to save time"
        yield Finding(NOTE, text)


def _contrast(image: Image, axis: int) -> Tensor:
    """Return the range of grey values of each slice along an axis."""
    others = [k for k in range(image.data.dim()) if k != axis]
    return image.data.amax(others) - image.data.amin(others)


def _check_size(fixed: Image, moving: Image) -> Iterator[Finding]:
    sides = [math.prod(image.grid.extent) ** (1 / image.grid.dim) for image in (fixed, moving)]
    if max(sides) / min(sides) > _SIZE_RATIO:
        first, second = (f"{im.in_unit(side):.4g} {im.unit}" for im, side in zip((fixed, moving), sides, strict=True))
        sizes = f"{fixed.name} is {first} wide and {moving.name} {second}"
        yield Finding(WARNING, f"{sizes}; check the spacings, or crop the larger one")


def _check_overlap(fixed: Image, moving: Image, aligned: bool) -> Iterator[Finding]:
    share = max(overlap(fixed, moving), overlap(moving, fixed))
    names = f"{fixed.name} and {moving.name}"
    if share == 0.0:
        rest = "the alignment starts from their centres: look at the result" if aligned else "align them first"
        text = f"{names} do not overlap in physical space; correct the origin in one of the headers, or {rest}"
        yield Finding(WARNING if aligned else ERROR, text)
    elif share < _LITTLE_OVERLAP:
        text = f"{names} overlap by {share:.0%} only; check the origins in their headers, or align them first"
        yield Finding(WARNING, text)


def _check_scale(fixed: Image, moving: Image, settings: RegistrationSettings) -> Iterator[Finding]:
    ends = (intensity_range(image.data.flatten()[None], low=0.01, high=0.99) for image in (fixed, moving))
    ranges = [float(high - low) for low, high in ends]
    if max(ranges) / max(min(ranges), 1e-30) > _SCALE_RATIO:
        text = f"{fixed.name} spans {ranges[0]:.4g} grey values and {moving.name} {ranges[1]:.4g}"
        if needs_common_scale(settings.seen_by):
            yield Finding(WARNING, f"{text}; scale them alike, or use another similarity than ssd")
        else:
            yield Finding(NOTE, f"{text}; scale them alike if they are of one kind and you compare them by ssd")


def _check_channels(fixed: Image, moving: Image) -> Iterator[Finding]:
    counts = [image.data.shape[1] for image in (fixed, moving)]
    try:
        corresponding_channels(fixed, moving)
    except InputError as error:
        yield Finding(ERROR, str(error))
    else:
        if counts[0] != counts[1]:
            text = (
                f"{fixed.name} has {counts[0]} channels and {moving.name} {counts[1]}; they are compared as grey values"
            )
            yield Finding(NOTE, f"{text}: give images of one kind to compare colours")


def _check_orientation(fixed: Image, moving: Image) -> Iterator[Finding]:
    """Flip the moving image along every choice of the world axes, and see whether it fits better."""
    scores = flip_correlations(fixed, moving)
    best = max(scores, key=lambda flips: scores[flips])
    plain = scores[(1.0,) * fixed.grid.dim]
    clearly = scores[best] > plain + _BETTER or 1 - scores[best] < _BETTER * (1 - plain)
    if scores[best] < _FITS or plain > 0.9 or not clearly:
        return
    axes = " and ".join("xyz"[k] for k, sign in enumerate(best) if sign < 0)
    kind = "mirrored" if math.prod(best) < 0 else "turned over"
    text = (
        f"{moving.name} looks {kind} along {axes}: it would fit {fixed.name} with a correlation of "
        f"{scores[best]:.2f} rather than {plain:.2f}; check the orientation in both headers"
    )
    yield Finding(WARNING, text)


def _check_memory(fixed: Image, settings: RegistrationSettings) -> Iterator[Finding]:
    room = available(fixed.data.device)
    channels = fixed.data.shape[1]
    need = footprint(fixed.grid, channels, settings)
    if room is None or need < 0.8 * room:
        return
    text = (
        f"registration at {fixed.grid.size_text} takes about {readable(need)} of memory and {readable(room)} are free; "
        f"{advice(fixed.grid, room, channels, settings)}, or crop {fixed.name}"
    )
    yield Finding(ERROR if need > 1.25 * room else WARNING, text)


def _check_mask(image: Image, mask: Image) -> Iterator[Finding]:
    """A mask must be of the image's dimension, overlap it, and leave something."""
    used = mask.data != 0
    if mask.grid.dim != image.grid.dim or mask.data.shape[1] != 1:
        kind = f"{mask.grid.dim}D with {mask.data.shape[1]} channels"
        text = f"{mask.name} is {kind}; the mask of {image.name} must be {image.grid.dim}D with 1 channel"
        yield Finding(ERROR, text)
    elif not bool(mask.data.isfinite().all()):
        text = f"{mask.name} has pixels that are NaN or infinite; a mask is 0 where nothing counts, else 1"
        yield Finding(ERROR, text)
    elif not bool(used.any()):
        text = f"{mask.name} is empty (0 everywhere), so nothing would count; check that it is the right file"
        yield Finding(ERROR, text)
    else:
        yield from _check_mask_place(image, mask)
        if bool(used.all()):
            yield Finding(NOTE, f"{mask.name} is nowhere 0, so it excludes nothing; leave it out")


def _check_mask_place(image: Image, mask: Image) -> Iterator[Finding]:
    with suppress(InputError):
        require_same_place(mask, image)
        return
    binary = replace(mask, data=(mask.data != 0).float())
    if not bool(resample(binary, image, mode="nearest").any()):
        text = f"{mask.name} excludes all of {image.name}; check the origin and spacing in its header"
        yield Finding(ERROR, text)
    else:
        text = f"{mask.name} has another grid than {image.name}; its position in the world is used, which must be right"
        yield Finding(WARNING, f"{text}: resample it onto the image to be sure")


def flip_correlations(fixed: Image, moving: Image) -> dict[tuple[float, ...], float]:
    """Return |correlation| of two images with their centres of mass together, for every flip of one of them.

    Args:
        fixed: image that stays.
        moving: image that is flipped; 2D or 3D like the fixed one.

    Returns:
        A number from 0 to 1 by the signs (1 or −1) of the world axes x, y, z about the centre of mass. All signs 1 is
        the image as it is; an odd number of −1 is a mirror image.
    """
    one, other = _coarse(fixed), _coarse(moving)
    points = one.grid.points(dtype=torch.float64, device=one.data.device)
    here, there = (centre_of_mass(some, some.data.abs()).view(1, -1, *[1] * some.grid.dim) for some in (one, other))
    world = one.to_world(points) - here
    return {
        signs: _correlation(one.data, _at(other, world * one.grid.along(signs, world) + there))
        for signs in product((1.0, -1.0), repeat=fixed.grid.dim)
    }


def _coarse(image: Image) -> Image:
    """Return means over blocks of voxels and over channels; the median on the faces, the background, becomes 0."""
    grey, count = image.data.float().mean(1, keepdim=True), _BLOCKS[image.grid.dim]
    blocks = [max(1, n // count) for n in image.grid.shape]
    for axis, block in zip(image.grid.axes, blocks, strict=True):
        whole = grey.shape[axis] // block
        grey = grey.narrow(axis, 0, whole * block).unflatten(axis, (whole, block)).mean(axis + 1)
    first = [h * (block - 1) / 2 for h, block in zip(image.grid.spacing, blocks, strict=True)]
    origin = image.to_world(torch.tensor(first, dtype=torch.float64, device="cpu").view(1, -1, 1)).flatten().tolist()
    spacing = tuple(h * block for h, block in zip(image.grid.spacing, blocks, strict=True))
    return replace(image, data=grey - background(grey), grid=Grid(tuple(grey.shape[2:]), spacing), origin=tuple(origin))


def _at(image: Image, world: Tensor) -> Tensor:
    return sample(image.data, image.to_grid(world), image.grid, outside=0.0)


def _correlation(a: Tensor, b: Tensor) -> float:
    both = torch.stack((a.flatten().double(), b.flatten().double()))
    both = both - both.mean(1, keepdim=True)
    norms = both.norm(dim=1).prod().clamp(min=torch.finfo(torch.float64).tiny)
    return float((both[0] @ both[1]).abs() / norms)
