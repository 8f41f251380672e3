"""The data of all pictures of a registration: slices of the images and of the map, and common scales."""

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
_SCALE_END = 99.8  # percentile at which a scale ends
_SMALLEST = 1e-3  # smaller determinants, also of folds, are drawn as this
# The scales reach at least this far: to half and twice the volume, to half a voxel.
_SHORTEST_SCALES = {"log_det": math.log(2), "inverse_error": 0.5}
_BINS = 81
_COLOURED = (3, 4)  # numbers of channels of colour pictures, without and with alpha
_USED = 0.96  # share of an axis that slices are taken from: those at its ends show nothing


@dataclass(frozen=True)
class Slices:
    """Slices of one plane by the name of their field, each ``(n, C, n_down, n_across)``.

    ``fixed``, ``warped``, ``moving`` (after the alignment) and, with an alignment, ``original`` (before it) are from 0
    to 1; ``before`` and ``after`` are |fixed − moving| and |fixed − warped| in grey; ``u`` is in units of spacing;
    ``log_det``, ``divergence``, ``rotation`` (the curl in 2D, its length in 3D) have no unit; ``inverse_error`` is
    |φ(φ⁻¹(x)) − x| in voxels.
    """

    plane: Plane
    numbers: tuple[int, ...]
    fields: dict[str, Tensor]

    @property
    def middle(self) -> int:
        """Position of the middle slice among them."""
        return self.numbers.index(self.plane.middle)


@dataclass(frozen=True)
class ReportData:
    """Everything that is drawn of one pair, on the CPU.

    Attributes:
        slices: of each plane.
        fixed: fixed image.
        moving: moving image, at its own position.
        result: what the registration returned.
        limits: where the scale of each field ends, by its name.
        volumes: histogram of log J between −limit and limit, in nodes.
    """

    slices: tuple[Slices, ...]
    fixed: Image
    moving: Image
    result: RegistrationResult
    limits: dict[str, float]
    volumes: Tensor


def make_report_data(fixed: Image, moving: Image, result: RegistrationResult, *, slices: int = 15) -> ReportData:
    """Return the data of all pictures of a registration.

    Args:
        fixed: fixed image.
        moving: moving image, at its own position.
        result: a result of one pair (batch of 1) on the fixed grid.
        slices: number of slices of each plane at most, at equal distances, with the middle one.

    Returns:
        `ReportData`, on the CPU.
    """
    fixed, moving = fixed.to("cpu"), moving.to("cpu")
    fields = derivative_fields(result.displacement.detach().cpu(), fixed.grid)
    fields["log_det"] = log_volume(fields.pop("determinant"))
    sampler = _SliceSampler(fixed, moving, result)
    stacks = []
    for plane in planes_of(fixed):
        numbers = evenly_spaced(plane, slices)
        stacks.append(Slices(plane, numbers, sampler.sample(plane, numbers) | _cut(fields, plane, numbers)))
    limits = _limits(fields, stacks)
    return ReportData(tuple(stacks), fixed, moving, result, limits, volume_counts(fields["log_det"], limits["log_det"]))


def evenly_spaced(plane: Plane, count: int) -> tuple[int, ...]:
    """Return at most ``count`` slices of a plane at equal distances, with the middle one, without the outermost."""
    reach = (plane.depth - 1) * _USED / 2
    half = (count - 1) // 2
    steps = [plane.middle + round(reach * k / max(half, 1)) for k in range(-half, half + 1)]
    return tuple(sorted({min(max(k, 0), plane.depth - 1) for k in steps}))


def _cut(fields: dict[str, Tensor], plane: Plane, numbers: Sequence[int]) -> dict[str, Tensor]:
    return {name: plane.cut(field, numbers) for name, field in fields.items()}


def _limits(fields: dict[str, Tensor], stacks: list[Slices]) -> dict[str, float]:
    """Return the ends of the scales. Both differences share one, so that they can be compared."""
    shown = {name: torch.cat([s.fields[name].flatten() for s in stacks]) for name in ("before", "inverse_error")}
    limits = {name: end_of_scale(values, _SHORTEST_SCALES.get(name, 1e-3)) for name, values in (fields | shown).items()}
    return limits | {"after": limits["before"]}


class _SliceSampler:
    """Samples the images and maps of a pair at the points of slices only."""

    def __init__(self, fixed: Image, moving: Image, result: RegistrationResult) -> None:
        self._fixed, self._moving, self._affine = fixed, moving, result.affine
        self._u, self._inverse = result.displacement.detach().cpu(), result.inverse.detach().cpu()
        warped = replace(moving, data=result.warped.detach().cpu().float(), grid=fixed.grid)
        greys = grey(fixed), grey(moving)
        self._grey = greys[1]
        self._on_grid = {
            "fixed": to_unit(fixed.data, fixed.data),
            "warped": to_unit(warped.data, moving.data),
            "grey": to_unit(greys[0], greys[0]),
            "after": to_unit(grey(warped), greys[1]),
            "u": self._u,
        }

    def sample(self, plane: Plane, numbers: Sequence[int]) -> dict[str, Tensor]:
        """Return slices of the images, the differences, the displacement and the inverse consistency."""
        points = plane.points(numbers)
        found = _cut(self._on_grid, plane, numbers)
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
        values = sample_at_fixed(both, self._moving, self._fixed, points, affine)
        colours, grey_values = to_unit(values[:, :-1], self._moving.data), to_unit(values[:, -1:], self._grey)
        return plane.arrange(colours), plane.arrange(grey_values)

    def _error(self, plane: Plane, points: Tensor, numbers: Sequence[int]) -> Tensor:
        """Return |w(x) + u(x + w(x))| in voxels."""
        back = plane.chosen(self._inverse, numbers)

        def error(rows: slice) -> Tensor:
            part = back[:, :, rows]
            return voxels(part + sample(self._u, points[:, :, rows] + part, plane.grid), plane.grid)

        return plane.arrange(over_slabs(error, points.shape[2:], points.device))


def sample_at_fixed(values: Tensor, image: Image, fixed: Image, points: Tensor, affine: Affine | None = None) -> Tensor:
    """Return values on an image's grid at points of the fixed grid, mapped by ``affine``; 0 outside the image."""
    values = values.float()

    def at(rows: slice) -> Tensor:
        world = fixed.to_world(points[:, :, rows])
        place = image.to_grid(world if affine is None else affine(world))
        return sample(values, place, image.grid, outside=0.0)

    return over_slabs(at, points.shape[2:], points.device)


def log_volume(det: Tensor) -> Tensor:
    """Return log J; folds and near folds become log 0.001."""
    return det.clamp(min=_SMALLEST).log()


def volume_counts(log_det: Tensor, limit: float) -> Tensor:
    """Return the histogram of the values between −limit and limit, without those outside."""
    return torch.histc(log_det.float(), _BINS, -limit, limit)


def end_of_scale(values: Tensor, least: float) -> float:
    """Return the percentile of |values| at which their scale ends, at least ``least``."""
    return max(quantiles(values.abs(), _SCALE_END)[0], least)


def to_unit(values: Tensor, scale: Tensor) -> Tensor:
    """Return values with the dark and bright ends of ``scale`` at 0 and 1, one scale for all colours, without alpha.

    Of channels that are no colours the first is used. NaN becomes 0.
    """
    colours = slice(0, 3) if scale.shape[1] in _COLOURED else slice(0, 1)
    low, high = quantiles(scale[:, colours], *_PERCENTILES)
    return ((values[:, colours] - low) / max(high - low, 1e-12)).clamp(0, 1).nan_to_num(0.0)


def grey(image: Image) -> Tensor:
    """Return the luminance of a colour picture, else the first channel, ``(1, 1, *S)``."""
    return luminance(image).data if image.data.shape[1] in _COLOURED else image.data[:, :1]


def quantiles(values: Tensor, *percent: float) -> list[float]:
    """Return percentiles of the finite values, of at most a million of them at regular steps."""
    flat = values.reshape(-1)
    some = flat[:: 1 + flat.numel() // 2**20]
    finite = some[some.isfinite()].cpu()
    return [float(q) for q in np.percentile(finite.numpy(), percent)] if len(finite) else [0.0] * len(percent)


def derivative_fields(u: Tensor, grid: Grid) -> dict[str, Tensor]:
    """Return determinant, divergence and rotation of φ = id + u from one set of derivatives.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``determinant`` of ∇φ, ``divergence`` of u and ``rotation`` (curl u in 2D, |curl u| in 3D), each
        ``(1, 1, *S)``, as the functions of `torchdeform.core.derivatives` give them.

    Notes:
        Computed slab by slab along the first axis, to save memory.
    """
    names = ("determinant", "divergence", "rotation")
    found = by_slabs(lambda w, part: _fields_of(jacobian(w, part)), u, grid)
    return dict(zip(names, found.split(1, dim=1), strict=True))


def _fields_of(slope: Tensor) -> Tensor:
    """Return determinant, divergence and rotation ``(1, 3, *T)`` where ∂_a u_k are ``slope`` ``(1, D, D, *T)``."""
    dim = slope.shape[1]
    for k in range(dim):
        slope[:, k, k] += 1
    det = determinant(slope)
    trace = torch.stack([slope[:, k, k] for k in range(dim)]).sum(0).unsqueeze(1) - dim
    turn = torch.stack([slope[:, b, a] - slope[:, a, b] for a, b in CURL_PAIRS[dim]], dim=1)
    return torch.cat([det, trace, signed_or_length(turn)], dim=1)


def signed_or_length(turn: Tensor) -> Tensor:
    """Return the curl ``(B, 1, *S)`` itself in 2D, its length in 3D."""
    return turn if turn.shape[1] == 1 else turn.square().sum(1, keepdim=True).sqrt()
