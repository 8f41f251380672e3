"""Regions that grow or shrink by given factors: a simulator of atrophy and growth, and the volumes of moved regions."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.derivatives import determinant
from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.flow import OdeSolver, integrate_points
from torchdeform.core.grid import Grid
from torchdeform.core.warp import sample
from torchdeform.deformation.monitors import mean_value, require_factors, require_rest, require_same_volume, smooth
from torchdeform.deformation.versions import grid_from_initial_monitor
from torchdeform.errors import ComputationError, InputError
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.fem.solver import SolverSettings, solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Solution, Status
from torchdeform.solvers.cg import dots

# Next to what must not move no velocity has both the divergence and the curl that are asked for: volumes come first.
_AROUND_RIGID = Weights(div=10.0, curl=1.0)
_FLOW = OdeSolver(steps=20)

# A smoothed region is multiplied by the first before it is cut off at 1: a flat rim then lies where J begins to fall.
# At nodes of the rest no more than the second goes to regions, so that the rest is never without a say.
_WIDENING, _MOST_OF_REST = 3.0, 0.9


@dataclass(frozen=True)
class VolumeChange(Solution):
    """A map that changes the volumes of regions.

    Attributes:
        value: displacement u ``(B, D, *S)`` in units of spacing; φ = id + u takes each region to its changed shape.
        status: ``CONVERGED`` where all volumes are as asked for.
        steps: maps made until then, ``(B,)``.
        residual: the largest abs(volume / volume asked for − 1), ``(B,)``.
        factors: volume of φ(R) over volume of R by label, each ``(B,)``.
        smallest: the smallest one-sided determinant of φ, ``(B,)``; positive certifies a digital diffeomorphism.
    """

    factors: dict[int, Tensor]
    smallest: Tensor


def simulate_volume_change(
    labels: Tensor,
    factors: Mapping[int, float],
    grid: Grid,
    *,
    rigid_mask: Tensor | None = None,
    smoothing: float | None = None,
    rtol: float = 5e-4,
    max_steps: int = 20,
) -> VolumeChange:
    """Return u of a smooth map φ = id + u of Ω onto itself with volume(φ(R)) = factor · volume(R) for each region R.

    Args:
        labels: label of each node, ``(B, 1, *S)``, whole numbers of any type.
        factors: new volume over old volume by label, positive. Nodes with other labels take up the slack; where there
            are none the factors must keep the volume of Ω, and the last region gets what the others leave of it.
        grid: the grid.
        rigid_mask: ``(B or 1, 1, *S)``, True at nodes that must not move at all.
        smoothing: standard deviation of the Gaussian that smooths the borders of regions, in units of spacing; by
            default the largest spacing.
        rtol: stops when every volume is within this share of what was asked for.
        max_steps: maps made at most.

    Returns:
        `VolumeChange`, float64 if the labels are, else float32. A picture of the changed anatomy is the old one pulled
        back by the inverse, ``warp(image, invert(u, grid), grid)``.

    Raises:
        InputError: shapes, factors, tolerances, a label that does not occur or lies in the rigid mask, or factors that
            leave the rest no volume or, where labels fill Ω, do not keep its volume.
        ComputationError: the map for a monitor could not be computed, or folds next to the rigid mask.

    Notes:
        The volume of a region is that of its nodes, see `nodal_volumes`. Version 1 of the deformation method with
        log f = Σ a_R χ_R, χ_R the region with a smooth border, the rest of Ω among them, and the a_R corrected until
        the volumes measured are right: 2 to 5 maps. Within a region volume changes evenly, J = f = factor, except where
        it touches a region with another factor. Where something is rigid, volumes come before evenness: the
        velocity is the least-squares solution that vanishes there. Not differentiable.
    """
    smoothing = max(grid.spacing) if smoothing is None else smoothing
    if not (math.isfinite(rtol) and rtol > 0) or max_steps < 1:
        raise InputError("simulate_volume_change: rtol must be positive and max_steps at least 1")
    with torch.no_grad():
        return _Regions(labels, factors, grid, rigid_mask, smoothing).find_map(rtol, max_steps)


def nodal_volumes(u: Tensor, grid: Grid) -> Tensor:
    """Return the volume of φ(cell of x) of each node x under φ = id + u, interpolated linearly on simplices.

    The cells of the grid are cut into triangles or tetrahedra in two ways that mirror each other; each node gets the
    (D + 1)-th part of every simplex it belongs to (the piece nearest to it, in barycentric coordinates), on average
    over both ways. A linear map takes pieces of simplices to pieces of the same share, so this is exact.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.

    Returns:
        ``(B, 1, *S)`` in units of spacing to the power D: for u = 0 the weights of `Grid.quadrature`, in sum the volume
        of φ(Ω).

    Raises:
        InputError: shape.

    Notes:
        Folded simplices count as negative. Differentiable.
    """
    grid.check_vector(u, "nodal_volumes: u")
    points = grid.points(dtype=u.dtype, device=u.device) + u
    total = u.new_zeros(u.shape[0], 1, *grid.shape)
    for simplex in _simplices(grid.dim):
        first, *others = (_corner(points, corner) for corner in simplex)
        share = determinant(torch.stack([other - first for other in others], dim=1)) * _part(simplex)
        for corner in simplex:
            _corner(total, corner).add_(share)
    return total


# The simplices of a cell by their corners: one at each corner, spanned by its edges; in 3D also the two inner ones.
_Simplex = tuple[tuple[int, ...], ...]


def _simplices(dim: int) -> list[_Simplex]:
    corners: list[tuple[int, ...]] = list(product((0, 1), repeat=dim))
    at_corners: list[_Simplex] = [
        (corner, *(tuple(c ^ (a == axis) for a, c in enumerate(corner)) for axis in range(dim))) for corner in corners
    ]
    inner: list[_Simplex] = [tuple(c for c in corners if sum(c) % 2 == odd) for odd in (0, 1)]
    return at_corners + [simplex for simplex in inner if len(simplex) == dim + 1]


def _part(simplex: _Simplex) -> float:
    """Return what makes the share of one node of the determinant of a simplex's edges, for one of two ways to cut."""
    first, *others = (torch.tensor(corner, dtype=torch.float64, device="cpu") for corner in simplex)
    orientation = determinant(torch.stack([other - first for other in others]).unsqueeze(0)).sign().item()
    return orientation / (math.factorial(len(simplex)) * 2)


def _corner(field: Tensor, corner: tuple[int, ...]) -> Tensor:
    """Return the values of ``field (B, C, *S)`` at one corner of every cell, as a view."""
    for axis, side in enumerate(corner, start=2):
        field = field.narrow(axis, side, field.shape[axis] - 1)
    return field


class _Regions:
    """The regions of all items, the rest of Ω as the last one; ``wanted`` holds what volume each is to have."""

    def __init__(
        self, labels: Tensor, factors: Mapping[int, float], grid: Grid, rigid: Tensor | None, smoothing: float
    ) -> None:
        like = labels if labels.dtype == torch.float64 else labels.to(torch.float32)
        grid.check_scalar(like, "simulate_volume_change: labels")
        self.grid, self.names, self.rigid = grid, list(factors), _checked_mask(rigid, labels, grid)
        self.inside = _indicators(labels, factors, self.rigid).to(like.dtype)
        wanted = list(factors.values())
        if not bool(self.inside[:, -1].any()):  # no rest, so the last region is what the others leave
            require_same_volume(self.inside[:, :-1], wanted, grid, "simulate_volume_change")
            self.inside, wanted = self.inside[:, :-1], wanted[:-1]
        self.smoothed = _shares(self.inside, grid, smoothing)
        self.before = self._sums(grid.quadrature(dtype=like.dtype, device=like.device))
        self.wanted = self._with_rest(self.before * like.new_tensor([*wanted, 1.0]), self.before.sum(1))
        require_rest(self.before[:, -1], self.wanted[:, -1], "simulate_volume_change")

    def find_map(self, rtol: float, max_steps: int) -> VolumeChange:
        """Correct the amplitudes until the volumes are right."""
        amplitudes = torch.log(self.wanted / self.before)
        influence = self._influence()
        steps = torch.zeros(len(amplitudes), dtype=torch.int64, device=amplitudes.device)
        open_ = torch.ones_like(steps, dtype=torch.bool)
        while True:
            u = self._map(amplitudes)
            steps += open_
            volumes = self._sums(nodal_volumes(u, self.grid))
            wanted = self._with_rest(self.wanted, volumes.sum(1))
            off = (volumes / wanted - 1)[:, : len(self.names)].abs().amax(1)
            open_ = off > rtol
            if not bool((open_ & (steps < max_steps)).any()):
                return self._report(u, volumes, off, steps, open_)
            correction = torch.linalg.solve(influence, torch.log(wanted / volumes))
            amplitudes = torch.where(open_.view(-1, 1), amplitudes + correction, amplitudes)

    def _report(self, u: Tensor, volumes: Tensor, off: Tensor, steps: Tensor, open_: Tensor) -> VolumeChange:
        reached, smallest = (volumes / self.before).unbind(1), smallest_determinant(u, self.grid)
        if not bool((smallest > 0).all()):
            raise ComputationError(
                "simulate_volume_change: the map folds around rigid_mask; ask for less next to it, or raise smoothing"
            )
        return VolumeChange(
            value=u,
            status=tuple(Status.MAX_STEPS if missed else Status.CONVERGED for missed in open_.tolist()),
            steps=steps,
            residual=off,
            factors=dict(zip(self.names, reached, strict=False)),
            smallest=smallest,
        )

    def _sums(self, field: Tensor) -> Tensor:
        """Return the sum of a field over each region, ``(B, R)``."""
        field = field.expand(self.inside.shape[0], -1, *self.grid.shape)
        return torch.stack([dots(region, field[:, 0]) for region in self.inside.unbind(1)], dim=1)

    def _with_rest(self, volumes: Tensor, total: Tensor) -> Tensor:
        """Return volumes ``(B, R)`` with the last one replaced by what the others leave of the total."""
        return torch.cat([volumes[:, :-1], total.view(-1, 1) - volumes[:, :-1].sum(1, keepdim=True)], dim=1)

    def _influence(self) -> Tensor:
        """Return d log(volume of R)/d a_S, the mean of the smoothed S over R, ``(B, R, S)``."""
        weights = self.grid.quadrature(dtype=self.inside.dtype, device=self.inside.device)
        columns = [self._sums(region.unsqueeze(1) * weights) for region in self.smoothed.unbind(1)]
        return torch.stack(columns, dim=2) / self.before.unsqueeze(2)

    def _map(self, amplitudes: Tensor) -> Tensor:
        """Return the displacement for log f = Σ a χ."""
        f = torch.einsum("br,br...->b...", amplitudes, self.smoothed).unsqueeze(1).exp()
        if self.rigid is None:
            return grid_from_initial_monitor(f, self.grid)
        free = (~self.rigid).to(f.dtype)
        f = torch.where(self.rigid, 1.0, f * (mean_value(free, self.grid) / mean_value(f * free, self.grid)))
        return _flow_around(f, self.rigid, self.grid)


def _indicators(labels: Tensor, factors: Mapping[int, float], rigid: Tensor | None) -> Tensor:
    """Return the mask of each region, ``(B, R, *S)``, the last one the rest."""
    where = "simulate_volume_change"
    require_factors(factors, where)
    inside = torch.cat([labels == label for label in factors], dim=1)
    rigid = torch.zeros_like(inside[:, :1]) if rigid is None else rigid
    for label, region in zip(factors, inside.split(1, dim=1), strict=True):
        if not bool(region.flatten(1).any(1).all()):
            raise InputError(f"{where}: label {label} does not occur; name labels that the image has")
        if bool((region & rigid).any()):
            raise InputError(f"{where}: label {label} lies in rigid_mask; what is rigid keeps its volume")
    return torch.cat([inside, ~(inside.any(dim=1, keepdim=True) | rigid)], dim=1)


def _shares(inside: Tensor, grid: Grid, smoothing: float) -> Tensor:
    """Return how much of each node's log J is that of each region, in sum 1: ``(B, R, *S)``, the last one the rest.

    A smoothed region is widened before it counts as a share, so that J is even up to the rim of a region and falls off
    outside, in the rest of Ω; regions that touch share the nodes between them.
    """
    if inside.shape[1] == 1:
        return torch.ones_like(inside)
    labelled = (_WIDENING * smooth(inside[:, :-1], grid, smoothing)).clamp(max=1)
    most = torch.where(inside[:, -1:] > 0, _MOST_OF_REST, inside.new_ones(()))
    total = labelled.sum(dim=1, keepdim=True)
    labelled = labelled * (most / torch.maximum(total, most))
    return torch.cat([labelled, 1 - labelled.sum(dim=1, keepdim=True)], dim=1)


def _checked_mask(rigid: Tensor | None, labels: Tensor, grid: Grid) -> Tensor | None:
    """Return the mask with the batch size of the labels."""
    if rigid is None:
        return None
    if rigid.dtype != torch.bool:
        raise InputError(f"simulate_volume_change: rigid_mask must be a mask of bool, got {rigid.dtype}")
    grid.check_scalar(rigid.float(), "simulate_volume_change: rigid_mask")
    return rigid.expand(labels.shape[0], -1, *grid.shape)


def _flow_around(f: Tensor, rigid: Tensor, grid: Grid) -> Tensor:
    """Return u of Version 1 with a velocity that vanishes at the nodes of a mask: J is near f, but not equal.

    Liu, Liao & Xue 2007, eq. (2.3).
    """
    fixed = fixed_unknowns("slip", grid, f.device) | rigid
    v = _velocity_around(f - 1, fixed, grid)
    fields = torch.cat([v, f], dim=1)

    def rate(t: Tensor, points: Tensor) -> Tensor:
        values = sample(fields, points, grid)
        return (values[:, :-1] / (t + (1 - t) * values[:, -1:])).masked_fill(fixed, 0)

    nodes = grid.points(dtype=f.dtype, device=f.device)
    moved = integrate_points(rate, nodes.expand_as(v), (0.0, 1.0), grid, _FLOW)
    return (moved[-1] - nodes).masked_fill(fixed, 0)


def _velocity_around(div: Tensor, fixed: Tensor, grid: Grid) -> Tensor:
    """Return v, zero where ``fixed (B, D, *S)``, that minimises ∫ w_div (div v − α)² + w_curl |curl v|²."""
    system = DivCurlSystem(grid, _AROUND_RIGID, "slip", fixed)
    solver = solver_of(SolverSettings(rtol=1e-4), system).init(system, div)
    solution = solver.solution(system.load(div=div))
    if not solution.ok:
        reason = next(status.value for status in solution.status if not status.ok)
        raise ComputationError(f"simulate_volume_change: no velocity around the rigid mask: {reason}")
    return solution.value
