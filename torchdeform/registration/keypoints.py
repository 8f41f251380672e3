"""A start for large motion from few points: corners of one image are found in the other, and joined by a map."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.derivatives import cofactors, derivative, determinant
from torchdeform.core.flow import OdeSolver, flow
from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid, largest, per_item
from torchdeform.core.resampling import MAX_POOL, hat_average, prolong, pyramid_grids, restrict, with_nodes
from torchdeform.core.warp import compose, sample
from torchdeform.fem.solver import SolverSettings
from torchdeform.fem.weights import Weights
from torchdeform.registration.landmarks import scatter_points
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
from torchdeform.registration.problem import thin_axes
from torchdeform.registration.settings import KeypointSettings
from torchdeform.registration.velocity import VelocityMetric
from torchdeform.solvers.cg import conjugate_gradient

# Fewer pairs than this say nothing about a map.
FEWEST = 8

# Corners weaker than this share of the strongest edge are noise; what is flat, by the square of that, has none.
_WEAKEST, _FLAT = 1e-5, 1e-12

# An edge that is weaker than so many of the smallest steps of a type at an image's brightest is one of its rounding.
_ROUNDING = 2**10

# A level that is searched has so many nodes along its longest axis.
_LONGEST = 32

# Nothing is looked for farther away than a side of the box divided by this.
_SIDE = 3

# An image is moved as a whole where its points have moved by more voxels than this.
_FAR = 8.0

# A point listens to so many times as many others as lie within the standard deviation of its Gaussian.
_HEARD = 8

# What a slope of the motion costs against a mean, in the plane that is fitted to the neighbours.
_RIDGE = 0.1

# Nodes of the grid on which the map is fitted, rounds of it, and how it is integrated. In the first rounds a pair has
# little weight against the others (the first slack λ), and those that are still apart then are left out.
_NODES, _ROUNDS, _TRUST = 2**16, 6, 3
_FLOW = OdeSolver(method="midpoint", steps=8)
_SLACK, _TOLERANCE, _STEPS = (0.5, 0.05), 0.05, 60


@dataclass(frozen=True)
class Keypoints:
    """Pairs of points of one fixed and one moving image that look alike.

    Attributes:
        fixed: ``(D, n)`` in units of spacing, node 0 at the origin.
        moving: likewise.
        looked_for: how many corners of the fixed image there were.
    """

    fixed: Tensor
    moving: Tensor
    looked_for: int

    @property
    def count(self) -> int:
        """How many pairs there are."""
        return self.fixed.shape[1]

    @property
    def enough(self) -> bool:
        """Whether they say anything about a map."""
        return self.count >= FEWEST

    def where(self, kept: Tensor | slice) -> "Keypoints":
        """Return the pairs that are kept, flags ``(n,)`` or a slice."""
        return Keypoints(self.fixed[:, kept], self.moving[:, kept], self.looked_for)


def anchors_of(points: Sequence[Keypoints], like: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return the pairs of all items ``(B, D, n)`` twice and how much each counts ``(B, 1, n)``, None where none does.

    Items with fewer pairs than others are filled up with some that do not count, and the others count the more.
    """
    most = max((one.count for one in points if one.enough), default=0)
    if most == 0:
        return None
    counts = [one.count if one.enough else 0 for one in points]
    sides = [one.fixed for one in points], [one.moving for one in points]
    fixed, moving = (torch.stack([F.pad(s, (0, most - s.shape[1])) for s in side]).to(like) for side in sides)
    counted = [[(most / n) ** 0.5] * n + [0.0] * (most - n) if n else [0.0] * most for n in counts]
    return fixed, moving, torch.tensor(counted, dtype=like.dtype, device=like.device).unsqueeze(1)


@torch.no_grad()
def keypoint_start(
    fixed: Tensor,
    moving: Tensor,
    grid: Grid,
    *,
    mask: Tensor | None = None,
    moving_mask: Tensor | None = None,
    settings: KeypointSettings | None = None,
) -> tuple[Tensor, tuple[Keypoints, ...]]:
    """Return a smooth u without folds that takes corners of the fixed image to where the moving one looks like them.

    Args:
        fixed: image that stays ``(B, C, *S)``.
        moving: image that is warped, the same shape, on the same grid.
        grid: the grid of both.
        mask: weight of each voxel of the fixed image ``(B or 1, 1, *S)``, 0 to 1; all ones when None. Corners lie where
            it is above 1/2.
        moving_mask: likewise of the moving image, where the matches lie.
        settings: `KeypointSettings` with its defaults when None.

    Returns:
        u ``(B, D, *S)`` in units of spacing, the ``start`` of `register`, and the pairs of each item. Where those are
        fewer than 8, as without texture, u is 0.

    Raises:
        InputError: shapes, or values that are not finite.

    Notes:
        Corners are the local maxima of 1 / tr A⁻¹, A = G ∗ ∇I ∇Iᵀ (Förstner & Gülch, "A fast operator for detection and
        precise location of distinct points, corners and centres of circular features", 1987). C(p, d), the squared
        difference of the MIND features around p and p + d, is computed for all d within reach. Then d = argmin_d C +
        α |d − s|² and s = the plane through the motion of the neighbours in turn, α rising, on each level around what
        the one before has found: the coupling of `discrete_start` on a graph. A pair stays where the way back, found
        from the match alone, leads to its point (symmetric as in Heinrich, Handels & Simpson, "Estimating large lung
        motion in COPD patients by symmetric regularised correspondence fields", MICCAI 2015). The map is a composition
        of flows of v = G c, the div-curl least squares (twice, which is smooth at points) of loads c at the points,
        with (G + λ) c = what they are apart. Items are done one by one; the order of all sums is fixed. Not
        differentiable.
    """
    require_pair(fixed, moving, {"mask": mask, "moving_mask": moving_mask}, grid, "keypoint_start")
    settings = settings or KeypointSettings()
    masks = items_of(mask, fixed), items_of(moving_mask, moving)
    found = [
        match_keypoints(f, m, grid, mask=of_fixed, moving_mask=of_moving, settings=settings)
        for f, m, of_fixed, of_moving in zip(fixed.split(1), moving.split(1), *masks, strict=True)
    ]
    maps = [map_of(points, grid, settings) for points in found]
    return torch.cat([u for u, _ in maps]), tuple(points for _, points in maps)


def too_few(points: Sequence[Keypoints]) -> tuple[str, ...]:
    """Return a warning about items whose pairs are too few for a map; none where all have enough."""
    poor = [item.count for item in points if not item.enough]
    if not poor:
        return ()
    where = "" if len(points) == 1 else f" in {len(poor)} of {len(points)} items"
    return (
        f"start keypoints found fewer than {FEWEST} pairs of points that agree{where}, so the deformation began with "
        "the identity; where the motion is large, raise keypoints.reach or align the images first",
    )


def common_shift(fixed: Tensor, moving: Tensor, grid: Grid, **given: Any) -> Tensor | None:
    """Return the displacement ``(D,)`` in units of spacing that one item moves by as a whole, None if it is not far.

    Args:
        fixed: image that stays ``(1, C, *S)``.
        moving: the moving image.
        grid: their grid.
        given: as for `match_keypoints`; a quarter of the points will do.
    """
    settings = given.pop("settings")
    some = replace(settings, count=max(FEWEST, settings.count // 4))
    points = match_keypoints(fixed, moving, grid, **given, settings=some)
    if not points.enough:
        return None
    shift = (points.moving - points.fixed).median(dim=1).values
    return shift if float(shift.norm()) > _FAR * min(grid.spacing) else None


def match_keypoints(
    fixed: Tensor,
    moving: Tensor,
    grid: Grid,
    *,
    mask: Tensor | None = None,
    moving_mask: Tensor | None = None,
    settings: KeypointSettings,
) -> Keypoints:
    """Return the pairs of one item on which both directions and the neighbours agree; as `keypoint_start`."""
    finest = _grid_of(grid, settings.levels[-1])
    seen = restrict(fixed, grid, finest)
    points = corners(seen, finest, settings.count, None if mask is None else hat_average(mask, finest))
    if points.shape[1] < FEWEST:
        return Keypoints(points, points, points.shape[1]).where(slice(0))
    images = (fixed, moving)
    d, s = _matched(images, grid, points, settings)
    matches = _inside(points + d, grid)
    back, _ = _matched(images[::-1], grid, matches, settings)
    limit = settings.agreement * min(grid.spacing)
    kept = ((matches + back - points).norm(dim=0) <= limit) & ((d - s).norm(dim=0) <= limit)
    if moving_mask is not None:
        kept &= sample(moving_mask, matches.unsqueeze(0), grid)[0, 0] > 0.5
    return Keypoints(points, matches, points.shape[1]).where(kept)


def _grid_of(grid: Grid, level: int) -> Grid:
    """Return the grid of a level, of a finer one where it would have too few nodes."""
    return next(g for g in pyramid_grids(grid, level + 1) if g == grid or max(g.shape) >= _LONGEST)


def distinctiveness(image: Tensor, grid: Grid, sigma: float = 1.0) -> Tensor:
    """Return 1 / tr A⁻¹ ``(B, 1, *S)``, A = G ∗ Σ_c ∇I_c ∇I_cᵀ over its largest entry: large where all directions vary.

    Args:
        image: ``(B, C, *S)``.
        grid: its grid.
        sigma: standard deviation of the Gaussian G in voxels.

    Notes:
        Axes of a few nodes, along which nothing is moved, do not count where two others are left.
    """
    axes = [a for a in range(grid.dim) if a not in thin_axes(grid)]
    axes = axes if len(axes) > 1 else list(range(grid.dim))
    slopes, count = [derivative(image, grid, a) * min(grid.spacing) for a in axes], len(axes)
    pairs = {(i, j): (slopes[i] * slopes[j]).sum(1, keepdim=True) for i in range(count) for j in range(i + 1)}
    smooth = {pair: gaussian(product, sigma)[:, 0] for pair, product in pairs.items()}
    rows = [torch.stack([smooth[max(i, j), min(i, j)] for j in range(count)], 1) for i in range(count)]
    tensor = torch.stack(rows, 1)
    rounding = (_ROUNDING * torch.finfo(image.dtype).eps * largest(image)).square()
    tensor = tensor / per_item(largest(tensor).maximum(rounding).clamp(min=torch.finfo(image.dtype).tiny), tensor)
    minors = torch.stack([cofactors(tensor)[:, a, a] for a in range(count)]).sum(0).unsqueeze(1)
    return (determinant(tensor) / minors.clamp(min=_FLAT)).clamp(min=0)


def corners(image: Tensor, grid: Grid, count: int, weight: Tensor | None = None) -> Tensor:
    """Return the places ``(D, n)`` in units of spacing of at most ``count`` local maxima of `distinctiveness`.

    Args:
        image: of one item ``(1, C, *S)``.
        grid: its grid.
        count: the strongest so many are returned, in the order of memory.
        weight: ``(1, 1, *S)``; they lie where it is above 1/2.
    """
    strength = distinctiveness(image, grid)
    strength = strength if weight is None else strength * (weight > 0.5)
    peak = strength == MAX_POOL[grid.dim](strength, 3, stride=1, padding=1)
    nodes = (peak & (strength > _WEAKEST)).flatten().nonzero()[:, 0]
    strongest = strength.flatten()[nodes].argsort(descending=True, stable=True)[:count]
    return _places(nodes[strongest].sort().values, grid).to(image) * _spacing(grid, image)


def _places(nodes: Tensor, grid: Grid) -> Tensor:
    return torch.stack(torch.unravel_index(nodes, grid.shape))


def _spacing(grid: Grid, like: Tensor) -> Tensor:
    return like.new_tensor(grid.spacing).unsqueeze(1)


def _inside(points: Tensor, grid: Grid) -> Tensor:
    return points.clamp(min=0).minimum(points.new_tensor(grid.extent).unsqueeze(1))


def _matched(images: Sequence[Tensor], grid: Grid, points: Tensor, settings: KeypointSettings) -> tuple[Tensor, Tensor]:
    """Return the motion d of points ``(D, n)`` of the first image to the second, and that of their neighbours s."""
    graph = _Graph.of(points, settings.neighbours)
    d = s = torch.zeros_like(points)
    source = _grid_of(grid, settings.levels[-1])
    for level, reach in zip(settings.levels, settings.reach, strict=True):
        features = _grid_of(grid, level)
        h = _spacing(features, points)
        first, second = (features_of(image, grid, source, features) for image in images)
        nodes, centres = (_nearest(p, features) for p in (points, points + s))
        steps = [max(1, round(reach * min(grid.spacing) / side)) for side in features.spacing]
        steps = tuple(min(step, max(1, (n - 1) // _SIDE)) for step, n in zip(steps, features.shape, strict=True))
        cost = _costs(first, second, nodes, centres, steps)
        before = (centres - nodes).to(points)  # where the search begins, in steps
        agree = _agreement(graph, before)
        d, s = couple(cost, displacements(steps, cost), agree, settings.coupling, s / h - before)
        d, s = (d + before) * h, (s + before) * h
    return d, s


def _agreement(graph: "_Graph", before: Tensor) -> Callable[[Tensor], Tensor]:
    return lambda d: graph.smoothed(d + before) - before


def _nearest(points: Tensor, grid: Grid) -> Tensor:
    """Return the numbers of the nearest nodes ``(D, n)``."""
    last = torch.tensor(grid.shape, device=points.device).unsqueeze(1) - 1
    return (points / _spacing(grid, points)).round().long().clamp(min=0).minimum(last)


def _costs(fixed: Tensor, moving: Tensor, nodes: Tensor, centres: Tensor, reach: tuple[int, ...]) -> Tensor:
    """Return C ``(L, n)``, in standard deviations over the displacements.

    Σ_o |f(x + o) − m(y + d + o)|² over a patch of 3^D nodes o; its products are those of matrices.
    """
    dim, wide = len(reach), tuple(r + 1 for r in reach)
    size = max(1, CHUNK // (3**dim * math.prod(2 * r + 1 for r in wide)))
    first, second = (field[0].flatten(1).T.contiguous() for field in (fixed, moving))
    parts = []
    for x, y in zip(nodes.split(size, dim=1), centres.split(size, dim=1), strict=True):
        patch, window = _around(first, x, (1,) * dim, fixed.shape[2:]), _around(second, y, wide, moving.shape[2:])
        apart = window.square().sum(2).unsqueeze(1) - 2 * torch.bmm(patch, window.transpose(1, 2))
        apart = apart.unflatten(2, tuple(2 * r + 1 for r in wide))
        total = patch.square().sum((1, 2)).view(-1, *[1] * dim)
        for row, offset in zip(apart.unbind(1), product(range(3), repeat=dim), strict=True):
            for axis, (begin, r) in enumerate(zip(offset, reach, strict=True), start=1):
                row = row.narrow(axis, begin, 2 * r + 1)
            total = total + row
        parts.append(total.flatten(1).T)
    cost = torch.cat(parts, dim=1) / 3**dim
    return cost.div_(cost.std(dim=0).mean().clamp(min=SMALLEST_SCALE))


def _around(rows: Tensor, nodes: Tensor, radii: tuple[int, ...], shape: tuple[int, ...]) -> Tensor:
    """Return the values of a field at the nodes around others ``(D, n)``: ``(n, nodes of a window, C)``.

    Args:
        rows: values at each node of the grid ``(N, C)``.
        nodes: numbers of the nodes in the middle.
        radii: of the window along each axis; beyond the faces it has their values.
        shape: of the grid.
    """
    index = torch.zeros((), dtype=torch.long, device=nodes.device)
    for axis, (middle, r, n) in enumerate(zip(nodes, radii, shape, strict=True)):
        places = (middle.unsqueeze(1) + torch.arange(-r, r + 1, device=nodes.device)).clamp(0, n - 1)
        index = index * n + places.view(len(middle), *[1] * axis, -1, *[1] * (len(radii) - 1 - axis))
    return rows[index.flatten(1)]


@dataclass(frozen=True)
class _Graph:
    """Which points are neighbours, and how much each says about the motion of another.

    Attributes:
        nearest: the numbers of the neighbours, the point itself among them ``(n, m)``.
        shares: their weights ``(n, m)``, which sum to 1.
    """

    nearest: Tensor
    shares: Tensor

    @classmethod
    def of(cls, points: Tensor, neighbours: int) -> "_Graph":
        """Return the graph of points ``(D, n)``: the shares are those of a plane fitted under a Gaussian.

        Its standard deviation is the distance of the neighbour of this number.
        """
        count, places = points.shape[1], points.T
        distance = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
        near, nearest = distance.topk(min(count, _HEARD * neighbours), largest=False)
        sigma = near[:, min(neighbours, near.shape[1] - 1)].clamp(min=1e-6 * float(distance.max()) + 1e-30)
        gain = torch.exp(-0.5 * (near / sigma.unsqueeze(1)).square())
        away = (places[nearest] - places.unsqueeze(1)) / sigma.view(-1, 1, 1)
        design = torch.cat([torch.ones_like(away[..., :1]), away], dim=2)
        normal = torch.einsum("nm,nma,nmb->nab", gain, design, design)
        ridge = normal[:, :1, :1] * torch.diag(points.new_tensor([0.0, *[_RIDGE] * len(points)]))
        unit = torch.eye(len(points) + 1, dtype=points.dtype, device=points.device)[:, :1]
        weights = torch.linalg.solve(normal + ridge, unit.expand(count, -1, -1))
        return cls(nearest, (design @ weights)[..., 0] * gain)

    def smoothed(self, values: Tensor) -> Tensor:
        """Return for each point what its neighbours say, from values ``(D, n)``."""
        return (values[:, self.nearest] * self.shares).sum(2)


def map_of(points: Keypoints, grid: Grid, settings: KeypointSettings) -> tuple[Tensor, Keypoints]:
    """Return a smooth u ``(1, D, *S)`` without folds that joins pairs of points, and those that it joins.

    Args:
        points: the pairs.
        grid: the grid of u.
        settings: how smooth it is.

    Returns:
        u, which is 0 with fewer than 8 pairs, and the pairs without those that none of its rounds brings together.
    """
    if not points.enough:
        return points.fixed.new_zeros(1, grid.dim, *grid.shape), points.where(slice(0))
    coarse = with_nodes(_grid_of(grid, settings.levels[-1]), _NODES)
    metric = _metric(points, coarse, settings)
    u = points.fixed.new_zeros(1, grid.dim, *coarse.shape)
    for number in range(_ROUNDS):
        place = (points.fixed + sample(u, points.fixed.unsqueeze(0), coarse)[0]).unsqueeze(0)
        apart = points.moving.unsqueeze(0) - place
        if number == _TRUST:
            kept = apart[0].norm(dim=0) <= settings.agreement * min(grid.spacing)
            points, place, apart = points.where(kept), place[..., kept], apart[..., kept]
            if not points.enough:
                return map_of(points, grid, settings)
        u = compose(flow(_joining(place, apart, metric, _SLACK[number >= _TRUST]), coarse, _FLOW), u, coarse)
    u = repair_folds(u, coarse, settings.min_determinant)
    return repair_folds(prolong(u, grid), grid), points


def _metric(points: Keypoints, grid: Grid, settings: KeypointSettings) -> VelocityMetric:
    """Return the metric whose range is some distances between points."""
    places = points.fixed.T
    distance = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
    number = min(settings.neighbours, points.count - 1) + 1
    square = (settings.length_scale * float(distance.kthvalue(number, dim=1).values.median())) ** 2
    weights = Weights(div=square, curl=square, zero=1.0)
    return VelocityMetric.of_weights(grid, weights, SolverSettings(), points.fixed, order=2)


def _joining(place: Tensor, apart: Tensor, metric: VelocityMetric, slack: float) -> Tensor:
    """Return the velocity v = G c of loads c at points with v + slack c = what they are apart there."""
    grid = metric.grid

    def velocity(c: Tensor) -> Tensor:
        return metric.factor(scatter_points(c, place, grid), power=metric.order)

    middle = place.new_tensor(grid.extent).view(1, -1, 1) / 2
    load = scatter_points(torch.ones_like(middle), middle, grid)
    own = float(sample(metric.factor(load, power=metric.order), middle, grid).mean())  # of a point, on itself

    def joined(c: Tensor) -> Tensor:
        return sample(velocity(c), place, grid) / own + slack * c

    return velocity(conjugate_gradient(joined, apart, rtol=_TOLERANCE, max_steps=_STEPS).value) / own
