"""What a solver returns: the value, and how it went, per batch item. Failure is a value."""

from dataclasses import dataclass
from enum import Enum

from torch import Tensor


class Status(Enum):
    """How a solve ended; the value is a sentence that names the remedy."""

    CONVERGED = "converged"
    MAX_STEPS = "stopped at max_steps before the tolerance was met: raise max_steps or rtol, or precondition better"
    BREAKDOWN = "the operator is not positive definite on this right-hand side: check weights and boundary conditions"
    NON_FINITE = "the right-hand side or the operator is not finite: check the input for NaN and infinity"
    STAGNATED = "no step brings the residual down any more: inconsistent data? the value is the least-squares answer"
    ROUNDING = "rounding keeps the residual above the tolerance: use float64, or raise rtol"

    @property
    def ok(self) -> bool:
        """True when the tolerance was met."""
        return self is Status.CONVERGED


@dataclass(frozen=True)
class Solution:
    """A solve's outcome.

    Attributes:
        value: the answer ``(B, ...)``.
        status: one `Status` per batch item.
        steps: iterations per item ``(B,)``, 0 for a direct solve.
        residual: ‖b − A x‖ / ‖b‖ per item ``(B,)`` of the true residual; 0 where b = 0.
    """

    value: Tensor
    status: tuple[Status, ...]
    steps: Tensor
    residual: Tensor

    @property
    def ok(self) -> bool:
        """True when every item converged."""
        return all(s.ok for s in self.status)
