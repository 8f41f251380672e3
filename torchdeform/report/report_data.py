"""The data of all pictures of a registration: slices of the images and of the map, and common scales."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, by_slabs, determinant, jacobian
from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.image import Image
from torchdeform.core.warp import sample, voxels
from torchdeform.metrics.similarity import similarity_weights
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.result import RegistrationResult
from torchdeform.report.landmarks import landmarks_of
from torchdeform.report.marks import Known, Marks, marks_of
from torchdeform.report.places import Place, chosen_slices, slice_of, span, worst_place
from torchdeform.report.planes import Plane, planes_of
from torchdeform.report.sampling import FIXED, MOVING, WARPED, PairSampler, Sampled, grey, quantiles

_SCALE_END = 99.8  # percentile at which a scale ends
_SMALLEST = 1e-3  # smaller determinants, also of folds, are drawn as this
# The scales reach at least this far: to half and twice the volume, to half a voxel.
_SHORTEST_SCALES = {"log_det": math.log(2), "inverse_error": 0.5}
_BINS = 81
_ALL = 130  # slices of all planes together that are shown if there are no more
_MOST = 21  # slices of a plane otherwise
_OF_ONE_CONTRAST = {"lncc", "ncc", "ssd"}  # measures that are for such images
_FEW = 5  # slices of a plane in a light report


@dataclass(frozen=True)
class Slices:
    """Slices of one plane by the name of their field, each ``(n, C, n_down, n_across)``, and what is drawn over them.

    ``fixed``, ``warped``, ``moving`` (after the alignment) and, with an alignment, ``original`` (before it) are from 0
    to 1; ``before`` and ``after`` are |fixed − moving| and |fixed − warped| in grey, NaN outside of the moving image;
    ``u`` is in units of spacing; ``log_det``, ``divergence``, ``rotation`` (the curl in 2D, its length in 3D) have no
    unit; ``inverse_error`` is |φ(φ⁻¹(x)) − x| in voxels. ``start`` is the position of the slice to show first.
    """

    plane: Plane
    numbers: tuple[int, ...]
    fields: dict[str, Tensor]
    marks: Marks = field(default_factory=dict)
    start: int = 0

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
        limits: where the scale of each field ends, by its name, and that of the landmarks.
        volumes: histogram of log J between −limit and limit, in nodes.
        known: what is drawn besides the images.
        light: whether the page leaves out the pictures of the map.
    """

    slices: tuple[Slices, ...]
    fixed: Image
    moving: Image
    result: RegistrationResult
    limits: dict[str, float]
    volumes: Tensor
    known: Known
    light: bool = False


def make_report_data(
    fixed: Image,
    moving: Image,
    result: RegistrationResult,
    *,
    annotations: Annotations | None = None,
    slices: int | None = None,
    light: bool = False,
) -> ReportData:
    """Return the data of all pictures of a registration.

    Args:
        fixed: fixed image.
        moving: moving image, at its own position.
        result: a result of one pair (batch of 1) on the fixed grid.
        annotations: labels, landmarks and masks to draw, those that were given to `register`.
        slices: number of slices of each plane, at equal distances. When None, all that show something, or 21 of them.
            The middle one and that with the worst place are always among them.
        light: for a small page: few slices, no pictures of the map.

    Returns:
        `ReportData`, on the CPU.
    """
    given = (annotations or Annotations()).to("cpu")
    sampler = PairSampler(fixed.to("cpu"), moving.to("cpu"), result, given)
    fields = derivative_fields(sampler.u, fixed.grid)
    fields["log_det"] = log_volume(fields.pop("determinant"))
    known = _known(sampler, result, given)
    most = _FEW if light and slices is None else slices
    stacks = [
        _slices(sampler, result, fields, known, plane, numbers)
        for plane, numbers in _numbers(sampler.fixed, known.worst, most).items()
    ]
    limits = _limits(fields, stacks) | {"landmarks": known.limit}
    volumes = volume_counts(fields["log_det"], limits["log_det"])
    return ReportData(tuple(stacks), sampler.fixed, sampler.moving, result, limits, volumes, known, light)


def _known(sampler: PairSampler, result: RegistrationResult, annotations: Annotations) -> Known:
    """Return what is drawn besides the images."""
    absent = result.absent
    absent = None if absent is None else absent.detach().cpu()
    landmarks = landmarks_of(sampler.fixed, result, annotations)
    alike = set(similarity_weights(result.settings.similarity.measure)) <= _OF_ONE_CONTRAST
    return Known(worst_place(sampler, landmarks, absent, alike=alike), landmarks, absent)


def _numbers(fixed: Image, worst: Place, most: int | None) -> dict[Plane, tuple[int, ...]]:
    """Return the slices to show of each plane."""
    picture = grey(fixed)
    ends = {plane: (0, 0) if plane.through is None else span(picture, plane.through) for plane in planes_of(fixed)}
    if most is None:
        every = sum(last - first + 1 for first, last in ends.values())
        most = every if every <= _ALL else _MOST
    return {
        plane: chosen_slices(plane, reach, most, (plane.middle, slice_of(plane, worst)))
        for plane, reach in ends.items()
    }


def _slices(
    sampler: PairSampler,
    result: RegistrationResult,
    fields: dict[str, Tensor],
    known: Known,
    plane: Plane,
    numbers: tuple[int, ...],
) -> Slices:
    sampled = {name: sampler.at_slices(name, plane, numbers) for name in (FIXED, *sampler.stages)}
    shown = _images(sampled)
    shown |= {name: plane.cut(field, numbers) for name, field in {"u": sampler.u, **fields}.items()}
    shown["inverse_error"] = _inverse_error(result.inverse.detach().cpu(), sampler.u, plane, numbers)
    marks = marks_of(plane, numbers, sampled, known)
    return Slices(plane, numbers, shown, marks, numbers.index(slice_of(plane, known.worst)))


def _images(sampled: dict[str, Sampled]) -> dict[str, Tensor]:
    """Return the images, and the differences of the moving one where it has values."""
    fixed, moving, warped = (sampled[name] for name in (FIXED, MOVING, WARPED))
    return {name: image.colours for name, image in sampled.items()} | {
        "before": (moving.grey - fixed.grey).abs().where(moving.inside, torch.nan),
        "after": (warped.grey - fixed.grey).abs().where(warped.inside, torch.nan),
    }


def _inverse_error(inverse: Tensor, u: Tensor, plane: Plane, numbers: Sequence[int]) -> Tensor:
    """Return |w(x) + u(x + w(x))| in voxels."""
    points, back = plane.points(numbers), plane.chosen(inverse, numbers)

    def error(rows: slice) -> Tensor:
        part = back[:, :, rows]
        return voxels(part + sample(u, points[:, :, rows] + part, plane.grid), plane.grid)

    return plane.arrange(over_slabs(error, points.shape[2:], points.device))


def _limits(fields: dict[str, Tensor], stacks: list[Slices]) -> dict[str, float]:
    """Return the ends of the scales. Both differences share one, so that they can be compared."""
    shown = {name: torch.cat([s.fields[name].flatten() for s in stacks]) for name in ("before", "inverse_error")}
    limits = {name: end_of_scale(values, _SHORTEST_SCALES.get(name, 1e-3)) for name, values in (fields | shown).items()}
    return limits | {"after": limits["before"]}


def log_volume(det: Tensor) -> Tensor:
    """Return log J; folds and near folds become log 0.001."""
    return det.clamp(min=_SMALLEST).log()


def volume_counts(log_det: Tensor, limit: float) -> Tensor:
    """Return the histogram of the values between −limit and limit, without those outside."""
    return torch.histc(log_det.float(), _BINS, -limit, limit)


def end_of_scale(values: Tensor, least: float) -> float:
    """Return the percentile of |values| at which their scale ends, at least ``least``."""
    return max(quantiles(values.abs(), _SCALE_END)[0], least)


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
