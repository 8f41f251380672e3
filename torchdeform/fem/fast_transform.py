"""The direct solver: sines and cosines diagonalise the div-curl least squares on a box with constant weights.

On one axis with n nodes at distance h let M, K, C be the matrices of ∫NᵢNⱼ, ∫Nᵢ'Nⱼ', ∫Nᵢ'Nⱼ. For θ = π j/(n − 1), with
E = diag(½, 1, .., 1, ½) where the ends are free (cos), and on the inner nodes where they are zero (sin),

    M cos = μ E cos,   K cos = κ E cos,   M sin = μ sin,   K sin = κ sin,   μ = h (2 + cos θ)/3,   κ = 2 (1 − cos θ)/h,
    C cos = s sin,     Cᵀ cos = −s sin,   Cᵀ sin = s E cos,   C sin = −s E cos,   s = sin θ.

Let each pair of opposite faces be slip or tangential. With sines along the axes where a component vanishes and cosines
along the others, each set of frequencies (j_1, .., j_D) is a D×D block of its own: the Kronecker products of M and K
stand on its diagonal, w_div C⊗Cᵀ − w_curl Cᵀ⊗C off it. Divided by Π μ, with λ = κ/μ, δ = w_div − w_curl, and t = s/μ
across slip faces, −s/μ across tangential ones, it is

    B = diag(d) + δ t tᵀ,   d_k = w_curl (Σ_{a≠k} λ_a + t_k²) + w_div r_k + w_zero,   r = λ − t² = ((1 − cos θ)/μ)² / 3.

What is integrated at the centres (see `form.div_form`), with weights e_div and e_curl, has μ̄ = h (1 + cos θ)/2 in the
place of μ, for which κ μ̄ = s². So it is

    e_div g gᵀ + e_curl (|g|² − g gᵀ),   g_k² = λ_k Π_{a≠k} μ̄_a/μ_a,   with the signs of t.

The formula of Sherman and Morrison inverts it all, once for t and once for g. With w_div = w_curl = w it is the number
w Σ λ + w_zero, also where all of v vanishes on some faces: there C is antisymmetric, so the coupling is δ C⊗Cᵀ and goes
with δ. All of this holds exactly for the discrete system.
"""

import math
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from torchdeform.core.grid import Grid, largest, magnitude
from torchdeform.core.tables import numbers_are_real
from torchdeform.errors import InputError
from torchdeform.fem.boundary import Boundary, Face, fixes, resolve_boundary
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Factor, Solution, Status, listed
from torchdeform.solvers.cg import DEFAULT_RTOL
from torchdeform.solvers.sine_cosine import Kind, Kinds, separable_transform


@dataclass(frozen=True)
class FastTransform:
    """The direct solver of a `DivCurlSystem`, or with ``approximate`` the nearest system that transforms can solve.

    Args:
        approximate: where the transforms do not invert K, invert a symmetric positive definite operator near it, made
            of the typical weights: a preconditioner. Otherwise such a system is refused.
        rtol: converged when ‖load − K v‖ ≤ max(rtol ‖load‖, atol); `DEFAULT_RTOL` of the dtype when None.
        atol: absolute tolerance on the residual.
    """

    approximate: bool = False
    rtol: float | None = None
    atol: float = 0.0

    def init(self, system: DivCurlSystem, like: Tensor) -> "TransformFactor":
        """Return the factors for loads with the type and device of ``like``.

        Raises:
            InputError: the transforms are not exact for the system, see `transform_is_exact`.
        """
        if not (self.approximate or is_exact_for(system)):
            raise InputError("solver: transform is not exact for these weights and faces; take auto or cg")
        return TransformFactor(system, like, DEFAULT_RTOL[like.dtype] if self.rtol is None else self.rtol, self.atol)


class TransformFactor(Factor):
    """Solve K v = load, K the Q1 matrix of ∫ w_div (div v)² + w_curl |curl v|² + w_zero |v|², by fast transforms.

    Args:
        system: grid, weights (what is typical of them where they vary over space) and boundary.
        like: a tensor with the type and device of the loads to come.
        rtol: relative tolerance that a solution is judged by.
        atol: absolute tolerance.

    Notes:
        Factors are computed once. A solve costs 2·D transforms. Differentiable in the load to every degree, and in
        weights that are tensors. Keeps working memory: use one per thread.
    """

    def __init__(self, system: DivCurlSystem, like: Tensor, rtol: float, atol: float) -> None:
        grid, weights, boundary = system.grid, system.weights, system.boundary
        self.system, self.grid, self.rtol, self.atol = system, grid, rtol, atol
        self.kinds = _kinds(resolve_boundary(boundary, grid.dim), grid.dim)
        self._like = self._workspace = like.detach().new_empty(0)
        symbols = [_Symbols(grid, axis, self._like) for axis in range(grid.dim)]
        weights = weights.without_strain(grid.dim)
        weights = (weights if weights.constant else weights.typical()).to(self._like)
        coupled = transform_is_exact(grid, weights, boundary) and not weights.isotropic
        self._modes = _CoupledModes(symbols, weights, self.kinds) if coupled else _ScalarModes(symbols, weights)
        self._needs_grad = any(w.requires_grad for w in weights.tensors)

    def __call__(self, load: Tensor, *, power: int = 1) -> Tensor:
        """Return v = (M⁻¹K)^−power M⁻¹ load, M being the mass matrix; power 1 solves K v = load.

        Args:
            load: assembled right-hand side ``(B, D, *S)``, one number per test function (M times a field, not a field).
                What it says about components that the boundary condition gives is left out.
            power: 1, or more for a smoother v: each further power divides the modes of frequency ξ by w |ξ|² + w_zero.

        Returns:
            v ``(B, D, *S)``, zero where the boundary condition gives it.

        Raises:
            InputError: shape, type or device of the load, or a power below 1.
        """
        self.grid.check_vector(load, "FastTransform: load")
        if (load.dtype, load.device) != (self._like.dtype, self._like.device):
            made, got = (f"{t.dtype} on {t.device}" for t in (self._like, load))
            raise InputError(f"FastTransform: made for {made}, got a load of {got}")
        if power < 1:
            raise InputError(f"FastTransform: power must be at least 1, got {power}")
        masked = self.system.also_fixed is not None
        modes = separable_transform(self.system.free(load) if masked else load, self.kinds, out=self._buffer(load))
        v = separable_transform(self._modes.divide(modes, power), self.kinds)
        return self.system.free(v) if masked else v

    def solution(self, load: Tensor, start: Tensor | None = None) -> Solution:
        """Return v, with the residual that rounding leaves."""
        free = self.system.free(load)
        scale = magnitude(free)
        free = free / scale
        value = self(free)
        with torch.no_grad():
            norm, left = (t.flatten(1).norm(dim=1) for t in (free, free - self.system.apply(value)))
        value = value * scale
        met = left <= torch.maximum(self.rtol * norm, self.atol / scale.flatten())
        finite = torch.isfinite(left) & torch.isfinite(largest(value))
        codes = torch.where(finite, (~met).long(), 2)
        status = tuple((Status.CONVERGED, Status.ROUNDING, Status.NON_FINITE)[code] for code in listed(codes))
        steps = torch.zeros(load.shape[0], dtype=torch.int64, device=load.device)
        residual = torch.where(norm > 0, left / norm, 0)
        return Solution(value, status, steps, torch.where(finite, residual, torch.nan))

    def _buffer(self, load: Tensor) -> Tensor | None:
        """Memory for the modes, kept as new pages cost a fifth of a solve; None where autograd holds on to them."""
        if not numbers_are_real() or (torch.is_grad_enabled() and (load.requires_grad or self._needs_grad)):
            return None
        if self._workspace.shape != load.shape:
            with torch.inference_mode(False):
                self._workspace = load.new_empty(load.shape)
        return self._workspace


def is_exact_for(system: DivCurlSystem) -> bool:
    """Tell whether the transforms invert the matrix of a system, see `transform_is_exact`."""
    return system.also_fixed is None and transform_is_exact(system.grid, system.weights, system.boundary)


def transform_is_exact(grid: Grid, weights: Weights, boundary: Boundary) -> bool:
    """Tell whether `FastTransform` inverts K exactly.

    Args:
        grid: the grid of v.
        weights: the weights.
        boundary: as `resolve_boundary`.

    Returns:
        True for weights constant over space without a strain, opposite faces of one kind, no free face, and either
        w_div = w_curl or no face where all of v is given; provided that K can be inverted at all.

    Raises:
        InputError: as `resolve_boundary`.
    """
    faces = resolve_boundary(boundary, grid.dim)
    allowed = {"slip", "no_slip_tangential"} | ({"dirichlet"} if weights.isotropic else set())
    paired = all(faces[Face(axis, 0)] == faces[Face(axis, 1)] for axis in range(grid.dim))
    # Between slip faces and one pair of tangential ones a constant field flows freely, and only w_zero holds it.
    held = all("sine" in along for along in _kinds(faces, grid.dim)) or weights.zero_positive
    plain = not isinstance(weights.strain, Tensor) and weights.strain == 0
    return weights.constant and plain and paired and held and set(faces.values()) <= allowed


def _kinds(faces: dict[Face, str], dim: int) -> Kinds:
    """Sines for component k along an axis where both faces give it, else cosines, which miss no free unknown."""
    given = [[all(fixes(faces, Face(axis, side), k) for side in (0, 1)) for axis in range(dim)] for k in range(dim)]
    return tuple(tuple("sine" if both else "cosine" for both in row) for row in given)


def solve_poisson(load: Tensor, grid: Grid) -> Tensor:
    """Return the Q1 function w with ∫ ∇w·∇N = load(N) inside and w = 0 on the boundary.

    Args:
        load: assembled right-hand side ``(B, C, *S)``, each channel for itself; entries on the boundary are left out.
        grid: the grid.

    Returns:
        ``(B, C, *S)``.

    Raises:
        InputError: shape.

    Notes:
        Exact, by sine transforms; differentiable to every degree.
    """
    grid.check(load, "solve_poisson: load")
    sines: tuple[Kind, ...] = tuple("sine" for _ in grid.shape)
    kinds = (sines,) * load.shape[1]
    modes = _ScalarModes([_Symbols(grid, axis, load) for axis in range(grid.dim)], Weights())
    return separable_transform(modes.divide(separable_transform(load, kinds), 1), kinds)


class _Symbols:
    """What the 1D matrices do to the modes of one axis, as tensors like ``like`` that broadcast over ``(B, C, *S)``.

    ``mass`` also holds the squared length of a mode, Σ E cos² = (n − 1)/2, twice that at the two ends.
    """

    def __init__(self, grid: Grid, axis: int, like: Tensor) -> None:
        size, spacing = grid.shape[axis], grid.spacing[axis]
        theta = torch.arange(size, dtype=torch.float64, device="cpu") * (math.pi / (size - 1))
        # 1 − cos θ without cancellation; the last sine is zero, not 1e-16.
        versine, sine = 2 * (theta / 2).sin() ** 2, theta.sin()
        sine[-1] = 0.0
        mu = spacing * (3 - versine) / 3
        mean = spacing * (theta / 2).cos() ** 2 / mu
        mean[-1] = 0.0  # not 1e-33
        norm = torch.full_like(theta, (size - 1) / 2)
        norm[[0, -1]] = float(size - 1)
        shape = [1, 1, *(size if a == axis else 1 for a in range(grid.dim))]
        self.mass = (norm * mu).view(shape).to(like)
        self.stiffness = (2 * versine / (spacing * mu)).view(shape).to(like)
        self.mixed = (sine / mu).view(shape).to(like)
        self.rest = ((versine / mu) ** 2 / 3).view(shape).to(like)
        self.mean = mean.view(shape).to(like)
        self.lowest = float(self.stiffness.flatten()[1])


class _ScalarModes:
    """w_div = w_curl: every mode is divided by one number. Other weights are replaced by their mean."""

    def __init__(self, symbols: list[_Symbols], weights: Weights) -> None:
        weight = (weights.div + weights.curl) / 2
        total = weight * reduce(torch.add, [s.stiffness for s in symbols]) + weights.zero
        inverse = 1 / _held(total, weights, symbols)
        self.first = inverse / reduce(torch.mul, [s.mass for s in symbols])
        self.further = inverse

    def divide(self, modes: Tensor, power: int) -> Tensor:
        modes = _scale(modes, self.first)
        for _ in range(power - 1):
            modes = _scale(modes, self.further)
        return modes


class _CoupledModes:
    """w_div ≠ w_curl: of a mode b, B⁻¹ b = A⁻¹ b − h γ (t·b) with h = A⁻¹ t for each δ t tᵀ added to a diagonal A."""

    def __init__(self, symbols: list[_Symbols], weights: Weights, kinds: Kinds) -> None:
        (div, rest_div), (curl, rest_curl) = weights.parts
        signs = [1.0 if along[k] == "sine" else -1.0 for k, along in enumerate(kinds)]
        mixed = [s.mixed * sign for s, sign in zip(symbols, signs, strict=True)]
        slopes = [_mean_slope(symbols, k) for k in range(len(symbols))]
        centre = rest_curl * reduce(torch.add, [g**2 for g in slopes]) if _is_there(rest_curl) else 0.0
        diagonal = []
        for k, own in enumerate(symbols):
            others = reduce(torch.add, [own.mixed**2] + [s.stiffness for a, s in enumerate(symbols) if a != k])
            diagonal.append(_held(curl * others + div * own.rest + centre + weights.zero, weights, symbols))
        self.mass = 1 / reduce(torch.mul, [s.mass for s in symbols])
        self.inverse = torch.cat([1 / d for d in diagonal], dim=1)
        self.updates: list[tuple[list[Tensor], list[Tensor], Tensor]] = []
        self._update(mixed, div - curl)
        if _is_there(rest_div - rest_curl):
            means = [_where_waves(g * sign, kinds[k]) for k, (g, sign) in enumerate(zip(slopes, signs, strict=True))]
            self._update(means, rest_div - rest_curl)

    def _update(self, along: list[Tensor], delta: Tensor | float) -> None:
        """Add δ t tᵀ, t being ``along`` the components."""
        whole = torch.broadcast_tensors(self.inverse[:, :1], *along)[1:]  # `broadcast_shapes` would import sympy
        solved = self._solve(torch.cat(whole, dim=1))
        columns = [solved[:, k : k + 1] for k in range(len(along))]
        gain = delta / (1 + delta * reduce(torch.add, [t * h for t, h in zip(along, columns, strict=True)]))
        self.updates.append((along, columns, gain))

    def _solve(self, modes: Tensor) -> Tensor:
        modes = _scale(modes, self.inverse)
        for along, columns, gain in self.updates:
            # B⁻¹ b = y − h γ (t·y) with y = A⁻¹ b of the updates before.
            size = gain * reduce(torch.add, [t * modes[:, k : k + 1] for k, t in enumerate(along)])
            for k, column in enumerate(columns):
                modes[:, k : k + 1].addcmul_(size, column, value=-1.0)
        return modes

    def divide(self, modes: Tensor, power: int) -> Tensor:
        modes = _scale(modes, self.mass)
        for _ in range(power):
            modes = self._solve(modes)
        return modes


def _mean_slope(symbols: list[_Symbols], k: int) -> Tensor:
    """Return √(λ_k Π_{a≠k} μ̄_a/μ_a), the derivative along k as the centres see it."""
    return reduce(torch.mul, [s.stiffness if a == k else s.mean for a, s in enumerate(symbols)]).sqrt()


def _where_waves(slope: Tensor, kinds: tuple[Kind, ...]) -> Tensor:
    """Return the slope with 0 at the frequencies at which sines vanish."""
    for axis, kind in enumerate(kinds, start=2):
        if kind == "sine":
            slope = slope.index_fill(axis, torch.tensor([0, slope.shape[axis] - 1], device=slope.device), 0.0)
    return slope


def _is_there(weight: Tensor | float) -> bool:
    return isinstance(weight, Tensor) or weight != 0


def _held(divisor: Tensor, weights: Weights, symbols: list[_Symbols]) -> Tensor:
    """Treat the constant mode as the next one where nothing (to speak of) holds it: a preconditioner may meet it."""
    lowest = (weights.div + weights.curl) / 2 * min(s.lowest for s in symbols)
    return torch.where(divisor > lowest * torch.finfo(divisor.dtype).eps ** 2, divisor, lowest)


def _scale(modes: Tensor, factor: Tensor) -> Tensor:
    """Return modes · factor, in the memory of ``modes`` where it fits and autograd does not need it any more."""
    if not numbers_are_real() or factor.requires_grad or factor.shape[0] > modes.shape[0]:
        return modes * factor
    return modes.mul_(factor)
