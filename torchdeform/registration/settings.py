"""Settings of a registration: typed, frozen, checked when made."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from torchdeform.errors import InputError, require_choice
from torchdeform.metrics.similarity import similarity_weights
from torchdeform.registration.affine.settings import ALIGNMENTS

STARTS = ("identity", "discrete")


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """Everything that can be chosen; the defaults are the preset ``default``.

    Args:
        align: how images (not tensors) are aligned first: ``none``, ``translation``, ``rigid``, ``similarity`` or
            ``affine``, see `align`.
        start: map to begin with: ``identity``, or ``discrete`` for one from a search over large displacements, see
            `discrete_start`.
        similarity: ``lncc`` (squared local normalised cross-correlation, for images of one contrast with different
            brightness), ``ncc`` (the correlation of whole images), ``ssd`` (mean squared difference, for images on the
            same intensity scale); for images of different contrast ``mi`` and ``nmi`` (mutual information, normalised),
            ``ngf`` (directions of the gradients), ``mind`` (self-similarity of patches). Or several of them with
            positive weights, as ``{lncc: 1, mi: 0.5}``.
        window: width of the LNCC window in voxels, odd.
        weight_div: price w_d of a change of volume in the metric; large keeps volumes.
        weight_curl: price w_c of a rotation.
        length: range √(w_d / w_0) of the metric in voxels of each level's map; longer makes the velocity smoother. One
            number, or one for each level, coarse to fine: the last is for the finest, the first for all not named.
        elasticity: share of the way to the mean of its neighbours, 0 to 1, that the displacement of every node of the
            map is taken in every step: `length` smooths each step, this the whole; larger is smoother.
        power: 1, or 2 for a smoother velocity, see `TransformSolver.solve`.
        steps: steps at most on each pyramid level, coarse to fine; its length is the number of levels (a level that
            would leave fewer than 16 nodes on every axis is dropped).
        step_length: longest move in one step, in voxels of the map; falls linearly to a tenth of this over a level.
        momentum: at least 0 and below 1; the direction of a step is Σ_k momentumᵏ v_k of the velocities so far, the
            newest being v_0. What they agree on is reached sooner, what they take back from each other cancels.
        tolerance: a level stops when 5 steps raised the best similarity by less than this share of its rise so far.
        map_spacing: spacing of the grid that carries the map, in voxels of the level's images, on levels of more than
            2^17 voxels, which take map_spacing² times fewer steps; smaller ones carry it at every voxel.
        soft_determinant: where a one-sided determinant J is smaller than this, a divergence proportional to
            soft_determinant/J − 1 is asked for, which opens the grid up again; 0 switches it off.
        min_determinant: smallest one-sided determinant that a step may leave; a step that would go below is shortened.
        points_weight: what landmarks weigh against the similarity: the mean of |φ(p) − q|² over the pairs, in squared
            units of spacing (mm² for images), is multiplied by this and taken off; 0 only measures them.
        symmetric: prefer neither image: both are warped into a space between, so that swapping them inverts the map.

    Raises:
        InputError: a value out of range, named.
    """

    align: str = "affine"
    start: str = "identity"
    similarity: str | Mapping[str, float] = "lncc"
    window: int = 9
    weight_div: float = 0.5
    weight_curl: float = 1.0
    length: float | tuple[float, ...] = (8.0, 5.0, 2.5)
    elasticity: float = 0.2
    power: int = 1
    steps: tuple[int, ...] = (40, 30, 24)
    step_length: float = 1.0
    momentum: float = 0.5
    tolerance: float = 0.03
    map_spacing: float = 2.0
    soft_determinant: float = 0.15
    min_determinant: float = 0.03
    points_weight: float = 0.0
    symmetric: bool = False

    def __post_init__(self) -> None:
        require_choice(self.align, ALIGNMENTS, "align")
        require_choice(self.start, STARTS, "start")
        similarity_weights(self.similarity)
        if not isinstance(self.similarity, str):  # a copy of our own, and a dict, which `asdict` can take
            object.__setattr__(self, "similarity", dict(self.similarity))
        if self.window < 3 or self.window % 2 == 0:
            raise InputError(f"window must be an odd number of voxels, at least 3, got {self.window}")
        if not self.steps or min(self.steps) < 0:
            raise InputError(f"steps must hold one number per level, none negative, got {self.steps}")
        if self.power not in (1, 2):
            raise InputError(f"power must be 1 or 2, got {self.power}")
        if not 0 < self.min_determinant < 1:
            raise InputError(f"min_determinant must lie between 0 and 1, got {self.min_determinant}")
        if not self._lengths or not all(0 < length < math.inf for length in self._lengths):
            raise InputError(f"length must be positive and finite, one number or one for each level, got {self.length}")
        for name in ("weight_div", "weight_curl", "step_length"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not 0 <= self.elasticity <= 1:
            raise InputError(f"elasticity must lie between 0 and 1, got {self.elasticity}")
        if not 0 <= self.momentum < 1:
            raise InputError(f"momentum must be at least 0 and below 1, got {self.momentum}")
        if not 1 <= self.map_spacing <= 8:
            raise InputError(f"map_spacing must lie between 1 and 8 voxels, got {self.map_spacing}")
        for name in ("soft_determinant", "tolerance", "points_weight"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name} must be finite and not negative, got {getattr(self, name)}")

    @property
    def _lengths(self) -> tuple[float, ...]:
        return (self.length,) if isinstance(self.length, int | float) else tuple(self.length)

    def length_at(self, below: int) -> float:
        """Return the length for a level that has so many finer ones below it."""
        return self._lengths[max(len(self._lengths) - 1 - below, 0)]
