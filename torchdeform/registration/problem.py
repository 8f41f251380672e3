"""What is registered, on one grid: the images as they are compared, where they count, which points belong together."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.image import Image, require_registrable, resample, same_place
from torchdeform.core.intensities import corresponding_channels, fill, to_common_scale
from torchdeform.core.resampling import MIN_NODES, restrict
from torchdeform.core.transform import Affine
from torchdeform.core.warp import sample
from torchdeform.metrics.base import weighted
from torchdeform.metrics.correlation import lncc
from torchdeform.metrics.noise import noise_share
from torchdeform.metrics.similarity import needs_common_scale
from torchdeform.registration.annotations import Annotations, both, require_mask
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.tissue import Tissue

# Slices are far apart where they are so many times farther than the nodes and the pixels.
_SPARSE = 3.0

# Cosine of the angle with an axis of the grid up to which slices are across that axis.
_ALONG = 0.9

# Thicknesses of slices that are tried, in distances from slice to slice: points, with gaps, without, overlapping.
_THICKNESSES = (0.0, 0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Channels:
    """Something of both images that is compared, made once and averaged down.

    Attributes:
        grid: their grid, which may be coarser than that of the images.
        fixed: ``(B, C, *S)``.
        moving: the same shape.
        measure: the similarity, or several with weights.
        weight: of S, relative to that of what comes first.
    """

    grid: Grid
    fixed: Tensor
    moving: Tensor
    measure: str | Mapping[str, float]
    weight: float = 1.0

    def on(self, coarse: Grid) -> "Channels":
        """Return them on a grid of the same box, if it is coarser."""
        if math.prod(coarse.shape) >= math.prod(self.grid.shape):
            return self
        fixed, moving = (restrict(field, self.grid, coarse) for field in (self.fixed, self.moving))
        return replace(self, grid=coarse, fixed=fixed, moving=moving)


@dataclass(frozen=True)
class RegistrationProblem:
    """Two images on one grid and what is known about them.

    Attributes:
        grid: their grid.
        fixed: ``(B, C, *S)``.
        moving: the same shape.
        fixed_mask: weights ``(B, 1, *S)``, or None.
        moving_mask: likewise.
        fixed_points: ``(B, D, n)`` in grid points, or None.
        moving_points: likewise.
        held: axes along which nothing is moved, from 0.
        tissue: what the fixed image is made of, None where nothing is said.
        sides: how much of each node belongs to each side of borders that glide ``(B or 1, K, *S)``, where the pairs are
            those of every side and item; None without.
        anchors: pairs of points that were found ``(B, D, n)`` twice, and how much each counts ``(B, 1, n)``; or None.
        noise: that of each pair, see `measured_noise`; None where it was not measured.
        features: channels of both images as they are given, or None.
        labels: of both images, whole numbers ``(B, 1, *S)``, where they are compared; or None.
        channels: what is compared beside the intensities, or in their place.
        intensities: whether these are compared.
    """

    grid: Grid
    fixed: Tensor
    moving: Tensor
    fixed_mask: Tensor | None = None
    moving_mask: Tensor | None = None
    fixed_points: Tensor | None = None
    moving_points: Tensor | None = None
    held: tuple[int, ...] = ()
    tissue: Tissue | None = None
    sides: Tensor | None = None
    anchors: tuple[Tensor, Tensor, Tensor] | None = None
    noise: Tensor | None = None
    features: tuple[Tensor, Tensor] | None = None
    labels: tuple[Tensor, Tensor] | None = None
    channels: tuple[Channels, ...] = ()
    intensities: bool = True

    @property
    def pairs(self) -> tuple[Tensor, Tensor] | None:
        """The landmarks of both images, None without."""
        return both(self.fixed_points, self.moving_points)

    @property
    def mask(self) -> Tensor | None:
        """The weights of both masks, None for 1 everywhere."""
        return self.moving_mask if self.fixed_mask is None else weighted(self.fixed_mask, self.moving_mask)

    def on(self, coarse: Grid) -> "RegistrationProblem":
        """Return the problem on a coarser grid of the same box."""
        if coarse == self.grid:
            return self

        def coarser(field: Tensor | None) -> Tensor | None:
            return None if field is None else restrict(field, self.grid, coarse)

        masks = {name: coarser(getattr(self, name)) for name in ("fixed_mask", "moving_mask", "sides")}
        images = {"fixed": restrict(self.fixed, self.grid, coarse), "moving": restrict(self.moving, self.grid, coarse)}
        tissue = self.tissue and self.tissue.on(self.grid, coarse)
        channels = tuple(one.on(coarse) for one in self.channels)
        return replace(self, grid=coarse, tissue=tissue, channels=channels, **images, **masks)

    def masks_on(self, grid: Grid) -> tuple[Tensor | None, Tensor | None]:
        """Return the fixed and the moving mask on a grid that is no finer, None for 1 everywhere."""
        fixed, moving = (m if m is None else restrict(m, self.grid, grid) for m in (self.fixed_mask, self.moving_mask))
        return fixed, moving

    def scaled(self, settings: RegistrationSettings) -> "RegistrationProblem":
        """Return the problem with intensities on the scale that the similarity needs."""
        images = to_common_scale(
            (self.fixed, self.moving),
            (self.fixed_mask, self.moving_mask),
            jointly=needs_common_scale(settings.seen_by),
        )
        return replace(self, fixed=images[0], moving=images[1])

    def measured_noise(self) -> Tensor:
        """Return `noise_share` of the noisier image of each pair ``(B,)``, the images being on their scale."""
        return torch.maximum(noise_share(self.fixed, self.fixed_mask), noise_share(self.moving, self.moving_mask))


def problem_of_tensors(fixed: Tensor, moving: Tensor, grid: Grid, annotations: Annotations) -> RegistrationProblem:
    """Return the problem of two tensors on one grid, filled in where the masks are 0."""
    masks = [_weights(mask, fixed) for mask in (annotations.fixed_mask, annotations.moving_mask)]
    images = [image if mask is None else fill(image, mask) for image, mask in zip((fixed, moving), masks, strict=True)]
    points = [None if p is None else p.to(fixed) for p in (annotations.fixed_points, annotations.moving_points)]
    features, labels = (_for_items(pair, fixed) for pair in (annotations.features, annotations.labels))
    held = thin_axes(grid)
    return RegistrationProblem(grid, *images, *masks, *points, held=held, features=features, labels=labels)


def _for_items(pair: tuple[Tensor, Tensor] | None, like: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return two fields with an entry for every item of a batch, None without."""
    return pair and both(*(field.to(like.device).expand(len(like), *field.shape[1:]) for field in pair))


def _weights(mask: object, like: Tensor) -> Tensor | None:
    return mask.to(like).expand(like.shape[0], -1, *like.shape[2:]) if isinstance(mask, Tensor) else None


@dataclass(frozen=True)
class PlacedImage:
    """One of the two images as it is compared, in its own place.

    Attributes:
        image: channels that are compared, filled in where the mask is 0.
        mask: 0 and 1 on the image's grid, or None.
        points: landmarks in the world ``(1, D, n)``, float64, or None.
        features: channels on a grid of their own, or None.
        labels: likewise, or None.
    """

    image: Image
    mask: Image | None
    points: Tensor | None
    features: Image | None = None
    labels: Image | None = None

    def moved(self, affine: Affine) -> "PlacedImage":
        """Return the image, its mask and its points at the place where an affine map of the world takes it."""
        mask, features, labels = (f and moved(f, affine) for f in (self.mask, self.features, self.labels))
        points = None if self.points is None else affine(self.points)
        return PlacedImage(moved(self.image, affine), mask, points, features, labels)


def moved(image: Image, affine: Affine) -> Image:
    """Return the image at the place where an affine map of the world takes it, pixel by pixel the same."""
    corner = image.to_world(torch.zeros(1, image.grid.dim, 1, dtype=torch.float64, device="cpu"))
    direction = affine.matrix.double().cpu() @ torch.tensor(image.direction, dtype=torch.float64, device="cpu")
    return replace(
        image,
        origin=tuple(affine(corner).flatten().tolist()),
        direction=tuple(tuple(row) for row in direction.tolist()),
    )


def placed_images(fixed: Image, moving: Image, annotations: Annotations) -> tuple[PlacedImage, PlacedImage]:
    """Return both images as they are compared.

    Raises:
        InputError: channels that do not correspond, masks that are empty, pixels that count but are NaN or all equal.
    """
    images = corresponding_channels(fixed, moving)
    first = _placed(images[0], annotations, "fixed")
    return first, _placed(images[1], annotations, "moving")


def _placed(image: Image, annotations: Annotations, side: str) -> PlacedImage:
    mask, points, *others = (
        getattr(annotations, f"{side}_{name}") for name in ("mask", "points", "features", "labels")
    )
    points = None if points is None else points.double().to(image.data.device)
    if not isinstance(mask, Image):
        require_registrable(image)
        return PlacedImage(image, None, points, *others)
    inside = resample(replace(mask, data=(mask.data != 0).to(image.data)), image, mode="nearest")
    require_mask(inside, mask.name)
    image = replace(image, data=fill(image.data, inside))
    require_registrable(image)
    return PlacedImage(image, replace(image, data=inside), points, *others)


def resample_pair(fixed: PlacedImage, moving: PlacedImage, frame: Image) -> RegistrationProblem:
    """Return the problem of both images sampled on the grid of ``frame``, each where it is in the world.

    An image that does not cover the frame has a mask there whether it came with one or not: beyond its edges there is
    nothing to compare. Where the slices of one are far apart, the other is compared as such slices would show it,
    averaged over the thickness that makes it most like them, and nothing is moved across them, nor across a few slices:
    what one would need to see for it is not in the image.
    """
    like = fixed.image.data
    masks = [_mask_on(frame, s) for s in (fixed, moving)]
    points = [None if s.points is None else frame.to_grid(s.points).to(like) for s in (fixed, moving)]
    weights = [None if mask is None else mask.to(like) for mask in masks]
    across = [axis for part in (fixed, moving) if (axis := _across(part.image, frame)) is not None]
    held = tuple(sorted({*thin_axes(frame.grid), *across}))
    features, labels = (_pair_on(frame, fixed, moving, name) for name in ("features", "labels"))

    def seen(thickness: float) -> RegistrationProblem:
        images = _averaged(fixed.image, moving.image, thickness), _averaged(moving.image, fixed.image, thickness)
        both = _seen(*images, frame)
        return RegistrationProblem(frame.grid, *both, *weights, *points, held=held, features=features, labels=labels)

    thick = any(_sparse_axis(_steps(a.image, b.image)) is not None for a, b in ((fixed, moving), (moving, fixed)))
    return max(map(seen, _THICKNESSES), key=_likeness) if thick else seen(0.0)


def _pair_on(frame: Image, fixed: PlacedImage, moving: PlacedImage, name: str) -> tuple[Tensor, Tensor] | None:
    """Return the features or the labels of both images on the frame, None where they are not given."""
    first, second = (getattr(placed, name) for placed in (fixed, moving))
    if first is None or second is None:
        return None
    if name == "labels":
        return resample(first, frame, mode="nearest"), resample(second, frame, mode="nearest")
    like = fixed.image.data
    return resample(first, frame, outside=None).to(like), resample(second, frame, outside=None).to(like)


def _likeness(problem: RegistrationProblem) -> float:
    return float(lncc(problem.fixed, problem.moving, mask=problem.mask, stride=3).mean())


def _seen(fixed: Image, moving: Image, frame: Image) -> tuple[Tensor, Tensor]:
    """Return both images on the frame, each as the slices of the other would show it."""
    images = [resample(image, frame, outside=None).to(fixed.data) for image in (fixed, moving)]
    return _through(replace(frame, data=images[0]), moving), _through(replace(frame, data=images[1]), fixed)


def thin_axes(grid: Grid) -> tuple[int, ...]:
    """Return the axes with few nodes; none where all have few."""
    thin = tuple(axis for axis, nodes in enumerate(grid.shape) if nodes < MIN_NODES)
    return thin if len(thin) < grid.dim else ()


def _steps(image: Image, frame: Image) -> Tensor:
    """Return by how many nodes of the frame one moves with each axis of an image, the columns of ``(D, D)``."""
    sides, nodes = (torch.tensor(one.grid.spacing, dtype=torch.float64, device="cpu") for one in (image, frame))
    ends = torch.diag(sides)
    ends = torch.cat([ends, torch.zeros_like(ends[:, :1])], dim=1).unsqueeze(0)
    places = frame.to_grid(image.to_world(ends))[0] / nodes.unsqueeze(1)
    return places[:, :-1] - places[:, -1:]


def _sparse_axis(steps: Tensor) -> int | None:
    """Return the axis of an image whose slices are far apart, against nodes of the frame and its other voxel sides."""
    second, longest = steps.norm(dim=0).sort().values[-2:].tolist()
    return int(steps.norm(dim=0).argmax()) if longest >= _SPARSE * max(second, 1.0) else None


def _across(image: Image, frame: Image) -> int | None:
    """Return the axis of the frame across slices that are far apart, None without one."""
    steps = _steps(image, frame)
    axis = _sparse_axis(steps)
    if axis is None:
        return None
    step = steps[:, axis].abs()
    return int(step.argmax()) if float(step.max() / step.norm()) > _ALONG else None


def _slice_step(image: Image, seen: Image) -> tuple[int, float, Tensor] | None:
    """Return the way from slice to slice of ``image`` if those are far apart in ``seen``, None if they are not.

    Returns:
        The axis of ``image``, the way's length in nodes of ``seen``, and the way there in units of spacing.
    """
    steps, grid = _steps(image, seen), seen.grid
    axis = _sparse_axis(steps)
    if axis is None:
        return None
    step = [nodes * h for nodes, h in zip(steps[:, axis].tolist(), grid.spacing, strict=True)]
    like = torch.empty(0, dtype=torch.float64, device=seen.data.device)
    return axis, float(steps[:, axis].norm()), grid.along(step, like)


def _through(seen: Image, image: Image) -> Tensor:
    """Return an image as another with the slices of ``image`` would show it, if those are far apart; else as it is.

    Notes:
        Between two slices stands a mixture of both, which looks like neither. To match it with the tissue that is there
        the map would bend: with slices 5 voxels apart, from an error of 0.2 to one of 0.5 mm.
    """
    grid, found = seen.grid, _slice_step(image, seen)
    if found is None:
        return seen.data
    axis, _, step = found

    def values(rows: slice) -> Tensor:
        points = grid.points(dtype=torch.float64, device=seen.data.device, rows=rows)
        number = image.to_grid(seen.to_world(points))[:, axis : axis + 1] / image.grid.spacing[axis]
        below = number.floor().clamp(0, image.grid.shape[axis] - 2)
        first, second = (sample(seen.data, points + (k - number) * step, grid) for k in (below, below + 1))
        return first.lerp(second, (number - below).clamp(0, 1).to(first))

    return over_slabs(values, grid.shape, seen.data.device)


def _averaged(seen: Image, image: Image, thickness: float) -> Image:
    """Return an image averaged over a thickness in distances of the slices of ``image`` if those are far apart.

    Notes:
        Slices are means, and where they are compared with points, the map bends to match what differs: with means of
        8 voxels, from an error of 0.30 to one of 0.51 mm instead of 0.21.
    """
    grid, found = seen.grid, _slice_step(image, seen) if thickness else None
    if found is None:
        return seen
    _, nodes, step = found
    count = math.ceil(thickness * nodes)

    def values(rows: slice) -> Tensor:
        points = grid.points(dtype=torch.float64, device=seen.data.device, rows=rows)
        offsets = [((k + 0.5) / count - 0.5) * thickness for k in range(count)]
        shown = (sample(seen.data, points + offset * step, grid) for offset in offsets)
        return sum(shown, next(shown)) / count

    return replace(seen, data=over_slabs(values, grid.shape, seen.data.device))


def _mask_on(frame: Image, placed: PlacedImage) -> Tensor | None:
    """Return the weights of an image on the frame, None if they are 1 everywhere."""
    image, mask = placed.image, placed.mask
    if mask is None and same_place(image, frame):
        return None
    mask = replace(image, data=torch.ones_like(image.data[:, :1])) if mask is None else mask
    weights = resample(mask, frame)
    return None if bool((weights == 1).all()) else weights
