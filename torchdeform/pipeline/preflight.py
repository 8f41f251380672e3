"""The pre-flight check: what looks wrong with two images, said before any work starts."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, overlap, resample
from torchdeform.core.resampling import MIN_NODES
from torchdeform.core.warp import sample
from torchdeform.errors import InputError
from torchdeform.metrics.similarity import needs_common_scale
from torchdeform.pipeline.memory import available, footprint, readable
from torchdeform.registration.settings import RegistrationSettings

ERROR, WARNING, NOTE = "error", "warning", "note"

_LITTLE_OVERLAP = 0.3
_SPACINGS = (1e-3, 100.0)  # mm
_SIZE_RATIO = 3.0
_SCALE_RATIO = 20.0  # of the ranges of grey values
_MOSTLY = 0.95  # share of voxels that are exactly 0
_FILLED = 0.5  # share of the image that is left without its margins
_FITS = 0.6  # correlation that a turned image must reach, and be better than the image as it lies
_BETTER = 0.25  # by this much, or by leaving at most this share of what is missing to 1
_SAME_PLACE = 1e-3  # voxels by which a mask may lie off its image

# Letters of the world's axes x, y, z: where positive and negative directions point to.
_LETTERS = ("LR", "PA", "SI")


@dataclass(frozen=True)
class Finding:
    """One thing that a check found.

    Attributes:
        severity: ``error`` (it cannot work), ``warning`` (it will probably not do what is meant) or ``note``.
        text: one sentence that says what is wrong and what to do.
    """

    severity: str
    text: str


@dataclass(frozen=True)
class Report:
    """All findings, errors first."""

    findings: tuple[Finding, ...] = ()

    def of(self, severity: str) -> tuple[str, ...]:
        """Return the sentences of one severity."""
        return tuple(finding.text for finding in self.findings if finding.severity == severity)

    def require_ok(self) -> None:
        """Raise `InputError` with the first error, if there is one."""
        for text in self.of(ERROR):
            raise InputError(text)


@dataclass(frozen=True)
class _Pair:
    fixed: Image
    moving: Image
    aligned: bool
    settings: RegistrationSettings
    memory: int | None

    @property
    def both(self) -> tuple[tuple[Image, Image], tuple[Image, Image]]:
        """Each image with its partner."""
        return (self.fixed, self.moving), (self.moving, self.fixed)


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
        fixed_mask: where the fixed image counts (not 0); a grid of its own is allowed.
        moving_mask: the same for the moving image.
        aligned: whether an alignment comes before the deformation: images that lie apart are then no error.
        settings: how they will be registered; the defaults when None.
        memory: bytes that the registration is kept to by a coarser grid; None where it has what is free.

    Returns:
        `Report`. Nothing is raised: `Report.require_ok` does that.

    Notes:
        Images are compared on coarse grids, each voxel is looked at only for its value: less than a second at 128³.
    """
    pair = _Pair(fixed, moving, aligned, settings or RegistrationSettings(), memory)
    found = [finding for look in _ALWAYS for finding in look(pair)]
    if fixed.grid.dim != moving.grid.dim:
        found.append(
            _error(f"{fixed.name} is {fixed.grid.dim}D but {moving.name} is {moving.grid.dim}D; give two of one kind")
        )
    elif not any(finding.severity == ERROR for finding in found):
        found += [finding for look in _TOGETHER for finding in look(pair)]
    for image, mask in ((fixed, fixed_mask), (moving, moving_mask)):
        if mask is not None:
            found += _about_mask(image, mask)
    order = (ERROR, WARNING, NOTE)
    return Report(tuple(sorted(found, key=lambda finding: order.index(finding.severity))))


def orientation(image: Image) -> str:
    """Return where the x, y and z index axes point to, as ``LPS`` (left, posterior, superior) or ``RAI``.

    Args:
        image: 2D or 3D.

    Notes:
        Of an oblique axis the nearest direction. Every axis gets a letter of its own pair.
    """
    along = permutations(range(image.grid.dim))
    best = max(along, key=lambda axes: sum(abs(image.direction[world][k]) for k, world in enumerate(axes)))
    return "".join(_LETTERS[world][int(image.direction[world][k] < 0)] for k, world in enumerate(best))


def is_oblique(image: Image) -> bool:
    """Return whether an axis lies off the world's axes by more than about a degree."""
    return any(max(abs(row[k]) for row in image.direction) < math.cos(0.02) for k in range(image.grid.dim))


def _error(text: str) -> Finding:
    return Finding(ERROR, text)


def _warning(text: str) -> Finding:
    return Finding(WARNING, text)


def _note(text: str) -> Finding:
    return Finding(NOTE, text)


def _about_values(pair: _Pair) -> Iterator[Finding]:
    """NaN, infinity, constants, nearly nothing but zeros."""
    for image, _ in pair.both:
        low, high = (float(end) for end in image.data.aminmax())
        if not math.isfinite(low) or not math.isfinite(high):
            count = int((~image.data.isfinite()).sum())
            yield _error(f"{image.name} has {count} pixels that are NaN or infinite; replace them first, by 0 say")
        elif low == high:
            yield _error(f"{image.name} is constant, so there is nothing to align; check that it is the right file")
        elif (zeros := float((image.data == 0).float().mean())) > _MOSTLY:
            yield _warning(f"{image.name} is 0 in {zeros:.1%} of its pixels; crop it to what is to be aligned")


def _about_nodes(pair: _Pair) -> Iterator[Finding]:
    for image, _ in pair.both:
        if min(image.grid.shape) < MIN_NODES:
            size = "×".join(map(str, image.grid.shape[::-1]))
            text = f"{image.name} has the size {size}; every axis needs at least {MIN_NODES} voxels: resample it"
            yield _error(text) if image is pair.fixed else _warning(text)


def _about_spacing(pair: _Pair) -> Iterator[Finding]:
    least, most = _SPACINGS
    for image, partner in pair.both:
        shown = "×".join(f"{h:.4g}" for h in image.grid.spacing[::-1])
        if min(image.grid.spacing) < least or max(image.grid.spacing) > most:
            yield _warning(f"{image.name} has a spacing of {shown} mm; if that is not so, correct it in the header")
        if set(image.grid.spacing) == {1.0} and set(partner.grid.spacing) != {1.0}:
            yield _warning(
                f"{image.name} has spacing 1 on all axes, as files that know none, but {partner.name} has another; "
                "set the spacing in its header if it is in pixels"
            )


def _about_slices(pair: _Pair) -> Iterator[Finding]:
    """Slices without any contrast, inside an image or as a wide margin."""
    for image, _ in pair.both:
        filled = {axis: _filled(image, axis) for axis in image.grid.axes}
        for axis, full in filled.items():
            first, last = (int(k) for k in full.nonzero().flatten()[[0, -1]])
            if gaps := int((~full[first:last]).sum()):
                name, index = "zyx"[axis - 2 - image.grid.dim], first + int((~full[first:last]).nonzero()[0])
                yield _warning(
                    f"{image.name} has {gaps} slices along {name} that are constant among others that are not, one at "
                    f"index {index}; export it again"
                )
        if (kept := math.prod(float(full.float().mean()) for full in filled.values())) < _FILLED:
            yield _note(f"{image.name} has margins without contrast in {1 - kept:.0%} of it; cropping it saves time")


def _filled(image: Image, axis: int) -> Tensor:
    """Return for each slice along an axis whether it has any contrast."""
    others = [k for k in range(image.data.dim()) if k != axis]
    return image.data.amax(others) > image.data.amin(others)


def _about_size(pair: _Pair) -> Iterator[Finding]:
    sides = [math.prod(image.grid.extent) ** (1 / image.grid.dim) for image in (pair.fixed, pair.moving)]
    ratio = max(sides) / min(sides)
    if ratio > _SIZE_RATIO:
        sizes = f"{pair.fixed.name} is {sides[0]:.4g} mm wide and {pair.moving.name} {sides[1]:.4g} mm"
        yield _warning(f"{sizes}; check the spacings, or crop the larger one")


def _about_overlap(pair: _Pair) -> Iterator[Finding]:
    share = max(overlap(*images) for images in pair.both)
    names = f"{pair.fixed.name} and {pair.moving.name}"
    if share == 0.0:
        rest = "the alignment starts from their centres: look at the result" if pair.aligned else "align them first"
        text = f"{names} do not overlap in physical space; correct the origin in one of the headers, or {rest}"
        yield _warning(text) if pair.aligned else _error(text)
    elif share < _LITTLE_OVERLAP:
        yield _warning(f"{names} overlap by {share:.0%} only; check the origins in their headers, or align them first")


def _about_scale(pair: _Pair) -> Iterator[Finding]:
    ranges = [_range(image) for image in (pair.fixed, pair.moving)]
    ratio = max(ranges) / max(min(ranges), 1e-30)
    if ratio > _SCALE_RATIO:
        text = f"{pair.fixed.name} spans {ranges[0]:.4g} grey values and {pair.moving.name} {ranges[1]:.4g}"
        if needs_common_scale(pair.settings.similarity):
            yield _warning(f"{text}; scale them alike, or use another similarity than ssd")
        else:
            yield _note(f"{text}; scale them alike if they are of one kind and you compare them by ssd")


def _range(image: Image) -> float:
    values = image.data.flatten()
    values = values[:: 1 + values.numel() // 2**18].sort().values
    low, high = (float(values[round(share * (len(values) - 1))]) for share in (0.01, 0.99))
    return high - low or float(values[-1] - values[0])


def _about_channels(pair: _Pair) -> Iterator[Finding]:
    counts = [image.data.shape[1] for image in (pair.fixed, pair.moving)]
    if counts[0] != counts[1]:
        yield _note(
            f"{pair.fixed.name} has {counts[0]} channels and {pair.moving.name} {counts[1]}; they are compared as grey "
            "values: give images of one kind to compare colours"
        )


def _about_orientation(pair: _Pair) -> Iterator[Finding]:
    """Turn the moving image over along every choice of the world's axes, and see whether it fits better."""
    scores = likeness_turned_over(pair.fixed, pair.moving)
    best = max(scores, key=lambda flips: scores[flips])
    plain = scores[(1.0,) * pair.fixed.grid.dim]
    clearly = scores[best] > plain + _BETTER or 1 - scores[best] < _BETTER * (1 - plain)
    if scores[best] < _FITS or plain > 0.9 or not clearly:
        return
    axes = " and ".join("xyz"[k] for k, sign in enumerate(best) if sign < 0)
    kind = "mirrored" if math.prod(best) < 0 else "turned over"
    yield _warning(
        f"{pair.moving.name} looks {kind} along {axes}: it would fit {pair.fixed.name} with a correlation of "
        f"{scores[best]:.2f} rather than {plain:.2f}; check the orientation in both headers"
    )


def _about_memory(pair: _Pair) -> Iterator[Finding]:
    room = available(pair.fixed.data.device)
    grid = pair.fixed.grid
    need = footprint(grid, pair.fixed.data.shape[1], pair.settings)
    if pair.memory is not None or room is None or need < 0.8 * room:
        return
    size = "×".join(map(str, grid.shape[::-1]))
    text = (
        f"registration at {size} takes about {readable(need)} of memory and {readable(room)} are free; "
        f"give --memory {readable(room, spaced=False)} to stop at a coarser level, or crop {pair.fixed.name}"
    )
    yield _error(text) if need > 1.25 * room else _warning(text)


def _about_mask(image: Image, mask: Image) -> Iterator[Finding]:
    """A mask must be of the image's kind, lie on it, and leave something."""
    used = mask.data != 0
    if mask.grid.dim != image.grid.dim or mask.data.shape[1] != 1:
        kind = f"{mask.grid.dim}D with {mask.data.shape[1]} channels"
        yield _error(f"{mask.name} is {kind}; the mask of {image.name} must be {image.grid.dim}D with 1 channel")
    elif not bool(mask.data.isfinite().all()):
        yield _error(f"{mask.name} has pixels that are NaN or infinite; a mask is 0 where nothing counts, else 1")
    elif not bool(used.any()):
        yield _error(f"{mask.name} is empty (0 everywhere), so nothing would count; check that it is the right file")
    else:
        yield from _about_place(image, mask)
        if bool(used.all()):
            yield _note(f"{mask.name} is nowhere 0, so it excludes nothing; leave it out")


def _about_place(image: Image, mask: Image) -> Iterator[Finding]:
    if _same_place(image, mask):
        return
    binary = Image((mask.data != 0).float(), mask.grid, mask.origin, mask.direction, mask.name)
    if not bool(resample(binary, image, mode="nearest").any()):
        yield _error(f"{mask.name} excludes all of {image.name}; check the origin and spacing in its header")
    else:
        yield _warning(
            f"{mask.name} has another grid than {image.name}; it is taken in its physical place, which must be right: "
            "resample it onto the image to be sure"
        )


def _same_place(image: Image, mask: Image) -> bool:
    """Return whether both grids have the same nodes in the world."""
    if image.grid.shape != mask.grid.shape:
        return False
    ours, theirs = (_corners(one) for one in (image, mask))
    return float((ours - theirs).abs().max()) <= _SAME_PLACE * min(image.grid.spacing)


def _corners(image: Image) -> Tensor:
    """Return the corners of Ω in the world ``(1, D, 2^D)``."""
    corners = list(product(*((0.0, side) for side in image.grid.extent)))
    return image.to_world(torch.tensor(corners, dtype=torch.float64).T.unsqueeze(0))


_Look = Callable[[_Pair], Iterator[Finding]]

# What can be said of each image, and what needs two sound ones of the same dimension.
_ALWAYS: tuple[_Look, ...] = (_about_values, _about_nodes, _about_spacing)
_TOGETHER: tuple[_Look, ...] = (
    _about_slices, _about_size, _about_overlap, _about_scale, _about_channels, _about_orientation, _about_memory,
)  # fmt: skip


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
