"""What a linear solver is: it is made ready for a system once, then answers loads; failure is a value."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd import Function


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


class Box:
    """What a `Function` has to say besides its result; of lists and tuples `torch.func` would hand on copies."""

    content: Any = None


class _Listed(Function):
    """Whole numbers as a list; of items that `torch.func.vmap` runs over the largest."""

    @staticmethod
    def forward(codes: Tensor, found: Box) -> Tensor:
        found.content = codes.tolist()
        return codes.clone()

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        pass

    @staticmethod
    def vmap(info, in_dims, codes: Tensor, found: Box):
        return _Listed.apply(codes.amax(in_dims[0]), found), None


@torch.no_grad()
def listed(codes: Tensor) -> list[int]:
    """Return whole numbers ``(B,)`` as a list; where `torch.func.vmap` hides many of each, the largest of them."""
    found = Box()
    _Listed.apply(codes, found)
    return found.content


class System(Protocol):
    """A self-adjoint, positive definite K(θ) on fields ``(B, C, *S)`` whose given unknowns are zero."""

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The tensors θ that K is made of."""
        ...

    def apply(self, v: Tensor, *parameters: Tensor) -> Tensor:
        """Return K(θ) v, without a matrix; with its own θ where none are given."""
        ...

    def free(self, load: Tensor) -> Tensor:
        """Return the load with zeros at given unknowns."""
        ...

    def mass(self, v: Tensor) -> Tensor:
        """Return M v, M being the mass matrix on the free unknowns."""
        ...

    def diagonal(self, like: Tensor) -> Tensor:
        """Return the diagonal of K, anything positive at given unknowns, with the type and device of ``like``."""
        ...

    def matrix(self, device: object = "cpu") -> Tensor:
        """Return K as a coalesced ``torch.sparse_coo_tensor`` of float64, the identity at given unknowns."""
        ...


class Factor(ABC):
    """A solver made ready for one system.

    Attributes:
        system: that system.
    """

    system: Any

    @abstractmethod
    def solution(self, load: Tensor, start: Tensor | None = None) -> Solution:
        """Return v with K v = load, and how the solve went.

        Args:
            load: right-hand side ``(B, C, *S)``; what it says about given unknowns is left out.
            start: a v that is near ``(B, C, *S)``, for solvers that go on from one; direct ones have no use for it.
        """

    @abstractmethod
    def __call__(self, load: Tensor, *, power: int = 1) -> Tensor:
        """Return v = (K⁻¹ M)^(power − 1) K⁻¹ load: each further power smooths v once more.

        Args:
            load: as for `solution`.
            power: 1 solves K v = load.
        """


class LinearSolver(Protocol):
    """A way to solve K v = load. One that knows more of its systems than `System` says names their type."""

    def init(self, system: Any, like: Tensor) -> Factor:
        """Return the solver made ready for a system, for loads with the type and device of ``like``."""
        ...
