"""A map from its Jacobian determinant and its curl, by the Gauss-Newton method."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS, KERNELS, cofactors, jacobian
from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.fold_free import largest_share
from torchdeform.core.grid import Grid, common_batch, per_item
from torchdeform.deformation.finite_differences import Differences, continued
from torchdeform.deformation.monitors import require_positive
from torchdeform.errors import InputError, require_choice, require_ranges
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.fem.div_curl import solve_div_curl
from torchdeform.solvers.base import Solution, Status
from torchdeform.solvers.cg import DEFAULT_RTOL, conjugate_gradient, dots

# ‖residual‖ ≤ rtol ‖(f − 1, curl)‖ is asked for when nothing else is said.
_RTOL = {torch.float32: 1e-5, torch.float64: 1e-12}

# The least squares are at their minimum when a step is this share of the displacement, or is to take as little off the
# residual.
_STATIONARY = {torch.float32: 1e-4, torch.float64: 1e-10}

# No step takes a determinant below this share of the smaller one of what it is and what it shall be.
_LEAST_SHARE = 0.1

# What a map may be held by on the boundary.
_BOUNDARIES = ("dirichlet", "slip")

# Steps are halved this often at most.
_HALVINGS = 11


@dataclass(frozen=True, kw_only=True)
class NewtonSettings:
    """How `from_jacobian_and_curl` goes about it.

    Args:
        rtol: solved when ‖(det ∇φ − f, curl φ − g)‖ ≤ rtol ‖(f − 1, g)‖. None asks for 1e-5 in float32 and 1e-12 in
            float64, or for what rounding of φ allows where that is more.
        max_steps: Gauss-Newton steps at most.
        linear_steps: steps of conjugate gradients at most within each of them.

    Raises:
        InputError: a number out of range.
    """

    rtol: float | None = None
    max_steps: int = 30
    linear_steps: int = 500

    def __post_init__(self) -> None:
        require_ranges(
            self, "NewtonSettings: ", rtol="not negative", max_steps="not negative", linear_steps="at least 1"
        )


@dataclass(frozen=True)
class PrescribedSolution(Solution):
    """A map with a given determinant and curl.

    Attributes:
        value: displacement u ``(B, D, *S)`` in units of spacing.
        status: ``CONVERGED`` where a map has both; ``STAGNATED`` where none has, the value being the least-squares
            answer.
        steps: Gauss-Newton steps ``(B,)``.
        residual: ‖(det ∇φ − f, curl φ − g)‖ / ‖(f − 1, g)‖, ``(B,)``, in the L2 norm (trapezoidal rule).
        residuals: the same at the start and after each step, ``(most steps + 1, B)``; items that are done keep theirs.
        linear_steps: steps of conjugate gradients in all, ``(B,)``.
        smallest: the smallest one-sided determinant of φ, ``(B,)``; positive certifies a digital diffeomorphism.
    """

    residuals: Tensor
    linear_steps: Tensor
    smallest: Tensor


_DEFAULT = NewtonSettings()

# For the data continued to where they are not given, which as a rule no map has.
_FIRST = NewtonSettings(rtol=1e-4, max_steps=5)


def from_jacobian_and_curl(
    f: Tensor,
    curl: Tensor,
    grid: Grid,
    *,
    boundary: str = "dirichlet",
    boundary_displacement: Tensor | None = None,
    start: Tensor | None = None,
    order: int = 2,
    settings: NewtonSettings = _DEFAULT,
) -> PrescribedSolution:
    """Return u of the map φ = id + u with det ∇φ = f and curl φ = g in Ω that keeps its boundary.

    Args:
        f: determinant wanted, ``(B, 1, *S)``, positive; NaN where it is not prescribed.
        curl: g ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, components as in `stencil.curl`; NaN where it is not
            prescribed.
        grid: the grid.
        boundary: ``dirichlet``: φ = id on the boundary, or as given; ``slip``: n·u = 0, or as given, and φ may glide
            along it.
        boundary_displacement: u on the boundary, ``(B, D, *S)`` in units of spacing, only what the boundary gives
            matters; 0 by default.
        start: where to start, ``(B, D, *S)``, only what the boundary does not give matters; by default 0, or with a
            ``boundary_displacement`` the field with divergence f − 1 and curl g.
        order: order of the finite differences that f and g are given in, 2 or 4, see `jacobian_determinant`.
        settings: tolerance and steps.

    Returns:
        `PrescribedSolution`.

    Raises:
        InputError: shapes, types, order, boundary, f that is not positive, infinite numbers, NaN in
            boundary_displacement or start, an item with neither f nor curl, too few nodes for the order.

    Notes:
        Minimises ∫ (det ∇φ − f)² + |curl φ − g|². Each step solves for a div-curl system with the cofactors of ∇φ as
        coefficients, Σ C_ka ∂_a v_k = f − det ∇φ and curl v = g − curl φ, by least squares on the finite differences of
        `stencil` (see `least_squares`), so that the f and g of a map give back that map to rounding. Steps are halved
        until the residual falls and no determinant has lost more than nine tenths.
        Converges quadratically where φ with f and g exists, 4 to 8 steps, linearly else. The steps' systems are
        elliptic as long as the symmetric part of the cofactors is positive definite, that is for local rotations below
        90°; near that they take many more steps of conjugate gradients, and beyond it the method may end in another
        minimum: give a ``start`` that is near. Differentiable once in f, curl and boundary_displacement, by the
        implicit function theorem, also where the data are inconsistent.
        What is not prescribed is left out of the sum. Where the rest leaves waves from node to node open, as without
        the boundary's rows, the answer is the map nearest to the one for f and g continued smoothly to there.
    """
    problem = _problem(f, curl, boundary_displacement, Differences(grid, order, boundary))
    with torch.no_grad():
        descent = _Descent(problem, problem.start(start), settings)
        descent.run()
    value = problem.attach(descent.now.u)
    return descent.solution(value)


class _State(NamedTuple):
    """A map and how far it is off, one entry per item: u, ∇φ and its determinant, data − rows, and the norm of that."""

    u: Tensor
    matrix: Tensor
    det: Tensor
    left: Tensor
    norm: Tensor

    def take(self, index: Tensor) -> "_State":
        return _State(*(part[index] for part in self))

    def choose(self, index: Tensor, other: "_State") -> "_State":
        """Return the state with the items ``index`` replaced."""
        return _State(*(mine.index_copy(0, index, new) for mine, new in zip(self, other, strict=True)))


@dataclass(frozen=True)
class _Problem:
    """Checked input with one batch size: ``data`` holds f and g, `continued` to where ``known`` is 0 instead of 1."""

    differences: Differences
    data: Tensor
    known: Tensor
    values: Tensor | None
    fixed: Tensor

    @property
    def grid(self) -> Grid:
        return self.differences.grid

    def complete(self, u: Tensor) -> Tensor:
        """u with the given values on the boundary."""
        return u.masked_fill(self.fixed, 0) if self.values is None else torch.where(self.fixed, self.values, u)

    def take(self, index: Tensor) -> "_Problem":
        """Return the problem of some items."""
        values = None if self.values is None else self.values[index]
        return replace(self, data=self.data[index], known=self.known[index], values=values)

    def start(self, given: Tensor | None) -> Tensor:
        if given is not None:
            self.grid.check_vector(given, "from_jacobian_and_curl: start")
            if not bool(given.isfinite().all()):
                raise InputError("from_jacobian_and_curl: start must be finite")
            if given.shape[0] not in (1, len(self.data)):
                raise InputError(f"from_jacobian_and_curl: start has {given.shape[0]} items, the data {len(self.data)}")
            return self.complete(given.detach().to(self.data).expand(len(self.data), -1, *self.grid.shape))
        plain = self._plain_start()
        index = (self.known == 0).flatten(1).any(1).nonzero().flatten()
        if len(index) == 0:
            return plain
        part = self.take(index)
        descent = _Descent(replace(part, known=torch.ones_like(part.known)), plain[index], _FIRST)
        descent.run()
        return plain.index_copy(0, index, descent.now.u)

    def _plain_start(self) -> Tensor:
        if self.values is None:
            return self.data.new_zeros(self.data.shape[0], self.grid.dim, *self.grid.shape)
        div, curl = self.data[:, :1] - 1, self.data[:, 1:]
        return solve_div_curl(div, curl, self.grid, self.differences.boundary, boundary_values=self.values).value

    def look(self, u: Tensor, index: Tensor) -> _State:
        """Return the state of items ``index`` at u."""
        matrix, rows = self.differences.of_map(u)
        left = (self.data[index] - rows) * self.known[index]
        return _State(u, matrix, rows[:, :1], left, self.differences.norm(left))

    def scale(self) -> Tensor:
        """‖(f − 1, g)‖ of each item."""
        return self.differences.norm(torch.cat([self.data[:, :1] - 1, self.data[:, 1:]], dim=1) * self.known)

    def rounding(self, u: Tensor) -> Tensor:
        """What rounding leaves of the residual, roughly: an ε of every number that is differentiated."""
        size = 1 + _largest(u / self.grid.along(self.grid.spacing, u))
        return 4 * torch.finfo(u.dtype).eps * size * math.sqrt(self.grid.volume / self.grid.cell_volume)

    def attach(self, u: Tensor) -> Tensor:
        """Return u with its derivative in f, g and the boundary values.

        At the minimum the gradient of half the squares vanishes, G(u; data, values) = 0, so du = −H⁻¹ ∂G with the
        Hessian H. A solve of H x = G that may stop at once, as G = 0, returns x = 0 and has that derivative.
        """
        wanted = self.data.requires_grad or (self.values is not None and self.values.requires_grad)
        if not (wanted and torch.is_grad_enabled()):
            return u
        matrix, rows = self.differences.of_map(self.complete(u))
        residual = (rows - self.data) * self.known
        gradient = self.differences.adjoint(residual, cofactors(matrix))
        hessian = _Hessian(self.differences, matrix.detach(), self.known, residual.detach())
        precondition = self.differences.preconditioner(u)
        step = conjugate_gradient(hessian, gradient, preconditioner=precondition, atol=math.inf)
        # What a gradient says about given values is theirs, and no load that the Hessian could meet.
        return self.complete(u) - step.value.masked_fill(self.fixed, 0)


@dataclass(frozen=True)
class _Hessian:
    """v ↦ Aᵀ W A v + ∂(cofactors)ᵀ W residual: the second derivative of ½ ∫ residual²."""

    differences: Differences
    matrix: Tensor
    known: Tensor
    residual: Tensor

    def __call__(self, v: Tensor) -> Tensor:
        factors = cofactors(self.matrix)
        slope = jacobian(v, self.differences.grid, order=self.differences.order)
        # Cofactors are linear in 2D and quadratic in 3D: either way this is their derivative along the slope.
        change = (cofactors(self.matrix + slope) - cofactors(self.matrix - slope)) / 2
        determinant = F.pad(self.residual[:, :1], [0, 0] * self.differences.grid.dim + [0, self.residual.shape[1] - 1])
        adjoint = self.differences.adjoint
        return adjoint(self.differences.rows(v, factors) * self.known, factors) + adjoint(determinant, change)


def _problem(f: Tensor, curl: Tensor, values: Tensor | None, differences: Differences) -> _Problem:
    """Check the input and give it one batch size."""
    where, grid = "from_jacobian_and_curl", differences.grid
    require_choice(differences.order, KERNELS, f"{where}: order")
    require_choice(differences.boundary, _BOUNDARIES, f"{where}: boundary")
    grid.check_scalar(f, f"{where}: f")
    require_positive(f.nan_to_num(nan=1.0, posinf=math.inf), grid, f"{where}: f")
    grid.check(curl, f"{where}: curl", components=len(CURL_PAIRS[grid.dim]))
    given = [f, curl]
    if values is not None:
        grid.check_vector(values, f"{where}: boundary_displacement")
        given.append(values)
    if len({(t.dtype, t.device) for t in given}) > 1 or f.dtype not in DEFAULT_RTOL:
        raise InputError(f"{where}: all must be float32, or all float64, on one device")
    if bool(curl.isinf().any()) or not all(bool(t.isfinite().all()) for t in given[2:]):
        raise InputError(f"{where}: curl must be finite, or NaN for not prescribed, and boundary_displacement finite")
    batch = common_batch(where, *given)
    f, curl, *given = (t.expand(batch, *t.shape[1:]) for t in given)
    data = torch.cat([f, curl], dim=1)
    known = ~data.isnan()
    if not bool(known.flatten(1).any(1).all()):
        raise InputError(f"{where}: an item has NaN everywhere in f and curl; prescribe at least one of them")
    if not bool(known.all()):
        with torch.no_grad():
            filled = torch.cat([continued(f.log(), known[:, :1]).exp(), continued(curl, known[:, 1:])], dim=1)
        data = torch.where(known, data, filled)
    fixed = fixed_unknowns(differences.boundary, grid, f.device)
    return _Problem(differences, data, known.to(data.dtype), next(iter(given), None), fixed)


def _largest(field: Tensor) -> Tensor:
    """Return the largest absolute value of each item ``(B,)``."""
    return field.abs().flatten(1).amax(1)


def _share(part: Tensor, whole: Tensor) -> Tensor:
    """Return largest part / largest whole of each item, ``(B,)``; 0 of 0 is 0."""
    return _largest(part) / _largest(whole).clamp(min=torch.finfo(part.dtype).tiny)


class _Descent:
    """The steps, made by all items that are not done. What has become of an item is in ``code``."""

    def __init__(self, problem: _Problem, u: Tensor, settings: NewtonSettings) -> None:
        self.problem, self.differences, self.settings = problem, problem.differences, settings
        self.now = problem.look(u, torch.arange(u.shape[0], device=u.device))
        self.scale = problem.scale().clamp(min=torch.finfo(u.dtype).tiny)
        self.precondition = self.differences.preconditioner(u)
        self.steps = torch.zeros(u.shape[0], dtype=torch.int64, device=u.device)
        self.linear_steps, self.stuck = torch.zeros_like(self.steps), torch.zeros_like(self.steps, dtype=torch.bool)
        self.norms = [self.now.norm]

    def tolerance(self) -> Tensor:
        """The norm of the residual that is small enough."""
        if self.settings.rtol is not None:
            return self.settings.rtol * self.scale
        return torch.maximum(_RTOL[self.now.u.dtype] * self.scale, self.problem.rounding(self.now.u))

    def run(self) -> None:
        while len(index := self._running()) and int(self.steps.max()) < self.settings.max_steps:
            before = self.now.take(index)
            move, gain = self._direction(before, index)
            after, share = self._search(before, move, gain, index)
            self.now = self.now.choose(index, after)
            self.steps[index] += 1
            small = torch.minimum(gain, _share(move, after.u)) <= _STATIONARY[move.dtype]
            self.stuck[index] = small | (share == 0)
            self.norms.append(self.now.norm)

    def _running(self) -> Tensor:
        return ((self.now.norm > self.tolerance()) & ~self.stuck).nonzero().flatten()

    def _direction(self, now: _State, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return the step, and by which share of the residual it would shorten it if all were linear."""
        rows, adjoint, known = self.differences.rows, self.differences.adjoint, self.problem.known[index]
        factors = cofactors(now.matrix)
        slope = adjoint(now.left, factors)
        # CG has one tolerance for all items: each is scaled so that it is 1.
        unit = (self._forcing(now, index) * dots(slope, slope).sqrt()).clamp(min=torch.finfo(slope.dtype).tiny)
        unit = per_item(unit, slope)
        solution = conjugate_gradient(
            lambda v: adjoint(rows(v, factors) * known, factors),
            slope / unit,
            preconditioner=self.precondition,
            rtol=0.0,
            atol=1.0,
            max_steps=self.settings.linear_steps,
        )
        self.linear_steps[index] += solution.steps
        move = solution.value * unit
        return move, dots(move, slope).clamp(min=0).sqrt() / now.norm

    def _forcing(self, now: _State, index: Tensor) -> Tensor:
        """How far to solve for a step: in proportion to the residual, which keeps the convergence quadratic."""
        wanted = self.tolerance()[index] / now.norm
        share = torch.maximum((now.norm / self.scale[index]).clamp(max=1.0), wanted) / 10
        return share.clamp(min=DEFAULT_RTOL[now.u.dtype])

    def _search(self, before: _State, move: Tensor, gain: Tensor, index: Tensor) -> tuple[_State, Tensor]:
        """Return the state after the longest of the shares 1, 1/2, 1/4, .. of the step that will do, and the share."""
        after = before

        def accept(share: Tensor) -> Tensor:
            nonlocal after
            after = self.problem.look(before.u + per_item(share, move) * move, index)
            return self._acceptable(before, after, share * gain**2, index)

        share = largest_share(accept, before.norm, halvings=_HALVINGS)
        return before.choose((share > 0).nonzero().flatten(), after.take(share > 0)), share

    def _acceptable(self, before: _State, after: _State, promise: Tensor, index: Tensor) -> Tensor:
        """Tell which items keep a little of what was promised for the squared residual, and their orientation."""
        f, known = self.problem.data[index, :1], self.problem.known[index, :1] > 0
        old, wanted = before.det, torch.where(known, f, math.inf)
        least = torch.where(old > 0, _LEAST_SHARE * torch.minimum(old, wanted), old)
        slack = 4 * torch.finfo(f.dtype).eps - 1e-4 * promise
        return (after.norm <= (1 + slack) * before.norm) & (after.det >= least).flatten(1).all(1)

    def solution(self, value: Tensor) -> PrescribedSolution:
        """Return the outcome, with ``value`` for the displacement."""
        residuals = torch.stack(self.norms) / self.scale
        return PrescribedSolution(
            value=value,
            status=tuple(self._status()),
            steps=self.steps,
            residual=residuals[-1],
            residuals=residuals,
            linear_steps=self.linear_steps,
            smallest=smallest_determinant(self.now.u, self.problem.grid),
        )

    def _status(self) -> list[Status]:
        met = (self.now.norm <= self.tolerance()).tolist()
        rounding = (self.now.norm <= 100 * self.problem.rounding(self.now.u)).tolist()
        halted = {True: Status.ROUNDING, False: Status.STAGNATED}
        return [
            Status.CONVERGED if m else halted[r] if s else Status.MAX_STEPS
            for m, r, s in zip(met, rounding, self.stuck.tolist(), strict=True)
        ]
