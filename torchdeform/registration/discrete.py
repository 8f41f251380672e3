"""A start for large motion: every displacement within reach is tried at every control point, then made one flow."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.flow import OdeSolver, flow
from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import hat_average, prolong, pyramid_grids, restrict
from torchdeform.core.warp import compose, warp
from torchdeform.errors import InputError
from torchdeform.fem.solver import SolverSettings
from torchdeform.fem.weights import Weights
from torchdeform.registration.matching import (
    CHUNK,
    SMALLEST_SCALE,
    couple,
    displacements,
    features_of,
    gaussian,
    items_of,
    require_pair,
)
from torchdeform.registration.settings import DiscreteSettings
from torchdeform.registration.velocity import VelocityMetric

# Rounds in which the two directions are made inverse to each other, and in which a velocity is fitted to matches.
_ROUNDS = 15
_FITS = 5

# How the flow that is fitted is integrated.
_FLOW = OdeSolver(method="midpoint", steps=6)

# Control points of smaller weight follow their neighbours.
_SMALLEST_WEIGHT = 0.01

# Entries of the cost volume at most (2 GiB in float32).
_LARGEST_VOLUME = 2**29


@torch.no_grad()
def discrete_start(
    fixed: Tensor, moving: Tensor, grid: Grid, *, mask: Tensor | None = None, settings: DiscreteSettings | None = None
) -> Tensor:
    """Return a smooth u without folds that nearly minimises Σ_x mask |MIND(fixed)(x) − MIND(moving)(x + u(x))|².

    Args:
        fixed: image that stays ``(B, C, *S)``.
        moving: image that is warped, the same shape, already aligned to the fixed grid.
        grid: the grid of both.
        mask: weight of each voxel of the fixed image ``(B or 1, 1, *S)``, 0 to 1; all ones when None.
        settings: `DiscreteSettings` with its defaults when None.

    Returns:
        u ``(B, D, *S)`` in units of spacing, its one-sided determinants at least ``min_determinant`` wherever smoothing
        achieves that, positive in any case: the ``start`` of `register`.

    Raises:
        InputError: shapes, values that are not finite, or a search so wide that its
            costs exceed 2^29 numbers.

    Notes:
        On each level C(x, d), the squared difference of the features averaged around control point x, is computed for
        all displacements d within reach. Then d(x) = argmin_d C(x, d) + α |d − s(x)|² and s = smooth(d) in turn, α
        rising (Steinbrücker, Pock & Cremers, "Large displacement optical flow computation without warping", ICCV 2009;
        with MIND features Siebert, Hansen & Heinrich, "Fast 3D registration with accurate optimisation and little
        learning for Learn2Reg 2021"). Matches s become φ = flow(v), with v ← v + (div-curl metric)⁻¹(s − u). Memory:
        the costs, control points × displacements, and 2 K channels of features; items are done one by one. Not
        differentiable. The intensities do not matter, the contrast may differ. Motion within reach that the coarsest
        level of `register` would find by itself gains nothing.
    """
    require_pair(fixed, moving, {"mask": mask}, grid, "discrete_start")
    settings = settings or DiscreteSettings()
    items = zip(fixed.split(1), moving.split(1), items_of(mask, fixed), strict=True)
    return torch.cat([_start(*item, grid, settings) for item in items])


def _start(fixed: Tensor, moving: Tensor, mask: Tensor | None, grid: Grid, settings: DiscreteSettings) -> Tensor:
    """Search on every level for one item."""
    u = fixed.new_zeros(1, grid.dim, *grid.shape)
    for level, reach in zip(settings.levels, settings.reach, strict=True):
        search = _make_search(grid, level, reach, settings)
        warped = warp(moving, u, grid)
        matches = _match(search, fixed, warped, mask)
        if settings.symmetric:
            matches = _agreed(matches, _match(search, warped, fixed, mask), search.control)
        u = restrict(u, grid, search.features)
        u = _fit_flow(compose(u, prolong(matches, search.features), search.features), search)
        u = repair_folds(prolong(u, grid), grid, settings.min_determinant)
    return u


@dataclass(frozen=True)
class _Search:
    """What stays the same during the search on one level.

    Attributes:
        images: grid of the images.
        source: grid on which MIND is computed, that of the finest search: averages keep what is thin.
        features: grid on which its averages are compared; one of its spacings is one step of a displacement.
        control: grid of the control points.
        reach: steps along each axis.
        settings: the settings.
    """

    images: Grid
    source: Grid
    features: Grid
    control: Grid
    reach: tuple[int, ...]
    settings: DiscreteSettings


def _make_search(grid: Grid, level: int, reach: float, settings: DiscreteSettings) -> _Search:
    source, features = (pyramid_grids(grid, index + 1)[0] for index in (settings.levels[-1], level))
    control = grid.with_shape([min(n, max(3, round((n - 1) / settings.spacing) + 1)) for n in features.shape])
    steps = tuple(max(1, round(reach * min(grid.spacing) / h)) for h in features.spacing)
    entries = math.prod(2 * r + 1 for r in steps) * math.prod(control.shape)
    if entries > _LARGEST_VOLUME:
        raise InputError(
            f"discrete_start: a reach of {reach:g} voxels on level {level} needs {entries:.1e} costs; "
            f"lower reach, or search on a coarser level first, as levels {(level + 1, *settings.levels)}"
        )
    return _Search(grid, source, features, control, steps, settings)


def _match(search: _Search, fixed: Tensor, moving: Tensor, mask: Tensor | None) -> Tensor:
    """Return the smooth field of displacements ``(1, D, *control)`` in units of spacing that matches two images."""
    weight = fixed.new_ones(1, 1, *search.images.shape) if mask is None else mask
    weight = hat_average(weight, search.features)
    cost = _cost_volume(_features(search, fixed), _features(search, moving), weight, search)
    return _couple(cost, hat_average(weight, search.control).clamp(min=_SMALLEST_WEIGHT), search)


def _features(search: _Search, image: Tensor) -> Tensor:
    return features_of(image, search.images, search.source, search.features)


def _cost_volume(fixed: Tensor, moving: Tensor, weight: Tensor, search: _Search) -> Tensor:
    """Return C ``(L, N)`` at the N control points, in standard deviations over the displacements."""
    labels = displacements(search.reach, fixed).long().tolist()
    padded = F.pad(moving, [r for r in reversed(search.reach) for _ in range(2)], mode="replicate")
    cost, buffer = fixed.new_empty(len(labels), math.prod(search.control.shape)), torch.empty_like(fixed)
    chunk = max(1, CHUNK // math.prod(search.features.shape))
    for start in range(0, len(labels), chunk):
        part = fixed.new_empty(1, min(chunk, len(labels) - start), *search.features.shape)
        for row, label in zip(part[0], labels[start : start + chunk], strict=True):
            torch.sub(fixed, _shifted(padded, label, search), out=buffer)
            torch.sum(buffer.square_()[0], 0, out=row)
        cost[start : start + chunk] = hat_average(part.mul_(weight), search.control)[0].flatten(1)
    scale = cost.std(dim=0).sum() / hat_average(weight, search.control).sum()
    return cost.div_(scale.clamp(min=SMALLEST_SCALE))


def _shifted(padded: Tensor, label: list[int], search: _Search) -> Tensor:
    """Return the features at x + label, from those that were padded by the reach."""
    for axis, (step, reach, n) in enumerate(zip(label, search.reach, search.features.shape, strict=True), start=2):
        padded = padded.narrow(axis, reach + step, n)
    return padded


def _couple(cost: Tensor, weight: Tensor, search: _Search) -> Tensor:
    """Return the smooth field that costs least, in units of spacing."""
    settings, shape = search.settings, (1, -1, *search.control.shape)
    total = gaussian(weight, settings.smoothing).clamp(min=_SMALLEST_WEIGHT)

    def smoothed(d: Tensor) -> Tensor:
        return (gaussian(weight * d.reshape(shape), settings.smoothing) / total).flatten(2)[0]

    labels = displacements(search.reach, cost)
    start = cost.new_zeros(labels.shape[1], cost.shape[1])
    s = couple(cost, labels, smoothed, settings.coupling, start)[1].reshape(shape)
    return s * search.features.along(search.features.spacing, s)


def _agreed(forward: Tensor, backward: Tensor, grid: Grid) -> Tensor:
    """Return the forward displacement after both have been moved towards the inverse of each other."""
    for _ in range(_ROUNDS):
        forward, backward = (
            0.5 * (forward - warp(backward, forward, grid)),
            0.5 * (backward - warp(forward, backward, grid)),
        )
    return forward


def _fit_flow(target: Tensor, search: _Search) -> Tensor:
    """Return u of a flow near ``target``, both on the grid of the features: v ← v + (1 + length² Δ)⁻¹(target − u)."""
    grid = search.features
    square = (search.settings.length_scale * search.control.cell_volume ** (1 / grid.dim)) ** 2
    metric = VelocityMetric.of_weights(grid, Weights(div=square, curl=square, zero=1.0), SolverSettings(), target)
    v = u = torch.zeros_like(target)
    for _ in range(_FITS):
        v = v + metric.velocity(target - u)
        u = flow(v, grid, _FLOW)
    return u
