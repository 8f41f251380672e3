"""How well two images fit by what an expert marked: overlap and distance of regions, distance of landmarks."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.image import Image, resample
from torchdeform.core.interpolation import LABEL_MODE, interpolator
from torchdeform.core.transform import Affine, Transform
from torchdeform.core.warp import sample
from torchdeform.errors import InputError

_Pair = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Measures:
    """How well fixed and moving fit in one position.

    Attributes:
        labels: the regions compared.
        dice: overlap of each ``(B, L)``, 0 to 1; L may be 0.
        hausdorff: 95 % Hausdorff distance of each ``(B, L)`` in units of spacing (mm for images).
        distances: of each pair of landmarks ``(B, n)`` in units of spacing (mm for images); None without landmarks.
    """

    labels: tuple[int, ...]
    dice: Tensor
    hausdorff: Tensor
    distances: Tensor | None = None


@dataclass(frozen=True)
class Evaluation:
    """The measures before and after.

    Attributes:
        before: with both images where they are.
        aligned: after the affine map; None without one.
        after: after the affine map and the displacement.
        label_interpolation: how labels of the moving image were interpolated, a mode of `interpolator`; None without.
    """

    before: Measures
    aligned: Measures | None
    after: Measures
    label_interpolation: str | None = None


def evaluate_tensors(
    u: Tensor, grid: Grid, *, labels: _Pair | None = None, points: _Pair | None = None
) -> Evaluation | None:
    """Return the measures of labels and landmarks on one grid without and with u; None where there are neither.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.
        labels: of the fixed and the moving image, ``(B or 1, 1, *S)``.
        points: landmarks of both ``(B, D, n)`` in units of spacing.
    """
    if labels is None and points is None:
        return None

    def at(w: Tensor) -> Measures:
        regions = labels and (labels[0], _warped_labels(labels[1].to(w), w, grid))
        pairs = points and (points[0] + sample(w, points[0].to(w), grid), points[1])
        return _measures(regions, pairs, grid, labels)

    return Evaluation(at(u.new_zeros(()).expand_as(u)), None, at(u), labels and LABEL_MODE)


def evaluate_images(
    fixed: Image,
    affine: Affine | None,
    u: Tensor,
    *,
    labels: tuple[Image, Image] | None = None,
    points: _Pair | None = None,
) -> Evaluation | None:
    """Return the measures of labels and landmarks in the world, before, after ``affine``, and after ``u`` as well.

    Args:
        fixed: the fixed image.
        affine: from the world of the fixed image to that of the moving one; None for the identity.
        u: displacement ``(1, D, *S)`` on the fixed grid, applied first.
        labels: of both images, on any grid.
        points: landmarks of both in the world ``(1, D, n)``.
    """
    regions = labels and (resample(labels[0], fixed, mode="nearest"), labels[1])
    if regions is None and points is None:
        return None

    def at(world: Affine | None, w: Tensor) -> Measures:
        make = partial(Transform.from_displacement, fixed=fixed, affine=world)
        warped = regions and (regions[0], make(w).labels(regions[1], fixed).data)
        pairs = points and (make(w.double()).points(points[0].double().to(w.device)), points[1])
        return _measures(warped, pairs, fixed.grid, regions and (regions[0], regions[1].data))

    zero = u.new_zeros(()).expand_as(u)  # takes no memory
    aligned = None if affine is None else at(affine, zero)
    return Evaluation(at(None, zero), aligned, at(affine, u), regions and LABEL_MODE)


def _warped_labels(labels: Tensor, u: Tensor, grid: Grid) -> Tensor:
    """Return the labels ``(B or 1, 1, *S)`` of each item through its displacement, continued beyond the edge."""
    items = labels.expand(len(u), *labels.shape[1:]).split(1)
    return torch.cat([_warped_item(item, w, grid) for item, w in zip(items, u.split(1), strict=True)])


def _warped_item(labels: Tensor, u: Tensor, grid: Grid) -> Tensor:
    at = interpolator(labels, grid, mode=LABEL_MODE, outside=None)

    def values(rows: slice) -> Tensor:
        return at(grid.points(dtype=torch.float64, device=u.device, rows=rows) + u[:, :, rows])

    return over_slabs(values, grid.shape, u.device)


def _measures(regions: _Pair | None, pairs: _Pair | None, grid: Grid, original: _Pair | None) -> Measures:
    """Return the measures of regions and of points; the labels are those that both images had at first."""
    distances = pairs and landmark_distances(pairs[0].double(), pairs[1].to(pairs[0].device).double())
    if regions is None or original is None:
        empty = torch.empty(0, 0, dtype=torch.float64, device="cpu")
        return Measures((), empty, empty, distances)
    labels = common_labels(*original)
    return Measures(labels, dice(*regions, labels), hausdorff(*regions, labels, grid), distances)


def common_labels(
    fixed: Tensor, moving: Tensor, *, names: tuple[str, str] = ("fixed_labels", "moving_labels")
) -> tuple[int, ...]:
    """Return the labels, other than 0, that both have.

    Args:
        fixed: ``(B, 1, *S)``, whole numbers of any type.
        moving: the same, of any shape.
        names: what to call them in messages.

    Raises:
        InputError: numbers that are not whole, or none in common.
    """
    found = []
    for name, field in zip(names, (fixed, moving), strict=True):
        values = field.unique()
        if values.is_floating_point() and not bool((values.isfinite() & (values == values.round())).all()):
            raise InputError(f"{name} must hold whole numbers; check that it is the right one")
        found.append({int(v) for v in values.tolist()} - {0})
    if not found[0] & found[1]:
        raise InputError(f"{' and '.join(names)} have no label in common; check that they are the right ones")
    return tuple(sorted(found[0] & found[1]))


def dice(fixed: Tensor, warped: Tensor, labels: tuple[int, ...]) -> Tensor:
    """Return 2 |A ∩ B| / (|A| + |B|) for the regions A and B of every label.

    Args:
        fixed: labels ``(B, 1, *S)``.
        warped: the same shape.
        labels: those to compare.

    Returns:
        ``(B, L)``, NaN where neither image has the label.
    """
    _require_same(fixed, warped, "dice")
    parts = [_overlap(fixed == label, warped == label) for label in labels]
    return torch.stack(parts, dim=1) if parts else torch.empty(len(fixed), 0, dtype=torch.float64, device="cpu")


def _overlap(a: Tensor, b: Tensor) -> Tensor:
    both, first, second = (region.flatten(1).sum(1).double() for region in (a & b, a, b))
    return 2 * both / (first + second)


def hausdorff(
    fixed: Tensor, warped: Tensor, labels: tuple[int, ...], grid: Grid, *, percentile: float = 95.0
) -> Tensor:
    """Return the larger of both directed distances between the surfaces of every label.

    The directed distance from A to B is the percentile of the distances from A's surface voxels to the nearest ones of
    B's. A surface voxel has a neighbour across a face that is not of the label, or is at the edge of the image.

    Args:
        fixed: labels ``(B, 1, *S)``.
        warped: the same shape.
        labels: those to compare.
        grid: their grid.
        percentile: 95 by default; 100 gives the Hausdorff distance.

    Returns:
        ``(B, L)`` in units of spacing, infinite where one image lacks the label.

    Notes:
        By Euclidean distance transforms (scipy) of the box around the regions; linear in its size.
    """
    _require_same(fixed, warped, "hausdorff")
    grid.check_scalar(fixed.double(), "hausdorff: fixed")
    rows = [
        [_surface_distance(a[0] == label, b[0] == label, grid, percentile) for label in labels]
        for a, b in zip(fixed.cpu(), warped.cpu(), strict=True)
    ]
    return torch.tensor(rows, dtype=torch.float64, device="cpu").view(len(fixed), len(labels))


def _require_same(fixed: Tensor, warped: Tensor, name: str) -> None:
    if fixed.shape != warped.shape:
        raise InputError(f"{name}: both must have one shape, got {tuple(fixed.shape)} and {tuple(warped.shape)}")


def _surface_distance(a: Tensor, b: Tensor, grid: Grid, percentile: float) -> float:
    """Return the larger directed distance between the surfaces of two regions, in the box around both."""
    from scipy.ndimage import binary_erosion, distance_transform_edt, find_objects

    if not (bool(a.any()) and bool(b.any())):
        return float("inf")
    (box,) = find_objects((a | b).byte().numpy())
    first, second = (region & ~np.asarray(binary_erosion(region), bool) for region in (a.numpy()[box], b.numpy()[box]))
    far = [np.asarray(distance_transform_edt(~surface, sampling=grid.spacing)) for surface in (first, second)]
    return max(float(np.percentile(d[surface], percentile)) for d, surface in zip(far, (second, first), strict=True))


def landmark_distances(fixed: Tensor, moving: Tensor) -> Tensor:
    """Return |p − q| of corresponding points ``(B, D, n)`` as ``(B, n)``, in their unit."""
    return (fixed - moving).square().sum(1).sqrt()
