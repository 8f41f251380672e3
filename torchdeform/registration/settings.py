"""Settings of a registration: typed, frozen, checked when made."""

import math
from dataclasses import dataclass
from typing import Literal

from torchdeform.errors import InputError, require_choice

SIMILARITIES = ("lncc", "ssd")


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """Everything that can be chosen; the defaults are the preset ``default``.

    Args:
        similarity: ``lncc`` (squared local normalised cross-correlation, for images of one contrast with different
            brightness) or ``ssd`` (mean squared difference, for images on the same intensity scale).
        window: width of the LNCC window in voxels, odd.
        weight_div: price w_d of a change of volume in the metric; large keeps volumes.
        weight_curl: price w_c of a rotation.
        length: range √(w_d / w_0) of the metric in voxels of each level; longer makes the velocity smoother.
        power: 1, or 2 for a smoother velocity, see `TransformSolver.solve`.
        steps: steps at most on each pyramid level, coarse to fine; its length is the number of levels (a level that
            would leave fewer than 8 nodes on every axis is dropped).
        step_length: longest move in one step, in voxels; falls linearly to a tenth of this over a level.
        tolerance: a level stops when 10 steps raised the best similarity by less than this share of its rise so far.
        soft_determinant: where a one-sided determinant J is smaller than this, a divergence proportional to
            soft_determinant/J − 1 is asked for, which opens the grid up again; 0 switches it off.
        min_determinant: smallest one-sided determinant that a step may leave; a step that would go below is shortened.

    Raises:
        InputError: a value out of range, named.
    """

    similarity: Literal["lncc", "ssd"] = "lncc"
    window: int = 9
    weight_div: float = 1.0
    weight_curl: float = 1.0
    length: float = 12.0
    power: int = 1
    steps: tuple[int, ...] = (100, 100, 30)
    step_length: float = 0.5
    tolerance: float = 0.02
    soft_determinant: float = 0.15
    min_determinant: float = 0.03

    def __post_init__(self) -> None:
        require_choice(self.similarity, SIMILARITIES, "similarity")
        if self.window < 3 or self.window % 2 == 0:
            raise InputError(f"window must be an odd number of voxels, at least 3, got {self.window}")
        if not self.steps or min(self.steps) < 0:
            raise InputError(f"steps must hold one number per level, none negative, got {self.steps}")
        if self.power not in (1, 2):
            raise InputError(f"power must be 1 or 2, got {self.power}")
        if not 0 < self.min_determinant < 1:
            raise InputError(f"min_determinant must lie between 0 and 1, got {self.min_determinant}")
        for name in ("weight_div", "weight_curl", "length", "step_length"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name} must be positive and finite, got {getattr(self, name)}")
        for name in ("soft_determinant", "tolerance"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name} must be finite and not negative, got {getattr(self, name)}")
