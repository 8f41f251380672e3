"""Settings of a registration, nested by subject: typed, frozen, checked when made."""

import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torchdeform.core.flow import OdeSolver
from torchdeform.core.image import AUTO
from torchdeform.errors import RANGES, InputError, require_choice, require_ranges, shown
from torchdeform.fem.solver import SolverSettings
from torchdeform.metrics.similarity import MEASURES, measure_name, similarity_weights, weights_of
from torchdeform.registration.affine.settings import AlignmentSettings

OFF = "off"
STARTS = (AUTO, "identity", "discrete", "keypoints")

# Features that need no program: the images themselves, self-similarities, and channels that come in files.
INTENSITIES, MIND, FILES = "intensities", "mind", "files"

# What the kinds of tissue cost, beside div 0.5, curl 1 and strain 0 of what is not named.
TISSUES: dict[str, dict[str, float]] = {
    "free": {},
    "stiff": {"div": 20.0, "strain": 20.0},
    "rigid": {"div": 100.0, "strain": 100.0},
    "incompressible": {"div": 100.0},
}
PRICES = ("div", "strain", "curl")
_MOST_POINTS = 5000  # of which each is compared with every other
STENCILS = ("auto", "convolution", "shifts")


@dataclass(frozen=True, kw_only=True)
class SimilaritySettings:
    """What is compared, and how.

    Args:
        measure: ``auto`` looks at two `Image`s and takes ``lncc`` where they have one contrast and ``mind`` where they
            do not, with ``ngf`` beside it the less noise there is (always ``lncc`` for tensors, whose batches may
            differ). For images of one contrast: ``lncc`` (squared local normalised cross-correlation, whatever the
            brightness), ``ncc`` (the correlation of whole images), ``ssd`` (mean squared difference, for images on the
            same intensity scale). For images of different contrast: ``mind`` (self-similarity of patches), ``mi`` and
            ``nmi`` (mutual information, normalised), ``ngf`` (directions of the gradients). Or several of them with
            positive weights, as ``{lncc: 1, mi: 0.5}``.
        window: width of the LNCC window in voxels, odd.

    Raises:
        InputError: a value out of range, named.
    """

    measure: str | Mapping[str, float] = AUTO
    window: int = 9

    def __post_init__(self) -> None:
        similarity_weights(self.measure)
        if not isinstance(self.measure, str):  # a copy of our own, and a dict, which `asdict` can take
            object.__setattr__(self, "measure", dict(self.measure))
        require_ranges(self, "similarity.", window="window")


@dataclass(frozen=True, kw_only=True)
class MetricSettings:
    """What a velocity costs, and how smooth the map is: ∫ w_div (div v)² + w_curl |curl v|² + w_zero |v|².

    Args:
        weight_div: price w_div of a change of volume; large keeps volumes.
        weight_curl: price w_curl of a rotation.
        length_scale: √(w_div / w_zero) in voxels of each level's map, beyond which a velocity decays; longer makes it
            smoother. One number, or one for each level, coarse to fine: the last is for the finest, the first for all
            not named.
        order: 1, or 2 for a smoother velocity (K M⁻¹ K in place of K).
        elasticity: smoothing of the map in each step, 0 none, 1 full: the share of the way to the mean of its
            neighbours that every node is moved. ``auto``: from 0.1 for images without noise to 0.4 for noisy ones.

    Raises:
        InputError: a value out of range, named.
    """

    weight_div: float = 0.5
    weight_curl: float = 1.0
    length_scale: float | tuple[float, ...] = (8.0, 5.0, 2.5)
    order: int = 1
    elasticity: float | str = AUTO

    def __post_init__(self) -> None:
        require_choice(self.order, (1, 2), "metric.order")
        lengths = (RANGES["positive"][0], f"{RANGES['positive'][1]}, one number or one for each level")
        require_ranges(self, "metric.", length_scale=lengths, weight_div="positive", weight_curl="positive")
        if isinstance(self.elasticity, str):
            require_choice(self.elasticity, (AUTO,), "metric.elasticity, if it is no number,")
        else:
            require_ranges(self, "metric.", elasticity="0 to 1")

    @property
    def _lengths(self) -> tuple[float, ...]:
        return (self.length_scale,) if isinstance(self.length_scale, int | float) else tuple(self.length_scale)

    def length_at(self, below: int) -> float:
        """Return the length scale for a level that has so many finer ones below it."""
        return self._lengths[max(len(self._lengths) - 1 - below, 0)]


@dataclass(frozen=True, kw_only=True)
class OptimiserSettings:
    """How far and how often the maps move.

    Args:
        steps: steps at most on each pyramid level, coarse to fine; its length is the number of levels (a level that
            would leave fewer than 16 nodes on every axis is dropped).
        step_length: longest move in one step, in voxels of the level's images; falls linearly to a tenth of this over a
            level, and to 0.85 of itself with every step after which the images are no more similar than before.
        limit: moves longer than this many typical ones, √(Σ|v|⁴ / Σ|v|²), are cut to that, which is then the longest
            move; ``null``: none is cut. Not where tissue is given, as what is rigid turns as a whole.
        evenness: the force at a node is divided by its strength around it and this share of the typical strength: the
            smaller, the farther what is weak moves beside what is strong; ``null``, and where tissue is given: the
            force is taken as it is.
        momentum: at least 0 and below 1; the direction of a step is Σ_k momentumᵏ v_k of the velocities so far, the
            newest being v_0. What they agree on is reached sooner, what they take back from each other cancels.
        tolerance: a level stops when 5 steps raised the best similarity by less than this share of its rise so far.
        map_spacing: spacing of the grid that carries the map on the finest level, in voxels of the images, where these
            have more than 2^17; else, and on other levels, every voxel carries it.

    Raises:
        InputError: a value out of range, named.
    """

    steps: tuple[int, ...] = (40, 40, 16)
    step_length: float = 0.8
    limit: float | None = 1.5
    evenness: float | None = 0.1
    momentum: float = 0.5
    tolerance: float = 0.03
    map_spacing: float = 2.0

    def __post_init__(self) -> None:
        require_ranges(
            self,
            "optimiser.",
            steps=(RANGES["not negative"][0], "hold one number per level, none negative"),
            step_length="positive",
            momentum="below 1",
            tolerance="finite, not negative",
            map_spacing=(lambda spacing: 1 <= spacing <= 8, "lie between 1 and 8 voxels"),
            **{name: "positive" for name in ("limit", "evenness") if getattr(self, name) is not None},
        )


@dataclass(frozen=True, kw_only=True)
class FoldSettings:
    """How folds are kept away.

    Args:
        soft_determinant: where a one-sided determinant J is smaller than this, a divergence proportional to
            soft_determinant/J − 1 is asked for, which opens the grid up again; 0 switches it off.
        min_determinant: smallest one-sided determinant that a step may leave; a step that would go below is shortened.

    Raises:
        InputError: a value out of range, named.
    """

    soft_determinant: float = 0.15
    min_determinant: float = 0.03

    def __post_init__(self) -> None:
        require_ranges(self, "folds.", soft_determinant="finite, not negative", min_determinant="inside 0 to 1")


def _require_search(settings: "DiscreteSettings | KeypointSettings", group: str) -> None:
    """Raise `InputError`, which names the group, where levels, reach, coupling or the determinant are out of range."""
    levels, reach = settings.levels, settings.reach
    if not levels or len(levels) != len(reach):
        raise InputError(f"{group}levels and {group}reach must have one entry each per level, got {levels}, {reach}")
    if min(levels) < 0 or list(levels) != sorted(levels, reverse=True):
        raise InputError(f"{group}levels must not be negative and run from coarse to fine, got {levels}")
    if not settings.coupling:
        raise InputError(f"{group}coupling must have at least one price")
    require_ranges(settings, group, reach="positive", coupling="positive", min_determinant="inside 0 to 1")


@dataclass(frozen=True, kw_only=True)
class DiscreteSettings:
    """How far and how finely `discrete_start` searches, and how smooth its result is.

    Args:
        levels: pyramid levels to search on, coarse to fine, 0 being the images' own: displacements on level l are
            multiples of 2^l voxels.
        reach: longest displacement along an axis tried on each of them, in voxels of the images. A later level
            corrects the ones before.
        spacing: distance of the control points in displacements of one step, at least 1.
        smoothing: standard deviation of the Gaussian that the field is smoothed with, in control points.
        coupling: prices of a squared step between a control point and the smooth field, in standard deviations of the
            matching cost; they rise from the first round to the last, and with them the agreement of neighbours.
        symmetric: match moving to fixed as well, and keep what both directions agree on; takes twice as long.
        length_scale: range of the metric in which the flow is fitted to the matches, in control points.
        min_determinant: smallest one-sided determinant of the result.

    Raises:
        InputError: a value out of range, named.
    """

    levels: tuple[int, ...] = (2, 1)
    reach: tuple[float, ...] = (20.0, 6.0)
    spacing: float = 2.0
    smoothing: float = 1.5
    coupling: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
    symmetric: bool = True
    length_scale: float = 2.0
    min_determinant: float = 0.1

    def __post_init__(self) -> None:
        _require_search(self, "discrete.")
        require_ranges(self, "discrete.", spacing="at least 1", smoothing="positive", length_scale="positive")


@dataclass(frozen=True, kw_only=True)
class KeypointSettings:
    """How many points `keypoint_start` looks for, how far, and how smooth the map between them is.

    Args:
        count: corners of the fixed image at most, at least 8; the strongest are taken.
        levels: pyramid levels to search on, coarse to fine, 0 being the images' own, as `DiscreteSettings`.
        reach: longest displacement along an axis tried on each of them, in voxels of the images, and at most a third of
            that axis. A later level corrects the ones before.
        neighbours: with how many of the nearest points each has to agree.
        coupling: prices of a squared step between a point and its neighbours, in standard deviations of the matching
            cost; they rise from the first round to the last.
        agreement: how many voxels a point may be away from where the way back from its match leads, its motion from
            that of its neighbours, and its match from the map.
        length_scale: range of the metric in which the map is fitted, in distances to these neighbours.
        min_determinant: smallest one-sided determinant of the map.

    Raises:
        InputError: a value out of range, named.
    """

    count: int = 2000
    levels: tuple[int, ...] = (2, 1)
    reach: tuple[float, ...] = (40.0, 6.0)
    neighbours: int = 4
    coupling: tuple[float, ...] = (0.003, 0.01, 0.03, 0.1, 0.3)
    agreement: float = 4.0
    length_scale: float = 4.0
    min_determinant: float = 0.1

    def __post_init__(self) -> None:
        _require_search(self, "keypoints.")
        most = (lambda n: isinstance(n, int) and 8 <= n <= _MOST_POINTS, f"be a whole number from 8 to {_MOST_POINTS}")
        few = (lambda n: isinstance(n, int) and 1 <= n <= 64, "be a whole number from 1 to 64")
        require_ranges(self, "keypoints.", count=most, neighbours=few, agreement="positive", length_scale="positive")


Tissue = str | Mapping[str, float]


def require_tissue(label: int, tissue: Tissue) -> None:
    """Raise `InputError` unless ``tissue`` is a kind of tissue, or prices of one."""
    where = f"tissues: label {label}"
    if not isinstance(tissue, Mapping):
        require_choice(tissue, TISSUES, where)
        return
    for name, price in tissue.items():
        require_choice(name, PRICES, where)
        if isinstance(price, bool) or not 0 <= price < math.inf or (name == "div" and price == 0):
            wanted = "positive" if name == "div" else "at least 0"
            raise InputError(f"{where}: {name} must be finite and {wanted}, got {price}")
    if tissue.get("curl") == 0 and not tissue.get("strain"):
        raise InputError(f"{where}: curl and strain must not both be 0, or it may take any shape")


_ALIGN, _DISCRETE, _KEYPOINTS = AlignmentSettings(), DiscreteSettings(), KeypointSettings()
_SIMILARITY, _METRIC = SimilaritySettings(), MetricSettings()
_SOLVER, _FLOW = SolverSettings(), OdeSolver(method="midpoint", steps=1)
_OPTIMISER, _FOLDS = OptimiserSettings(), FoldSettings()

# A group that is given as one value gives this field of it: ``solver: cg`` is ``solver: {method: cg}``.
SHORT_FORMS = {"align": "kind", "similarity": "measure", "solver": "method", "flow": "method"}
_SHORT_DEFAULTS = {"align": _ALIGN, "similarity": _SIMILARITY, "solver": _SOLVER, "flow": _FLOW}


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """Everything that can be chosen; the defaults are the preset ``default``.

    Args:
        align: how images (not tensors) are aligned first; as one value its ``kind``: ``none``, ``translation``,
            ``rigid``, ``similarity`` or ``affine``.
        start: map to begin with: ``identity``, ``discrete`` for one from a search over large displacements, see
            `discrete_start`, ``keypoints`` for one from points that look alike however far they are apart, see
            `keypoint_start`, or ``auto``: discrete where ``mind`` is compared.
        discrete: settings of the first search.
        keypoints: settings of the second.
        similarity: what is compared; as one value its ``measure``.
        metric: what a velocity costs.
        solver: how the least squares for the velocity are solved; as one value its ``method``: ``auto``,
            ``transform``, ``cg`` or ``assembled``.
        flow: how the velocity is integrated; as one value its ``method``.
        optimiser: steps and when to stop.
        folds: how folds are kept away.
        stencil: how differences of images are computed: ``convolution``, ``shifts`` (sums of shifted images), or
            ``auto``, whichever is faster; the values are the same.
        points_weight: what landmarks weigh against the similarity: the mean of |φ(p) − q|² over the pairs, in squared
            units of spacing (mm² for images), is multiplied by this and taken off; 0 only measures them.
        features: what takes the place of the intensities where images are compared, made once at full size: ``mind``; a
            file of a TorchScript or ``torch.export`` program, or anything that can be called, which gets the image,
            scaled to about [0, 1], as ``(1, C, *S)`` and returns ``(1, K, *S)``; or ``files``, the features of the
            `Annotations`, which need not be said. Or several with their weights, as ``{intensities: 1, net.ts: 0.5}``,
            of which the first has weight 1. Features alone are compared as ``similarity`` says, ``auto`` being ``ssd``
            of unit vectors; beside ``intensities`` they are compared so, and ``similarity`` is of these.
        labels_weight: what the labels of both images weigh against the similarity: the squared difference of their
            smooth probabilities, −1 where none overlaps and 0 where all do, is added with this weight; 0 only measures
            them.
        symmetric: prefer neither image: both are warped into a space between, so that swapping them inverts the map.
        outside: value of ``warped`` where an image (not a tensor) does not reach: a number, or ``auto`` for what
            surrounds it, the grey value of its border if that is nearly constant, else its minimum.
        absent: ``auto`` lets the similarity go of what only one image shows (resected, torn off, cut off); ``off``
            compares everything.
        tissues: what the labels of ``Annotations.tissue`` stand for, by number: ``rigid`` (turns and moves, keeps its
            shape), ``stiff`` (bends little), ``incompressible`` (keeps its volume, takes any shape), ``free``, or
            prices of its own, such as ``{div: 100, strain: 10, curl: 0}``, in units of `MetricSettings`; what is left
            out costs what it costs elsewhere. Labels that are not named are free.
        sliding: labels whose border glides along what is around them.

    Raises:
        InputError: a value out of range, named.
    """

    align: AlignmentSettings = _ALIGN
    start: str = AUTO
    discrete: DiscreteSettings = _DISCRETE
    keypoints: KeypointSettings = _KEYPOINTS
    similarity: SimilaritySettings = _SIMILARITY
    metric: MetricSettings = _METRIC
    solver: SolverSettings = _SOLVER
    flow: OdeSolver = _FLOW
    optimiser: OptimiserSettings = _OPTIMISER
    folds: FoldSettings = _FOLDS
    stencil: str = "auto"
    points_weight: float = 0.0
    features: Any = None
    labels_weight: float = 0.0
    symmetric: bool = False
    outside: float | str = AUTO
    absent: str | bool = AUTO
    tissues: Mapping[int, Tissue] = field(default_factory=dict)
    sliding: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "tissues", dict(self.tissues))
        for label, tissue in self.tissues.items():
            require_tissue(label, tissue)
        for name in ("tissues", "sliding"):
            if any(label <= 0 for label in getattr(self, name)):
                raise InputError(f"{name}: labels are whole numbers from 1, as 0 is what has none")
        for name, key in SHORT_FORMS.items():
            value = getattr(self, name)
            if isinstance(value, str | Mapping):
                object.__setattr__(self, name, replace(_SHORT_DEFAULTS[name], **{key: value}))
        require_choice(self.start, STARTS, "start")
        if isinstance(self.absent, bool):  # which YAML makes of a plain off
            object.__setattr__(self, "absent", AUTO if self.absent else OFF)
        require_choice(self.absent, (AUTO, OFF), "absent")
        require_choice(self.stencil, STENCILS, "stencil")
        if isinstance(self.outside, str):
            require_choice(self.outside, (AUTO,), "outside, if it is no number,")
        else:
            require_ranges(self, "", outside=(math.isfinite, "be finite"))
        require_ranges(self, "", points_weight="finite, not negative", labels_weight="finite, not negative")
        self._check_features()

    def _check_features(self) -> None:
        if isinstance(self.features, Mapping):
            object.__setattr__(self, "features", dict(self.features))
        given = self.features if isinstance(self.features, Mapping) else [self.features]
        for name in [] if self.features is None else given:
            if not isinstance(name, Hashable) or not (callable(name) or (isinstance(name, str | Path) and str(name))):
                raise InputError(
                    f"features must be {MIND}, a file of a program, or several with their weights as "
                    f"{{{MIND}: 1, net.ts: 0.5}}, got {shown(name)}"
                )
        if self.sources and self.sources.keys() <= {INTENSITIES}:
            raise InputError("features: intensities alone are what is compared without it; leave it out, or add others")
        asked = similarity_weights(self.similarity.measure)
        if self.only_features and any(MEASURES[name].compares_features for name in asked):
            raise InputError(
                "similarity: mind makes features of its own; compare others by ssd, lncc or ncc, or say features: mind"
            )

    @property
    def sources(self) -> dict[str | Path | Callable[..., Any], float]:
        """The features that are asked for, with their weights."""
        if self.features is None:
            return {}
        return weights_of(self.features if isinstance(self.features, Mapping) else {self.features: 1.0}, "features")

    @property
    def programs(self) -> tuple[str | Path, ...]:
        """The files of programs that make features."""
        return tuple(s for s in self.sources if isinstance(s, str | Path) and s not in (INTENSITIES, MIND, FILES))

    def with_programs(self, place: Callable[[str], Path]) -> "RegistrationSettings":
        """Return the same with files of programs where ``place`` says that they are."""
        there: dict[Any, str] = {name: str(place(str(name))) for name in self.programs}
        several = isinstance(self.features, Mapping)
        weights = {there.get(source, source): weight for source, weight in self.sources.items()}
        return replace(self, features=weights if several else next(iter(weights))) if there else self

    @property
    def only_features(self) -> bool:
        """Whether features take the place of the intensities."""
        return bool(self.sources) and INTENSITIES not in self.sources

    @property
    def seen_by(self) -> str | Mapping[str, float]:
        """The measure of the intensities, also where features take their place: what alignments and marks go by."""
        return "lncc" if self.only_features else self.similarity.measure

    @property
    def maximised(self) -> str:
        """What is maximised, as one text: ``lncc + labels``."""
        others = " of features" if self.only_features else " + features" if self.sources else ""
        return f"{measure_name(self.similarity.measure)}{others}{' + labels' if self.labels_weight > 0 else ''}"

    @property
    def knows_tissue(self) -> bool:
        """Whether anything is said about tissue."""
        return bool(self.tissues or self.sliding)

    @property
    def decided_start(self) -> str:
        """The map to begin with, which ``auto`` leaves to the measure."""
        if self.start != AUTO:
            return self.start
        return "discrete" if MIND in similarity_weights(self.similarity.measure) else "identity"

    def decided(self, measure: str | Mapping[str, float] = "lncc") -> "RegistrationSettings":
        """Return the same with this measure in place of ``auto``, and with the start that goes with it."""
        measure = "ssd" if self.only_features else measure
        similarity = self.similarity
        similarity = replace(similarity, measure=measure) if similarity.measure == AUTO else similarity
        chosen = replace(self, similarity=similarity)
        return replace(chosen, start=chosen.decided_start)
