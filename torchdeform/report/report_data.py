"""What the pictures of a registration show: slices of the images and of what the map did, on one scale."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, by_slabs, determinant, jacobian
from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.image import Image, luminance
from torchdeform.core.transform import Affine
from torchdeform.core.warp import sample, voxels
from torchdeform.registration.result import RegistrationResult
from torchdeform.report.planes import Plane, planes_of

_PERCENTILES = (0.5, 99.5)
_BRIGHTEST = 99.8  # percentile that ends a scale
_SMALLEST = 1e-3  # determinants below this, folds among them, are drawn as this
# What the scales span at least: half and twice the volume, half a voxel.
_LEAST = {"log_det": math.log(2), "inverse_error": 0.5}
_BINS = 81
_COLOURED = (3, 4)  # channels of pictures in colour, without alpha and with it
_KEPT = 0.96  # of an axis: slices nearer to its ends show nothing


@dataclass(frozen=True)
class Slices:
    """Slices of one plane by the name of what they show, each ``(n, C, n_down, n_across)``.

    ``fixed``, ``warped``, ``moving`` (where the alignment has taken it) and, where there is an alignment, ``original``
    (where it was) run from 0 to 1; ``before`` and ``after`` are |fixed − moving| and |fixed − warped| in grey; ``u`` is
    in units of spacing; ``log_det``, ``divergence``, ``rotation`` (the curl in 2D, its length in 3D) have no unit;
    ``inverse_error`` is |φ(φ⁻¹(x)) − x| in voxels.
    """

    plane: Plane
    numbers: tuple[int, ...]
    fields: dict[str, Tensor]

    @property
    def middle(self) -> int:
        """Which of the slices is the middle one."""
        return self.numbers.index(self.plane.middle)


@dataclass(frozen=True)
class ReportData:
    """Everything that is drawn of one pair, on the CPU.

    Attributes:
        slices: of each plane.
        fixed: fixed image.
        moving: moving image, in its own place.
        result: what the registration returned.
        limits: where the scale of each field ends, by its name.
        volumes: how many nodes there are for each of equal steps of log J between −limit and limit.
    """

    slices: tuple[Slices, ...]
    fixed: Image
    moving: Image
    result: RegistrationResult
    limits: dict[str, float]
    volumes: Tensor


def make_report_data(fixed: Image, moving: Image, result: RegistrationResult, *, slices: int = 15) -> ReportData:
    """Cut what is to be drawn of a registration.

    Args:
        fixed: fixed image.
        moving: moving image, in its own place.
        result: a result of one pair (batch of 1) on the fixed grid.
        slices: how many of each plane at most, at equal distances, the middle one among them.

    Returns:
        `ReportData`, on the CPU.
    """
    fixed, moving = fixed.to("cpu"), moving.to("cpu")
    fields = rates(result.displacement.detach().cpu(), fixed.grid)
    fields["log_det"] = log_volume(fields.pop("determinant"))
    sampler = _SliceSampler(fixed, moving, result)
    stacks = []
    for plane in planes_of(fixed):
        numbers = spread(plane, slices)
        stacks.append(Slices(plane, numbers, sampler.sample(plane, numbers) | _cut(fields, plane, numbers)))
    limits = _limits(fields, stacks)
    return ReportData(tuple(stacks), fixed, moving, result, limits, volume_counts(fields["log_det"], limits["log_det"]))


def spread(plane: Plane, count: int) -> tuple[int, ...]:
    """Return at most so many slices of a plane at equal distances, the middle one among them, the outermost not."""
    reach = (plane.depth - 1) * _KEPT / 2
    half = (count - 1) // 2
    steps = [plane.middle + round(reach * k / max(half, 1)) for k in range(-half, half + 1)]
    return tuple(sorted({min(max(k, 0), plane.depth - 1) for k in steps}))


def _cut(fields: dict[str, Tensor], plane: Plane, numbers: Sequence[int]) -> dict[str, Tensor]:
    return {name: plane.cut(field, numbers) for name, field in fields.items()}


def _limits(fields: dict[str, Tensor], stacks: list[Slices]) -> dict[str, float]:
    """Return the ends of the scales; both differences share one, so that they can be compared."""
    shown = {name: torch.cat([s.fields[name].flatten() for s in stacks]) for name in ("before", "inverse_error")}
    limits = {name: end_of_scale(values, _LEAST.get(name, 1e-3)) for name, values in (fields | shown).items()}
    return limits | {"after": limits["before"]}


class _SliceSampler:
    """The images and maps of a pair, looked at in slices: only the points of the slices are sampled."""

    def __init__(self, fixed: Image, moving: Image, result: RegistrationResult) -> None:
        self._fixed, self._moving, self._affine = fixed, moving, result.affine
        self._u, self._inverse = result.displacement.detach().cpu(), result.inverse.detach().cpu()
        warped = replace(moving, data=result.warped.detach().cpu().float(), grid=fixed.grid)
        greys = grey(fixed), grey(moving)
        self._grey = greys[1]
        self._still = {
            "fixed": to_unit(fixed.data, fixed.data),
            "warped": to_unit(warped.data, moving.data),
            "grey": to_unit(greys[0], greys[0]),
            "after": to_unit(grey(warped), greys[1]),
            "u": self._u,
        }

    def sample(self, plane: Plane, numbers: Sequence[int]) -> dict[str, Tensor]:
        """Return slices of the images, the differences, the displacement and the error of the inverse."""
        points = plane.points(numbers)
        found = _cut(self._still, plane, numbers)
        fixed = found.pop("grey")
        found["moving"], before = self._sampled(plane, points, self._affine)
        if self._affine is not None:
            found["original"], _ = self._sampled(plane, points, None)
        return found | {
            "before": (before - fixed).abs(),
            "after": (found["after"] - fixed).abs(),
            "inverse_error": self._error(plane, points, numbers),
        }

    def _sampled(self, plane: Plane, points: Tensor, affine: Affine | None) -> tuple[Tensor, Tensor]:
        """Return the moving image in slices, in its colours and in grey."""
        both = torch.cat((self._moving.data, self._grey), dim=1)
        values = seen(both, self._moving, self._fixed, points, affine)
        colours, grey_values = to_unit(values[:, :-1], self._moving.data), to_unit(values[:, -1:], self._grey)
        return plane.arrange(colours), plane.arrange(grey_values)

    def _error(self, plane: Plane, points: Tensor, numbers: Sequence[int]) -> Tensor:
        """Return |w(x) + u(x + w(x))| in voxels."""
        back = plane.chosen(self._inverse, numbers)

        def error(rows: slice) -> Tensor:
            part = back[:, :, rows]
            return voxels(part + sample(self._u, points[:, :, rows] + part, plane.grid), plane.grid)

        return plane.arrange(over_slabs(error, points.shape[2:], points.device))


def seen(values: Tensor, image: Image, fixed: Image, points: Tensor, affine: Affine | None = None) -> Tensor:
    """Return values on an image's grid at points of the fixed grid, where ``affine`` takes them; 0 outside."""
    values = values.float()

    def at(rows: slice) -> Tensor:
        world = fixed.to_world(points[:, :, rows])
        place = image.to_grid(world if affine is None else affine(world))
        return sample(values, place, image.grid, outside=0.0)

    return over_slabs(at, points.shape[2:], points.device)


def log_volume(det: Tensor) -> Tensor:
    """Return log J; folds and what nearly folds are drawn as 0.001."""
    return det.clamp(min=_SMALLEST).log()


def volume_counts(log_det: Tensor, limit: float) -> Tensor:
    """Return how many values there are in each of equal steps between −limit and limit; those beyond are left out."""
    return torch.histc(log_det.float(), _BINS, -limit, limit)


def end_of_scale(values: Tensor, least: float) -> float:
    """Return what nearly all values keep below, which is where their scale ends."""
    return max(quantiles(values.abs(), _BRIGHTEST)[0], least)


def to_unit(values: Tensor, scale: Tensor) -> Tensor:
    """Return values with the dark and bright ends of ``scale`` at 0 and 1, all colours alike, alpha dropped.

    Of channels that are no colours the first is taken; what is not finite becomes 0.
    """
    colours = slice(0, 3) if scale.shape[1] in _COLOURED else slice(0, 1)
    low, high = quantiles(scale[:, colours], *_PERCENTILES)
    return ((values[:, colours] - low) / max(high - low, 1e-12)).clamp(0, 1).nan_to_num(0.0)


def grey(image: Image) -> Tensor:
    """Return the luminance of a picture, or the first of channels that are no colours, ``(1, 1, *S)``."""
    return luminance(image).data if image.data.shape[1] in _COLOURED else image.data[:, :1]


def quantiles(values: Tensor, *percent: float) -> list[float]:
    """Return percentiles of at most about a million values, taken at regular steps."""
    flat = values.reshape(-1)
    some = flat[:: 1 + flat.numel() // 2**20]
    finite = some[some.isfinite()].cpu()
    return [float(q) for q in np.percentile(finite.numpy(), percent)] if len(finite) else [0.0] * len(percent)


def rates(u: Tensor, grid: Grid) -> dict[str, Tensor]:
    """Return what φ = id + u does near each node, from one set of derivatives.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``determinant`` of ∇φ, ``divergence`` of u and ``rotation`` (curl u in 2D, |curl u| in 3D), each
        ``(1, 1, *S)``, as the functions of `torchdeform.core.derivatives` give them.

    Notes:
        Slab after slab along the first axis, so that the derivatives never fill the memory.
    """
    names = ("determinant", "divergence", "rotation")
    found = by_slabs(lambda w, part: _rates_of(jacobian(w, part)), u, grid)
    return dict(zip(names, found.split(1, dim=1), strict=True))


def _rates_of(slope: Tensor) -> Tensor:
    """Return determinant, divergence and rotation ``(1, 3, *T)`` where ∂_a u_k are ``slope`` ``(1, D, D, *T)``."""
    dim = slope.shape[1]
    for k in range(dim):
        slope[:, k, k] += 1
    det = determinant(slope)
    trace = torch.stack([slope[:, k, k] for k in range(dim)]).sum(0).unsqueeze(1) - dim
    turn = torch.stack([slope[:, b, a] - slope[:, a, b] for a, b in CURL_PAIRS[dim]], dim=1)
    rotation = turn if dim == 2 else turn.square().sum(1, keepdim=True).sqrt()
    return torch.cat([det, trace, rotation], dim=1)
