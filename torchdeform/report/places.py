"""Where to look: the slices that show something, and the place where the images fit worst."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import AVERAGE_POOL
from torchdeform.report.landmarks import Landmarks
from torchdeform.report.planes import Plane
from torchdeform.report.sampling import FIXED, WARPED, PairSampler

_EMPTY = 0.1  # a slice with less than this share of the largest contrast shows nothing
_SAMPLES = 2**12  # pixels of a slice that its contrast is measured by, about
_NODES = {2: 128, 3: 48}  # nodes along an axis among which the worst place is looked for, about
_WINDOW = 5  # of these nodes over which is averaged


@dataclass(frozen=True)
class Place:
    """A point of the fixed grid in nodes, array order, and why it is looked at."""

    node: tuple[float, ...]
    reason: str


def span(picture: Tensor, axis: int) -> tuple[int, int]:
    """Return the first and the last slice along an array axis of ``(1, 1, *S)`` that has contrast."""
    rows = picture[0, 0].movedim(axis, 0).flatten(1)
    contrast = rows[:, :: 1 + rows.shape[1] // _SAMPLES].float().std(1)
    filled = (contrast > _EMPTY * contrast.max()).nonzero().flatten()
    return (int(filled[0]), int(filled[-1])) if len(filled) else (0, len(rows) - 1)


def chosen_slices(plane: Plane, ends: tuple[int, int], most: int, wanted: Sequence[int]) -> tuple[int, ...]:
    """Return the numbers of all slices from end to end, or ``most`` of them at equal distances; and those wanted.

    Args:
        plane: the plane.
        ends: first and last slice of interest.
        most: number of slices at most, without those wanted.
        wanted: slices that must be among them.
    """
    if plane.depth == 1:
        return (0,)
    first, last = ends
    count = min(most, last - first + 1)
    step = (last - first + 1) / count
    return tuple(sorted({first + int((k + 0.5) * step) for k in range(count)} | set(wanted)))


def slice_of(plane: Plane, place: Place) -> int:
    """Return the number of the slice through a place."""
    return 0 if plane.through is None else min(max(round(place.node[plane.through]), 0), plane.depth - 1)


def worst_place(sampler: PairSampler, landmarks: Landmarks | None, absent: Tensor | None, *, alike: bool) -> Place:
    """Return the place where landmarks are farthest apart; else labels differ most; else the images do, on average.

    Args:
        sampler: of the pair.
        landmarks: those of the pair.
        absent: weight ``(1, 1, *S)`` of what is not compared.
        alike: whether the images have one contrast, so that grey values can be compared; else their slopes are.

    Notes:
        Labels and images are compared at some nodes within the moving image, in a window of a tenth of the image.
    """
    if landmarks is not None:
        worst = int(landmarks.distances[WARPED].argmax())
        apart = f"{float(landmarks.distances[WARPED][worst]):.3g} {landmarks.unit}"
        return Place(tuple(landmarks.fixed[worst].tolist()), f"landmark {worst + 1} is {apart} off")
    grid = sampler.fixed.grid
    step = [-(-n // _NODES[grid.dim]) for n in grid.shape]
    some = (..., *(slice(h // 2, None, h) for h in step))
    points = grid.points()[some].to(sampler.u)
    fixed, warped = (sampler.at(image, points, lambda field: field[some]) for image in (FIXED, WARPED))
    if fixed.labels is not None and warped.labels is not None:
        differ = ((fixed.labels != warped.labels) & warped.inside).float()
        return Place(_densest(differ, step, grid), "the labels differ most here")
    weight = warped.inside.float() if fixed.mask is None else (warped.inside & (fixed.mask != 0)).float()
    weight = weight if absent is None else weight * (1 - absent[some])
    first, second = (image.grey if alike else _steepness(image.grey) for image in (fixed, warped))
    what = "grey values" if alike else "edges"
    return Place(_densest((first - second).abs() * weight, step, grid), f"the {what} differ most here")


def _steepness(values: Tensor) -> Tensor:
    """Return the length of the gradient, 1 on average."""
    axes = [axis for axis in range(2, values.dim()) if values.shape[axis] > 1]
    slopes = torch.stack(torch.gradient(values, dim=axes)).norm(dim=0)
    return slopes / slopes.mean().clamp(min=1e-12)


def _densest(values: Tensor, step: Sequence[int], grid: Grid) -> tuple[float, ...]:
    """Return the node around which values at every ``step``-th node are largest."""
    window = [min(_WINDOW, n - 1 + n % 2) for n in values.shape[2:]]
    mean = AVERAGE_POOL[grid.dim](values, window, 1, [w // 2 for w in window])
    index = np.unravel_index(int(mean.argmax()), mean.shape[2:])  # torch's loads sympy for it
    return tuple(float(min(int(k) * h + h // 2, n - 1)) for k, h, n in zip(index, step, grid.shape, strict=True))
