"""Which solver a div-curl system gets; no other place of the package makes one."""

from dataclasses import dataclass

from torchdeform.errors import InputError, require_choice, require_ranges
from torchdeform.fem.fast_transform import FastTransform, is_exact_for
from torchdeform.fem.stress import StressGuess, suits
from torchdeform.fem.system import DivCurlSystem
from torchdeform.solvers.base import LinearSolver
from torchdeform.solvers.cg import ConjugateGradient, jacobi

# A matrix of more entries (see `DivCurlSystem.matrix_entries`) is not assembled: that would take more than 6 GB.
LARGEST_MATRIX = 2**26

# Up to so many the matrix is soon assembled, and faster than products without it.
SMALL_MATRIX = 2**23

METHODS = ("auto", "transform", "stress", "cg", "assembled")
PRECONDITIONERS = {"transform": FastTransform(approximate=True).init, "jacobi": jacobi, "none": None}


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """How the div-curl least squares are solved.

    Args:
        method: ``transform`` (direct, by fast sine and cosine transforms, where they are exact), ``cg`` (batched
            conjugate gradients without a stored matrix), ``assembled`` (the same with the matrix, assembled as torch
            sparse COO; beyond 1.8 million nodes in 2D and 270,000 in 3D without it), ``stress`` (for the stress
            in elements that are far dearer than all others, see `StressGuess`), or ``auto``: ``transform`` where it
            is exact, ``stress`` where it suits, else ``assembled`` for a small matrix, else ``cg``. All have the same
            answer.
        preconditioner: of conjugate gradients: ``transform`` (the direct solver with the weights that are
            typical; where it is exact one step is enough), ``jacobi`` (the diagonal), ``none``.
        rtol: solved when ‖load − K v‖ ≤ max(rtol ‖load‖, atol). None asks for 1e-5 in float32 and 1e-10 in float64.
        atol: absolute tolerance on the residual.
        max_steps: steps of conjugate gradients at most.

    Raises:
        InputError: an unknown name, or a number out of range.
    """

    method: str = "auto"
    preconditioner: str = "transform"
    rtol: float | None = None
    atol: float = 0.0
    max_steps: int = 1000

    def __post_init__(self) -> None:
        require_choice(self.method, METHODS, "solver")
        require_choice(self.preconditioner, PRECONDITIONERS, "solver.preconditioner")
        require_ranges(self, "solver.", rtol="not negative", atol="not negative", max_steps="not negative")


def solver_of(settings: SolverSettings | str, system: DivCurlSystem) -> LinearSolver:
    """Return the solver that the settings, or the name of a method, choose for a system.

    Raises:
        InputError: an unknown name; `FastTransform.init` refuses ``transform`` where it is not exact.
    """
    how = settings if isinstance(settings, SolverSettings) else SolverSettings(method=settings)
    if how.method == "stress" and not suits(system):
        raise InputError("solver: stress is for weights of which some are far dearer than others; take auto or cg")
    if how.method == "transform" or (how.method == "auto" and is_exact_for(system)):
        return FastTransform(rtol=how.rtol, atol=how.atol)
    return ConjugateGradient(
        assembled=_is_assembled(how.method, system),
        preconditioner=PRECONDITIONERS[how.preconditioner],
        rtol=how.rtol,
        atol=how.atol,
        max_steps=how.max_steps,
        guess=StressGuess if how.method == "stress" or (how.method == "auto" and suits(system)) else None,
    )


def _is_assembled(method: str, system: DivCurlSystem) -> bool:
    """Tell whether the matrix of a system is assembled; one matrix has one set of weights and of given unknowns."""
    if system.also_fixed is not None and len(system.also_fixed) > 1:
        return False
    if method == "auto":
        one = all(weight.dim() == 0 or len(weight) == 1 for weight in system.weights.tensors)
        return one and system.matrix_entries <= SMALL_MATRIX
    return method == "assembled" and system.matrix_entries <= LARGEST_MATRIX
