"""The table of similarity measures, and the similarity of two images by name: one measure or several with weights."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import AUTO
from torchdeform.errors import InputError, require_choice
from torchdeform.metrics.base import Similarity, channel_mean, mean, relative_weight, weighted
from torchdeform.metrics.correlation import CrossCorrelation, LocalCrossCorrelation, lncc, local_contrast, ncc
from torchdeform.metrics.gradients import GradientFields, ngf
from torchdeform.metrics.information import MutualInformation, mutual_information, normalised_mutual_information
from torchdeform.metrics.mind import mind_ssc, neighbour_pairs
from torchdeform.metrics.squares import MeanSquaredDifference, mind, ssd


@dataclass(frozen=True)
class Features:
    """What of an image is warped and compared.

    Attributes:
        of: returns the features ``(B, C·K, *S)`` of an image ``(B, C, *S)``.
        count: returns K, by the dimension.
    """

    of: Callable[[Tensor], Tensor]
    count: Callable[[int], int]


INTENSITIES = Features(lambda image: image, lambda dim: 1)
SELF_SIMILARITIES = Features(mind_ssc, lambda dim: len(neighbour_pairs(dim)))


@dataclass(frozen=True)
class Measure:
    """A similarity measure: all that the package knows about it.

    Attributes:
        function: S(fixed, warped, mask=..) of two images, ``(B,)``, higher is better; autograd has its derivative.
        closed_form: returns the `Similarity` to the features of the fixed image, which knows its derivative.
        memory: bytes that a registration holds for each voxel and channel, in 2D and in 3D, measured by
            ``scripts/benchmarks/memory.py``.
        time: time of a step over that of a step with LNCC.
        options: what both take of ``window`` (width in voxels) and ``grid``.
        features: what of the images is compared.
        best: S of an image with itself; None where it depends on the image.
        unrelated: returns S of features that have nothing to do with each other, from those of both images
            ``(B, C', *S)``, their weight and S of the fixed ones with themselves; see `mark`.
        weighs_contrast: whether S itself leaves out what has no contrast in the fixed image.
        common_scale: whether intensities are compared as they are, so that both images need one scale.
        references: keys in ``references.bib``; none for what is common property.
    """

    function: Callable[..., Tensor]
    closed_form: Callable[..., Similarity]
    memory: tuple[float, float]
    time: float
    options: tuple[str, ...] = ()
    features: Features = INTENSITIES
    best: float | None = None
    unrelated: Callable[[Tensor, Tensor, Tensor | None, Tensor], Tensor] = lambda fixed, warped, weight, own: 0 * own
    weighs_contrast: bool = False
    common_scale: bool = False
    references: tuple[str, ...] = ()

    @property
    def compares_features(self) -> bool:
        """Whether it makes features of the images, and compares these."""
        return self.features is not INTENSITIES

    def choose(self, **available: object) -> dict[str, Any]:
        """Return those of the options ``window`` and ``grid`` that this measure takes."""
        return {name: available[name] for name in self.options}


# What ``auto`` chooses for most images.
_USUAL = "lncc"

# Windows of LNCC over a voxel along each axis. With 3 in place of 9 it takes a fifth of the time; Dice changes by
# +0.002 (mouse brains), +0.001 (slices, hearts), 0.000 (hippocampi).
_WINDOWS_OVER = 3


def _sparse_lncc(fixed: Tensor, window: int) -> Similarity:
    return LocalCrossCorrelation(fixed, window, max(1, window // _WINDOWS_OVER))


def _variances(fixed: Tensor, warped: Tensor, weight: Tensor | None, own: Tensor) -> Tensor:
    """Return −E |f − Ef + Ew − w|² − |Ef − Ew|² of independent f and w."""
    share = relative_weight(weight, fixed)
    middles = [channel_mean(x, share) for x in (fixed, warped)]
    spread = [mean((x - m).square(), share) for x, m in zip((fixed, warped), middles, strict=True)]
    return -(spread[0] + spread[1] + mean((middles[0] - middles[1]).square()))


_NMI = partial(MutualInformation, normalised=True)
_MI_PAPERS = ("viola1997alignment", "thevenaz2000optimization")

# The one table of measures, by their names in settings: settings, layers, memory, time and citations all read it, so a
# new measure is a new row.
MEASURES = {
    "ssd": Measure(ssd, MeanSquaredDifference, (60.0, 55.0), 0.7, best=0.0, unrelated=_variances, common_scale=True),
    "ncc": Measure(ncc, CrossCorrelation, (60.0, 55.0), 0.7),
    "lncc": Measure(
        lncc,
        _sparse_lncc,
        (45.0, 40.0),
        1.0,
        ("window",),
        best=1.0,
        weighs_contrast=True,
        references=("avants2008symmetric",),
    ),
    "mi": Measure(mutual_information, MutualInformation, (60.0, 50.0), 1.1, references=_MI_PAPERS),
    "nmi": Measure(
        normalised_mutual_information,
        _NMI,
        (60.0, 50.0),
        1.1,
        unrelated=lambda fixed, warped, weight, own: torch.ones_like(own),
        references=("studholme1999overlap",),
    ),
    "ngf": Measure(
        ngf,
        GradientFields,
        (75.0, 60.0),
        1.0,
        ("grid",),
        unrelated=lambda fixed, warped, weight, own: own / (fixed.dim() - 2),  # the mean of cos² over all directions
        references=("haber2006intensity",),
    ),
    "mind": Measure(
        mind,
        MeanSquaredDifference,
        (140.0, 300.0),
        1.5,
        features=SELF_SIMILARITIES,
        best=0.0,
        unrelated=_variances,
        references=("heinrich2013towards",),
    ),
}


def similarity_weights(similarity: str | Mapping[str, float]) -> dict[str, float]:
    """Return the measures that a setting ``similarity`` names, with their weights.

    Args:
        similarity: a name of `MEASURES`, which has weight 1, or names with their weights. ``auto`` is ``lncc`` for all
            that cannot look at the images first.

    Raises:
        InputError: no name, an unknown one, or a weight that is not positive and finite.
    """
    if not isinstance(similarity, str | Mapping) or not similarity:
        raise InputError(f"similarity must be auto, name one of {', '.join(MEASURES)}, or several with their weights")
    weights = {_USUAL if similarity == AUTO else similarity: 1.0} if isinstance(similarity, str) else dict(similarity)
    for name in weights:
        require_choice(name, (*MEASURES, *([AUTO] if isinstance(similarity, str) else [])), "similarity")
    return weights_of(weights, "similarity")


def weights_of(weights: Mapping[Any, Any], where: str) -> dict[Any, float]:
    """Return weights by what they are of; `InputError`, which names ``where``, unless all are positive and finite."""
    for name, weight in weights.items():
        if isinstance(weight, bool) or not isinstance(weight, Real) or not 0 < float(weight) < math.inf:
            raise InputError(f"{where}: the weight of {name} must be a positive finite number, got {weight!r}")
    return dict(weights)


def measure_name(similarity: str | Mapping[str, float]) -> str:
    """Return the names of the measures that a setting ``similarity`` names, as one text: ``lncc + mi``."""
    return " + ".join(similarity_weights(similarity))


def measures_in(similarity: str | Mapping[str, float]) -> dict[str, Measure]:
    """Return the rows of the measures that a setting ``similarity`` names; `InputError` as `similarity_weights`."""
    return {name: MEASURES[name] for name in similarity_weights(similarity)}


def needs_common_scale(similarity: str | Mapping[str, float]) -> bool:
    """Return whether a measure compares intensities as they are, so that both images need one scale."""
    return any(measure.common_scale for measure in measures_in(similarity).values())


class Combination(Similarity):
    """S = Σ w_k S_k / Σ w_k, each S_k being a similarity of some of the channels.

    Args:
        parts: w_k, the channels that S_k compares, and S_k.
    """

    def __init__(self, parts: list[tuple[float, slice, Similarity]]) -> None:
        total = sum(weight for weight, _, _ in parts)
        self.parts = [(weight / total, channels, part) for weight, channels, part in parts]

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        values, slope = [], torch.zeros_like(warped)
        for weight, channels, part in self.parts:
            compared = warped[:, channels]
            value, derivative = part.evaluate(compared, mask)
            values.append(weight * value)
            slope[:, channels] += derivative * (weight * warped.shape[1] / compared.shape[1])
        return torch.stack(values).sum(0), slope


def features(similarity: str | Mapping[str, float], image: Tensor) -> Tensor:
    """Return what is warped and compared: the image, its MIND-SSC channels, or the one after the other.

    Args:
        similarity: a name, or names with weights.
        image: ``(B, C, *S)``, scaled to about [0, 1].

    Returns:
        ``(B, C', *S)``: C' is C without ``mind``, C·K with nothing else, C + C·K with both; K = 12 in 3D and 4 in 2D.

    Raises:
        InputError: as `similarity_weights`, `mind_ssc`.
    """
    parts = [kind.of(image) for kind in _kinds(similarity)]
    return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)


def make_similarity(
    similarity: str | Mapping[str, float], fixed: Tensor, window: int = 9, *, grid: Grid | None = None
) -> Similarity:
    """Return the similarity of that name, or of those names and weights, to ``fixed``.

    Args:
        similarity: a name, or names with weights.
        fixed: ``(B, C', *S)``, the `features` of the fixed image.
        window: width of the LNCC window in voxels.
        grid: their grid, whose spacing the gradients of ``ngf`` need; spacing 1 when None.

    Returns:
        A `Similarity` whose ``evaluate`` takes the warped features of the moving image.

    Raises:
        InputError: as `similarity_weights`.
    """
    grid = grid or Grid(tuple(fixed.shape[2:]))
    channels, parts = _channels(similarity, fixed.shape[1], grid.dim), []
    for name, weight in similarity_weights(similarity).items():
        measure = MEASURES[name]
        compared = channels[measure.features]
        part = measure.closed_form(fixed[:, compared], **measure.choose(window=window, grid=grid))
        parts.append((weight, compared, part))
    return parts[0][2] if len(parts) == 1 else Combination(parts)


def _kinds(similarity: str | Mapping[str, float]) -> list[Features]:
    """Return the kinds of features in the order of their channels: intensities come first."""
    kinds = dict.fromkeys(measure.features for measure in measures_in(similarity).values())
    return sorted(kinds, key=lambda kind: kind is not INTENSITIES)


def _channels(similarity: str | Mapping[str, float], total: int, dim: int) -> dict[Features, slice]:
    """Return which of all channels each kind of features has."""
    kinds = _kinds(similarity)
    ends = [0, *accumulate(kind.count(dim) for kind in kinds)]
    size = total // ends[-1]
    return {kind: slice(size * a, size * b) for kind, (a, b) in zip(kinds, pairwise(ends), strict=True)}


def mark(
    similarity: str | Mapping[str, float],
    fixed: Tensor,
    warped: Tensor,
    *,
    mask: Tensor | None = None,
    window: int = 9,
    grid: Grid | None = None,
) -> Tensor:
    """Return (S − N) / (S of fixed with itself − N), N being S of unrelated images: 1 at best, about 0 for noise.

    Args:
        similarity: a name, or names with weights.
        fixed: ``(B, C, *S)``, scaled to about [0, 1].
        warped: the same shape, likewise.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.
        window: width of the LNCC window in voxels, and of those in which the contrast of the fixed image is measured.
        grid: their grid; spacing 1 when None.

    Returns:
        ``(B,)``: S is averaged over what has contrast in the fixed image; several measures by their weights. N is 0 for
        ``lncc``, ``ncc`` and ``mi``, 1 for ``nmi``, 1/D of the image with itself for ``ngf``. For ``ssd`` and ``mind``
        it is minus the sum of both variances and of the squared difference of the means, which makes it the
        concordance correlation of Lin, "A concordance correlation coefficient to evaluate reproducibility", 1989.
    """
    grid, total = grid or Grid(tuple(fixed.shape[2:])), fixed.new_zeros(len(fixed))
    seen = None
    for name, share in similarity_weights(similarity).items():
        measure = MEASURES[name]
        if not measure.weighs_contrast and seen is None:
            seen = weighted(local_contrast(fixed, window), mask)
        weight = mask if measure.weighs_contrast else seen
        f, w = (measure.features.of(image) for image in (fixed, warped))
        made = measure.closed_form(f, **measure.choose(window=window, grid=grid))
        value = made.evaluate(w, weight)[0]
        own = made.evaluate(f, weight)[0] if measure.best is None else torch.full_like(value, measure.best)
        unrelated = measure.unrelated(f, w, weight, own)
        total += share * (value - unrelated) / (own - unrelated).clamp(min=torch.finfo(own.dtype).tiny)
    return total / sum(similarity_weights(similarity).values())
