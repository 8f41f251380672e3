"""Batched preconditioned conjugate gradients with implicit derivatives, alone and as a `LinearSolver`."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function

from torchdeform.core.grid import largest, magnitude, per_item
from torchdeform.core.tables import in_transformation
from torchdeform.errors import ComputationError, InputError
from torchdeform.solvers.base import Box, Factor, Solution, Status, System

# ‖r‖ ≤ rtol ‖b‖ is asked for when nothing else is said.
DEFAULT_RTOL = {torch.float32: 1e-5, torch.float64: 1e-10}


# (b, tolerance (B,), max_steps) -> (x, steps (B,), which items are as near as they come (B,)).
Guess = Callable[[Tensor, Tensor, int], tuple[Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Operator:
    """A self-adjoint, positive definite x ↦ A(θ) x on each item of a batch.

    Args:
        apply: ``apply(x, *parameters)`` returns A x, ``(B, ...)`` like x, each item from its own x alone.
        parameters: the tensors θ; gradients reach those that want one.
    """

    apply: Callable[..., Tensor]
    parameters: tuple[Tensor, ...] = ()

    def __call__(self, x: Tensor) -> Tensor:
        return self.apply(x, *self.parameters)


def conjugate_gradient(
    operator: Operator | Callable[[Tensor], Tensor],
    b: Tensor,
    *,
    preconditioner: Callable[[Tensor], Tensor] | None = None,
    x0: Tensor | None = None,
    rtol: float | None = None,
    atol: float = 0.0,
    max_steps: int = 1000,
    guess: Guess | None = None,
) -> Solution:
    """Solve A x = b for each item until ‖b − A x‖ ≤ max(rtol ‖b‖, atol), with the Euclidean norm of that item.

    Args:
        operator: A, self-adjoint and positive definite; an `Operator` where gradients are to reach what it is made of.
        b: ``(B, ...)``.
        preconditioner: r ↦ z ≈ A⁻¹ r, self-adjoint and positive definite, item by item; none by default.
        x0: where to start, ``(B, ...)``; zero by default.
        rtol: relative tolerance, by default `DEFAULT_RTOL` of the dtype.
        atol: absolute tolerance.
        max_steps: steps at most for each item.
        guess: another way to solve, which goes first; this one takes over where that fails, and checks its answer.

    Returns:
        `Solution`; the residual is computed anew from the result. An item that is not finite has the value NaN.

    Raises:
        InputError: b or x0 is not a float32 or float64 tensor with a batch axis, a tolerance is negative, or
            ``operator`` uses a tensor that wants a gradient and is not among its parameters.

    Notes:
        An item that is done is frozen, so a batch gives the results of its items one by one. When the residual computed
        anew misses the tolerance that the recurrence met, the item starts again from there as long as that halves it.
        The derivative of x along (db, dA) is A⁻¹ (db − dA x): one more solve, itself differentiable, that warns when it
        fails. x0 has none.
        One transfer from the device per step.
    """
    operator = operator if isinstance(operator, Operator) else Operator(operator)
    _check(b, x0, rtol, atol, max_steps)
    rtol = DEFAULT_RTOL[b.dtype] if rtol is None else rtol
    settings = Settings(preconditioner, rtol, atol, max_steps, torch.is_grad_enabled(), guess)
    report = Box()
    value = _Implicit.apply(operator.apply, settings, x0, report, b, *operator.parameters)
    return replace(report.content, value=value)


@dataclass(frozen=True)
class ConjugateGradient:
    """Conjugate gradients for a `System`, with or without its matrix.

    Args:
        assembled: multiply by the sparse matrix, made once from ``torch.sparse_coo_tensor`` into compressed rows;
            otherwise the operator is applied without one.
        preconditioner: ``(system, like) -> (r -> z)``, what is nearly the inverse of a system for loads with the type
            and device of ``like``, as `jacobi`; none when None.
        rtol: relative tolerance, by default `DEFAULT_RTOL` of the dtype.
        atol: absolute tolerance.
        max_steps: steps at most for each item.
        guess: ``(system, like) -> guess``, see `conjugate_gradient`; none when None.
    """

    assembled: bool = False
    preconditioner: Callable[[Any, Tensor], Callable[[Tensor], Tensor]] | None = None
    rtol: float | None = None
    atol: float = 0.0
    max_steps: int = 1000
    guess: Callable[[Any, Tensor], Guess] | None = None

    def init(self, system: System, like: Tensor) -> "ConjugateGradientFactor":
        """Return the solver made ready for a system; ``assembled`` makes its matrix here.

        Raises:
            InputError: with ``assembled``, coefficients that vary over the batch.
        """
        with torch.no_grad():
            precondition = None if self.preconditioner is None else self.preconditioner(system, like)
            guess = None if self.guess is None else self.guess(system, like)
        return ConjugateGradientFactor(self, system, ready_product(system, like, self.assembled), precondition, guess)


def ready_product(system: System, like: Tensor, assembled: bool = False) -> Callable[..., Tensor]:
    """Return v ↦ K(θ) v made ready for many products: by what the system has for that, or by its sparse matrix.

    Where a derivative is wanted, or `torch.func` transforms, which knows neither, by the operator, which equals it.
    """
    if in_transformation():
        return system.apply
    with torch.no_grad():
        quick = _matrix_product(system, like) if assembled else system.product(like)

    def product(v: Tensor, *parameters: Tensor) -> Tensor:
        if torch.is_grad_enabled() and any(p.requires_grad for p in (v, *parameters)):
            return system.apply(v, *parameters)
        return quick(v)

    return product


def _matrix_product(system: System, like: Tensor) -> Callable[[Tensor], Tensor]:
    rows = to_csr(system.matrix(like.device).to(like.dtype))
    return lambda v: (rows @ v.flatten(1).T).T.reshape(v.shape)


def to_csr(matrix: Tensor) -> Tensor:
    """Return a sparse matrix in compressed rows: torch multiplies by it 25 times faster than by the COO one.

    torch says that its CSR is in beta; the parts used here are tested.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return matrix.to_sparse_csr()


class ConjugateGradientFactor(Factor):
    """`ConjugateGradient` made ready for one system."""

    def __init__(
        self,
        solver: ConjugateGradient,
        system: System,
        product: Callable[..., Tensor],
        precondition: Callable[[Tensor], Tensor] | None,
        guess: Guess | None,
    ) -> None:
        self.solver, self.system, self.product = solver, system, product
        self.precondition, self.guess = precondition, guess

    def solution(self, load: Tensor, start: Tensor | None = None) -> Solution:
        """Return v with K v = load, from ``start`` (zero when None) on; see `conjugate_gradient`."""
        return conjugate_gradient(
            Operator(self.product, self.system.parameters),
            self.system.free(load),
            preconditioner=self.precondition,
            x0=None if start is None else self.system.free(start),
            rtol=self.solver.rtol,
            atol=self.solver.atol,
            max_steps=self.solver.max_steps,
            guess=self.guess,
        )

    def __call__(self, load: Tensor, *, power: int = 1) -> Tensor:
        """Return (K⁻¹ M)^(power − 1) K⁻¹ load by as many solves.

        Raises:
            ComputationError: a solve met no tolerance at all.
        """
        for step in range(power):
            solution = self.solution(self.system.mass(load) if step else load)
            failed = [s for s in solution.status if s not in (Status.CONVERGED, Status.ROUNDING)]
            if failed:
                raise ComputationError(f"solver: {failed[0].value}")
            load = solution.value
        return load


def jacobi(system: System, like: Tensor) -> Callable[[Tensor], Tensor]:
    """Return the preconditioner that divides by the diagonal of a system."""
    inverse = 1 / system.diagonal(like)
    return lambda r: r * inverse


@dataclass(frozen=True)
class Settings:
    """As for `conjugate_gradient`; the ``norm`` of a residual, ``(B,)`` from ``(B, ...)``, is its length when None.

    Without ``restart`` what the recurrence lost is left to who asked.
    """

    preconditioner: Callable[[Tensor], Tensor] | None
    rtol: float
    atol: float | Tensor
    max_steps: int
    watch: bool = False
    guess: Guess | None = None
    norm: Callable[[Tensor], Tensor] | None = None
    restart: bool = True


def _check(b: Tensor, x0: Tensor | None, rtol: float | None, atol: float, max_steps: int) -> None:
    if not isinstance(b, Tensor) or b.dtype not in DEFAULT_RTOL or b.dim() < 2 or b.numel() == 0:
        raise InputError("conjugate_gradient: b must be a float32 or float64 tensor (B, ...) that is not empty")
    if x0 is not None and (x0.shape, x0.dtype, x0.device) != (b.shape, b.dtype, b.device):
        raise InputError(f"conjugate_gradient: x0 must be like b, {tuple(b.shape)} of {b.dtype} on {b.device}")
    if atol < 0 or (rtol is not None and rtol < 0) or max_steps < 0:
        raise InputError("conjugate_gradient: rtol, atol and max_steps must not be negative")


class _Implicit(Function):
    """x = A(θ)⁻¹ b. From A dx = db − dA x and A = Aᵀ, a cotangent g of x is λ = A⁻¹ g for b and −λᵀ (∂A/∂θ) x for θ."""

    @staticmethod
    def forward(apply, settings: Settings, x0: Tensor | None, report: Box, b: Tensor, *parameters: Tensor):
        operator = Operator(apply, tuple(p.detach() for p in parameters))
        report.content = solve(operator, b.detach(), x0, settings)
        return report.content.value

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.product, ctx.settings, _, _, _, *parameters = inputs
        ctx.save_for_backward(output, *parameters)

    @staticmethod
    def vmap(info, in_dims, apply, settings, x0, report: Box, *tensors: Tensor):
        """Solve for one after the other: a batch of conjugate gradients is no faster on small systems."""
        found: list[Solution] = []
        for k in range(info.batch_size):
            first, *others = (
                t if dim is None else t.select(dim, k)
                for t, dim in zip((x0, *tensors), (in_dims[2], *in_dims[4:]), strict=True)
            )
            own = Box()
            value = _Implicit.apply(apply, settings, first, own, *others)
            found.append(replace(own.content, value=value))
        report.content = _worst(found)
        return torch.stack([solution.value for solution in found]), 0

    @staticmethod
    def backward(ctx, *grads: Tensor):
        x, *parameters = ctx.saved_tensors
        report = Box()
        adjoint = _Implicit.apply(ctx.product, replace(ctx.settings, atol=0.0), None, report, grads[0], *parameters)
        if why := {s.value for s in report.content.status if s in (Status.MAX_STEPS, Status.BREAKDOWN)}:
            text = f"conjugate_gradient, solving for a gradient: {'; '.join(sorted(why))}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)
        gradients = _parameter_gradients(ctx.product, x, parameters, ctx.needs_input_grad[5:], adjoint)
        return None, None, None, None, adjoint, *gradients


def _parameter_gradients(
    apply: Callable[..., Tensor], x: Tensor, parameters: list[Tensor], wanted: tuple[bool, ...], adjoint: Tensor
) -> list[Tensor | None]:
    """Return −λᵀ (∂A/∂θ) x for each wanted θ, with a graph where a further derivative may follow."""
    if not any(wanted):
        return [None] * len(parameters)

    def product(*chosen: Tensor) -> Tensor:
        rest = iter(chosen)
        return apply(x, *(next(rest) if w else p for p, w in zip(parameters, wanted, strict=True)))

    _, pull, *_ = torch.func.vjp(product, *(p for p, w in zip(parameters, wanted, strict=True) if w))
    found = iter(pull(-adjoint))
    return [next(found) if w else None for w in wanted]


def _worst(found: list[Solution]) -> Solution:
    """Return of solutions of the same items the first status that is not fine, the most steps, the largest residual."""
    status = tuple(
        next((s for s in several if not s.ok), several[0]) for several in zip(*(s.status for s in found), strict=True)
    )
    steps, residual = (torch.stack([getattr(s, name) for s in found]).amax(0) for name in ("steps", "residual"))
    return Solution(found[0].value, status, steps, residual)


# What has become of an item; the others are still under way.
_RUNNING, _MET, _BREAKDOWN, _NON_FINITE, _ROUNDING = range(5)
_STATUS = (Status.MAX_STEPS, Status.CONVERGED, Status.BREAKDOWN, Status.NON_FINITE, Status.ROUNDING)


def solve(operator: Operator, b: Tensor, x0: Tensor | None, settings: Settings) -> Solution:
    """Descend, and again from the residual computed anew as long as that is worth it."""
    b, x, finite, scale = _scaled(b, x0)
    length = settings.norm or norms
    norm = length(b)
    tolerance = torch.maximum(settings.rtol * norm, settings.atol / scale.flatten())
    steps = torch.zeros(b.shape[0], dtype=torch.int64, device=b.device)
    r = b.clone() if x0 is None else _residual(operator, b, x, settings)
    before = length(r)
    code = torch.where(before <= tolerance, _MET, _RUNNING)
    while settings.guess is not None:
        asked = torch.where(per_item(code == _MET, r), 0, r)
        change, more, near = settings.guess(asked, tolerance, settings.max_steps)
        x, steps = x + change, steps + more
        r = _residual(operator, b, x, settings)
        left = length(r)
        again = near & (left > tolerance) & (left < before / 2)
        code, before = torch.where((left <= tolerance) | (near & ~again), _MET, _RUNNING), left
        if not bool(again.any()):
            break
    while True:
        code = _descend(operator, settings, (x, r), tolerance, code, steps)
        r = _residual(operator, b, x, settings)
        left = length(r)
        missed = (code == _MET) & (left > tolerance)
        again = missed & (left < before / 2) & settings.restart
        code = torch.where(missed, torch.where(again, _RUNNING, _ROUNDING), code)
        if not bool((again & (steps < settings.max_steps)).any()):
            break
        before = left
    x = x * scale
    lost = ~finite | (code == _NON_FINITE) | ~torch.isfinite(largest(x))
    code = torch.where(lost, _NON_FINITE, code)
    residual = torch.where(lost, torch.nan, torch.where(norm > 0, left / norm, 0))
    value = torch.where(per_item(lost, x), torch.nan, x)
    return Solution(value, tuple(_STATUS[c] for c in code.tolist()), steps, residual)


def _residual(operator: Operator, b: Tensor, x: Tensor, settings: Settings) -> Tensor:
    with torch.set_grad_enabled(settings.watch):
        product = operator(x)
    if product.requires_grad:
        raise InputError(
            "conjugate_gradient: the operator uses tensors that want a gradient; list them in Operator.parameters"
        )
    return b - product


def _scaled(b: Tensor, x0: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return b, the start, which items of them are finite, and a power of two per item.

    Items that are not finite are emptied, the others divided by their power so that no square overflows or vanishes.
    """
    finite = torch.isfinite(b).flatten(1).all(1)
    if x0 is not None:
        finite &= torch.isfinite(x0).flatten(1).all(1)
    b = torch.where(per_item(finite, b), b, 0)
    scale = magnitude(b)
    if x0 is None:
        return b / scale, torch.zeros_like(b), finite, scale
    return b / scale, torch.where(per_item(finite & (largest(b) > 0), b), x0.detach(), 0) / scale, finite, scale


def _descend(
    operator: Operator,
    settings: Settings,
    state: tuple[Tensor, Tensor],
    tolerance: Tensor,
    code: Tensor,
    steps: Tensor,
) -> Tensor:
    """Run the recurrence on the items under way; change x, r and steps in place; return what became of the items."""
    x, r = state
    length = settings.norm or norms
    p, rz = torch.zeros_like(r), torch.ones_like(tolerance)
    running = (code == _RUNNING) & (steps < settings.max_steps)
    while True in (alive := running.tolist()):
        z = r if settings.preconditioner is None else settings.preconditioner(r)
        before, rz = rz, dots(r, z)
        p.mul_(per_item(rz / before, p)).add_(z)
        for item, runs in enumerate(alive):
            if not runs:
                p[item].zero_()
        q = operator(p)
        curvature = dots(p, q)
        positive = running & (curvature > 0) & (rz > 0)
        alpha = per_item(torch.where(positive, rz / curvature, 0), p)
        x.addcmul_(p, alpha)
        r.addcmul_(q, alpha, value=-1)
        left = length(r)
        steps += running
        became = torch.where((left <= tolerance) | (rz == 0), _MET, torch.where(positive, _RUNNING, _BREAKDOWN))
        became = torch.where(torch.isfinite(curvature) & torch.isfinite(rz) & torch.isfinite(left), became, _NON_FINITE)
        code = torch.where(running, became, code)
        running = (code == _RUNNING) & (steps < settings.max_steps)
    return code


def dots(a: Tensor, b: Tensor) -> Tensor:
    """Return a·b for each item ``(B,)``, one by one: a batch may be summed in another order than an item alone."""
    return torch.stack([torch.dot(i.reshape(-1), j.reshape(-1)) for i, j in zip(a, b, strict=True)])


def norms(a: Tensor) -> Tensor:
    """Return |a| for each item ``(B,)``."""
    return dots(a, a).sqrt()
