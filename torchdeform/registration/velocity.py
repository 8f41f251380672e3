"""From a force to a velocity: the least-squares metric of a level, and how far its flow goes in one step."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchdeform.core.derivatives import derivative, slab_of
from torchdeform.core.grid import Grid, per_item
from torchdeform.fem.solver import SolverSettings, solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.metrics.correlation import window_mean
from torchdeform.registration.settings import MetricSettings, OptimiserSettings
from torchdeform.registration.tissue import Tissue
from torchdeform.solvers.base import Factor

# The step falls to this share of itself over a level.
LAST_STEP = 0.1

# To this share of the load the least squares are solved where tissue varies.
_RTOL = 0.1

# Weight of the divergence that opens up nearly folded places, against a force of 1 at its strongest.
_BARRIER_WEIGHT = 3.0

# Width in nodes of the windows in which the strength of a force is taken.
_AROUND = 9


def _alone(sizes: Tensor) -> Tensor:
    return sizes


@dataclass(frozen=True)
class VelocityMetric:
    """The div-curl least squares as a metric: K v = load, w_zero = w_div / length².

    Attributes:
        factor: the solver made ready for K on the grid of the map.
        system: its loads, with the weights of what no tissue is named for.
        order: power of the metric, see `Factor`.
    """

    factor: Factor
    system: DivCurlSystem
    order: int = 1

    @classmethod
    def of(
        cls,
        grid: Grid,
        settings: MetricSettings,
        solver: SolverSettings,
        like: Tensor,
        below: int = 0,
        tissue: Tissue | None = None,
    ) -> "VelocityMetric":
        """Return the metric of a level's grid that has so many finer levels below it, dearer where tissue says so."""
        length = settings.length_at(below) * grid.cell_volume ** (1 / grid.dim)
        weights = Weights(settings.weight_div, settings.weight_curl, settings.weight_div / length**2)
        if tissue is None:
            return cls.of_weights(grid, weights, solver, like, settings.order)
        if solver.rtol is None:  # a direction is wanted, not a solution
            solver = replace(solver, rtol=_RTOL)
        system = DivCurlSystem(grid, tissue.weights(weights), "slip")
        return cls(solver_of(solver, system).init(system, like), replace(system, weights=weights), settings.order)

    @classmethod
    def of_weights(
        cls, grid: Grid, weights: Weights, solver: SolverSettings, like: Tensor, order: int = 1
    ) -> "VelocityMetric":
        """Return the metric with these weights; nothing flows out of the box."""
        system = DivCurlSystem(grid, weights, "slip")
        return cls(solver_of(solver, system).init(system, like), system, order)

    @property
    def grid(self) -> Grid:
        """The grid of velocities."""
        return self.system.grid

    def velocity(self, force: Tensor, div: Tensor | None = None, near: Tensor | None = None) -> Tensor:
        """Return v with K v = load of a force density ``(B, D, *S)`` and of a divergence ``(B, 1, *S)``.

        Where tissue varies it is found from a velocity that is ``near``, to a share of the load.
        """
        load = self.system.load(div=div, force=force)
        if near is None or self.order > 1:
            return self.factor(load, power=self.order)
        return self.factor.solution(load, near).value

    def ascent(
        self,
        force: Tensor,
        barrier: Tensor | None = None,
        points: Tensor | None = None,
        together: Callable[[Tensor], Tensor] = _alone,
        near: Tensor | None = None,
    ) -> Tensor:
        """Return the velocity of steepest ascent, of any length.

        Args:
            force: force density of the images ``(B, D, *S)``, in any unit; it is scaled to 1 at its strongest.
            barrier: divergence asked for ``(B, 1, *S)`` where the map is nearly folded, see `fold_barrier`, times the
                length of a voxel, so that it weighs the same in any unit.
            points: load of the landmarks ``(B, D, *S)``, in the unit of the force.
            near: a velocity to begin with, see `velocity`.
            together: of sizes ``(B,)``, the largest of those that are scaled together.

        Notes:
            The load of points is smoothed by one power more, w_0 (M⁻¹K)⁻¹, which keeps its sum: what least squares
            alone answer to a point, a logarithm in 2D and 1/r in 3D, has a peak there.
        """
        strongest = max_norm(force) if points is None else max_norm(force).maximum(max_norm(points))
        scale = 1 / together(strongest).clamp(min=torch.finfo(force.dtype).tiny)
        weights = self.system.weights
        div = None if barrier is None else barrier * (_BARRIER_WEIGHT / weights.div)
        v = self.velocity(force * per_item(scale, force), div, near)
        if points is not None:
            load = points * per_item(scale * (self.grid.cell_volume * weights.zero), points)
            v = v + self.factor(load, power=self.order + 1)
        return v


def image_force(slope: Tensor, warped: Tensor, grid: Grid, by: str = "auto", rows: slice | None = None) -> Tensor:
    """Return the force Σ_c slope_c ∇warped_c ``(B, D, *S)`` from N ∂S/∂warped and the warped image ``(B, C, *S)``.

    Or some rows of its first axis.
    """
    rows = rows or slice(0, grid.shape[0])
    slopes = (slab_of(partial(derivative, axis=a, by=by), warped, grid, rows) for a in range(grid.dim))
    return torch.cat([(slope[:, :, rows] * along).sum(1, keepdim=True) for along in slopes], dim=1)


def fold_barrier(lowest: Tensor, soft_determinant: float) -> Tensor:
    """Return the divergence soft/J − 1 that opens a map up where its smallest determinant J ``(B, 1, *S)`` is below."""
    return (soft_determinant / lowest - 1).clamp_(min=0)


def normalise_step(v: Tensor, grid: Grid, together: Callable[[Tensor], Tensor] = _alone) -> Tensor:
    """Return the velocity ``(B, D, *S)`` on the scale on which its longest move is one voxel; 0 stays 0."""
    longest = together(max_norm(v / grid.along(grid.spacing, v)))
    return v / per_item(longest.clamp(min=torch.finfo(v.dtype).tiny), v)


def limited_step(v: Tensor, grid: Grid, limit: float, together: Callable[[Tensor], Tensor] = _alone) -> Tensor:
    """Return the velocity ``(B, D, *S)`` scaled so that ``limit`` typical moves are one voxel, longer ones cut to that.

    The longest move of all is often that of a few nodes, many times as long as others; a step that is a multiple of
    the velocity would leave all the others nearly where they are.
    """
    moves = _sizes(v / grid.along(grid.spacing, v))
    longest = together((limit * _typical(moves)).clamp(min=torch.finfo(v.dtype).tiny))
    return v / moves.maximum(per_item(longest, v))


def evened(force: Tensor, share: float) -> Tensor:
    """Return the force ``(B, D, *S)`` divided by its strength in the window around each node.

    Strength r is the root mean square in the window, R the `_typical` one: the factor is (1 + share) R / (r + share R),
    1 where the strength is the typical one. The direction stays, so a step still leads uphill at every node.
    """
    sizes = _sizes(force)
    around, typical = window_mean(sizes.square(), _AROUND).sqrt(), per_item(_typical(sizes), sizes)
    least = torch.finfo(force.dtype).tiny
    return force * ((1 + share) * typical / (around + share * typical).clamp(min=least))


def _sizes(field: Tensor) -> Tensor:
    """Return |field| at each node ``(B, 1, *S)``; no number is so small that its gradient is not one, 0 included."""
    return field.square().sum(1, keepdim=True).clamp(min=torch.finfo(field.dtype).tiny).sqrt()


def _typical(sizes: Tensor) -> Tensor:
    """Return √(Σ s⁴ / Σ s²) of the sizes ``(B, 1, *S)`` of each item ``(B,)``: what is 0 does not count."""
    square = (sizes / per_item(sizes.flatten(1).amax(1).clamp(min=torch.finfo(sizes.dtype).tiny), sizes)).square()
    square = square.flatten(1)
    share = square.square().sum(1) / square.sum(1).clamp(min=torch.finfo(sizes.dtype).tiny)
    return share.sqrt() * sizes.flatten(1).amax(1)


def max_norm(field: Tensor) -> Tensor:
    """Return the largest |field| of each item ``(B,)``."""
    return _sizes(field).flatten(1).amax(1)


def step_size(settings: OptimiserSettings, step: int, steps: int) -> float:
    """Return the longest move in voxels in this step of so many, from 0."""
    return settings.step_length * (1 - (1 - LAST_STEP) * step / max(steps, 1))
