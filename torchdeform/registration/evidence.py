"""Evidence of how well a registration went, in numbers that mean the same for every pair of images."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product

import torch
from torch import Tensor

from torchdeform.core.derivatives import by_slabs, derivative, jacobian_determinant
from torchdeform.core.grid import Grid, limit_threads
from torchdeform.core.resampling import box_sum, prolong, restrict, with_nodes
from torchdeform.core.warp import sample, voxels, warp
from torchdeform.metrics.correlation import lncc, local_contrast
from torchdeform.metrics.mind import mind_ssc
from torchdeform.registration.problem import RegistrationProblem

# Nodes at most of the two grids that images are looked at on: one shows whether they show the same, the other where
# their edges are. On finer grids than the first, a map fits any texture to any other.
ROUGH = {2: 1600, 3: 4096}
_DETAIL = {2: 20_000, 3: 30_000}
_WINDOW = 7  # width of the windows that are correlated, in voxels

# What similarity is measured against: the moving image pushed along each axis by these shares of the box.
_AWAY = (0.2, -0.2, 0.35)

_MOST_LABELS = 12  # that are looked at, the largest
_SEEN = 60_000  # voxels at most at which labels are compared with their image
_EXTREME = 3.0  # a change of volume by more than this factor is extreme
_TRIED = 50_000  # points at which the inverse is tried, at most
_EDGES = 0.1  # share of the voxels, those with the largest gradients, that are edges
_LEVELS = 16  # grey levels that mutual information tells apart
_LEAST = 0.05  # information of an image about itself that counts as none
_BETTER = 0.2  # by so much more information a turned image has to fit better
_ASKED = 500  # edges whose distance from those of the other image is measured, at most
_LITTLE = 0.05  # share of what has contrast that is too little to compare
_KNOWN = 0.5  # weight from which on a voxel counts
_TINY = 1e-9


@dataclass(frozen=True)
class Evidence:
    """What speaks for or against one registered pair; its images are compared on coarse grids.

    Attributes:
        correlation_before: mean squared correlation of both images in windows around what has contrast, after the
            alignment and before the deformation; 1 for equal images.
        correlation: the same after the deformation.
        information_before: normalised mutual information, whatever the contrast: 0 is what both images have when one
            is pushed aside, 1 what the fixed image has with itself; before the deformation.
        information: the same after the deformation.
        structure_before: likeness of the patches around edges, whatever the contrast: 0 is what both images have when
            one is pushed aside, 1 for equal images; before the deformation, on a finer grid.
        edges_before: mean distance of the fixed image's strong edges from those of the moving one, in voxels of the
            fixed image, before the deformation.
        edges: the same after the deformation.
        foreground_before: Dice overlap of what is brighter than Otsu's threshold, before the deformation.
        foreground: the same after the deformation.
        disagreement: share of what has contrast where two rough maps, from fixed to moving and the other way round,
            each found without the other, disagree by more than a voxel, which is about 1/40 of the image (1/16 in 3D).
        extreme: share of the voxels whose volume changes more than threefold.
        extreme_inside: the same of those with contrast.
        inverse_error: 99th percentile of |φ(φ⁻¹(x)) − x| in voxels.
        covered: share of what has contrast in the fixed image where there is data of the moving one.
        turned: axes of the fixed grid, ``x``, ``y``, ``z``, along which the moving image fits clearly better when it is
            turned over.
        absent: share of what has contrast where the similarity was let go.
        label_contrast: how well the labels go with the fixed and with the moving image, see `label_contrast`; None
            without labels.
    """

    correlation_before: float
    correlation: float
    information_before: float
    information: float
    structure_before: float
    edges_before: float
    edges: float
    foreground_before: float
    foreground: float
    disagreement: float
    extreme: float
    extreme_inside: float
    inverse_error: float
    covered: float
    turned: tuple[str, ...] = ()
    absent: float = 0.0
    label_contrast: tuple[float, float] | None = None


def to_compare(problem: RegistrationProblem) -> RegistrationProblem:
    """Return one channel of a problem on a grid of few nodes and on the CPU, all that `gather_evidence` needs."""
    grey = {name: getattr(problem, name).mean(1, keepdim=True) for name in ("fixed", "moving")}
    few = replace(problem, **grey, fixed_points=None, moving_points=None, channels=(), intensities=True)
    few = few.on(with_nodes(problem.grid, _DETAIL[problem.grid.dim]))
    return replace(few, **{name: None if field is None else field.cpu() for name, field in _fields(few).items()})


@torch.no_grad()
def gather_evidence(
    problem: RegistrationProblem,
    u: Tensor,
    inverse: Tensor,
    grid: Grid,
    *,
    disagreement: Tensor,
    absent: Tensor | None = None,
) -> tuple[Evidence, ...]:
    """Return the evidence for every item of a batch.

    Args:
        problem: what `to_compare` returns.
        u: displacement of the map ``(B, D, *S)`` in units of spacing.
        inverse: that of its inverse.
        grid: their grid.
        disagreement: what `disagreement` says about the problem, ``(B,)``.
        absent: weight from 0 to 1 of what the similarity was let go of ``(B, 1, *S)``, or None.

    Notes:
        About 50 ms on grids of any size, and one pass over the map for its determinant.
    """
    with limit_threads(1, problem.grid):
        return tuple(
            _of_item(
                _item(problem, k),
                _part(u, k),
                _part(inverse, k),
                grid,
                float(apart),
                None if absent is None else _part(absent, k),
            )
            for k, apart in enumerate(disagreement)
        )


def _item(problem: RegistrationProblem, index: int) -> RegistrationProblem:
    return replace(problem, **{name: None if f is None else _part(f, index) for name, f in _fields(problem).items()})


def _fields(problem: RegistrationProblem) -> dict[str, Tensor | None]:
    return {name: getattr(problem, name) for name in ("fixed", "moving", "fixed_mask", "moving_mask")}


def _part(field: Tensor, index: int) -> Tensor:
    return field[index : index + 1] if len(field) > 1 else field


def _of_item(
    problem: RegistrationProblem, u: Tensor, inverse: Tensor, grid: Grid, disagreement: float, absent: Tensor | None
) -> Evidence:
    rough = problem.on(with_nodes(problem.grid, ROUGH[grid.dim]))
    before, after = Views.of(rough), Views.of(rough, u)
    start, end = Views.of(problem), Views.of(problem, u)
    information, turned = before.turned()
    volume = (by_slabs(jacobian_determinant, u, grid).clamp(min=_TINY).log().abs() > math.log(_EXTREME)).to(u)
    size = problem.grid.spacing[-1] / grid.spacing[-1]  # of the voxels that edges are seen in
    return Evidence(
        correlation_before=before.correlation(),
        correlation=after.correlation(),
        information_before=information,
        information=after.information(),
        structure_before=start.structure(),
        edges_before=size * start.edge_distance(),
        edges=size * end.edge_distance(),
        foreground_before=start.foreground_overlap(),
        foreground=end.foreground_overlap(),
        disagreement=disagreement,
        extreme=float(volume.mean()),
        extreme_inside=end.share(restrict(volume, grid, problem.grid)),
        inverse_error=_inverse_error(u, inverse, grid),
        covered=end.share(end.moving_weight),
        turned=turned,
        absent=0.0 if absent is None else end.share(restrict(absent, grid, problem.grid)),
    )


def _inverse_error(u: Tensor, inverse: Tensor, grid: Grid) -> float:
    """Return the 99th percentile of |φ(φ⁻¹(x)) − x| over some nodes, in voxels."""
    stride = math.ceil((math.prod(grid.shape) / _TRIED) ** (1 / grid.dim))
    every = (slice(None), slice(None), *[slice(None, None, stride)] * grid.dim)
    w = inverse[every]
    points = grid.points(dtype=u.dtype, device=u.device)[every] + w
    return _percentile(voxels(w + sample(u, points, grid), grid), 0.99)


def _percentile(values: Tensor, share: float) -> float:
    values = values.flatten()
    return float(values.kthvalue(1 + round(share * (len(values) - 1))).values)


@dataclass(frozen=True)
class Views:
    """Two images on one grid, where they are known, and where the fixed one has contrast: weights from 0 to 1.

    All are ``(1, 1, *S)``.
    """

    grid: Grid
    fixed: Tensor
    moving: Tensor
    fixed_weight: Tensor
    moving_weight: Tensor
    seen: Tensor

    @classmethod
    def of(cls, problem: RegistrationProblem, u: Tensor | None = None) -> "Views":
        """Return the images of one item, the moving one through a displacement on any grid of the same box."""
        first, second = (
            torch.ones_like(problem.fixed) if mask is None else mask.clamp(0, 1)
            for mask in (problem.fixed_mask, problem.moving_mask)
        )
        moving = problem.moving
        if u is not None:
            w = prolong(u, problem.grid).to(problem.fixed)
            moving, second = (
                warp(field, w, problem.grid, outside=outside) for field, outside in ((moving, None), (second, 0.0))
            )
        return cls(problem.grid, problem.fixed, moving, first, second, local_contrast(problem.fixed, _WINDOW) * first)

    @property
    def both(self) -> Tensor:
        """Where both images are known."""
        return ((self.fixed_weight > _KNOWN) & (self.moving_weight > _KNOWN)).to(self.fixed)

    def share(self, field: Tensor) -> float:
        """Return the mean of a field over what has contrast in the fixed image."""
        return float((field.to(self.seen) * self.seen).sum() / self.seen.sum().clamp(min=_TINY))

    def correlation(self) -> float:
        """Return the mean squared correlation in windows around what has contrast."""
        if not bool(self.both.any()):
            return 0.0
        return float(lncc(self.fixed, self.moving, mask=self.both, window=_WINDOW, intensity_range=(0, 1)))

    def information(self) -> float:
        """Return the mutual information, from 0 for images pushed apart to 1 for the fixed image twice."""
        return self._informations((self,))[0]

    def structure(self) -> float:
        """Return 1 - D / (D of images pushed apart), D being the squared difference of their MIND features."""
        if self.share(self.both) < _LITTLE:
            return 0.0
        views = replace(self, fixed=mind_ssc(self.fixed), moving=mind_ssc(self.moving))
        away = [view._difference() for view in views.pushed()]
        return 1 - views._difference() / max(sum(away) / len(away), _TINY)

    def _difference(self) -> float:
        apart = (self.fixed - self.moving).square().mean(1, keepdim=True)
        weight = self.seen * self.both
        return float((apart * weight).sum() / weight.sum().clamp(min=_TINY))

    def turned(self) -> tuple[float, tuple[str, ...]]:
        """Return `information`, and the axes along which turning the moving image over raises it clearly."""
        names = dict(zip(self.grid.axes, "zyx"[-self.grid.dim :], strict=True))
        ways = [axes for count in range(1 + len(names)) for axes in combinations(names, count)]
        values = self._informations([self._moved(partial(torch.flip, dims=axes)) for axes in ways])
        best = max(range(len(ways)), key=values.__getitem__)
        return values[0], tuple(names[axis] for axis in ways[best]) if values[best] > values[0] + _BETTER else ()

    def _informations(self, views: Sequence["Views"]) -> list[float]:
        away = [view._mutual() for view in self.pushed()]
        least, most = sum(away) / len(away), replace(self, moving=self.fixed)._mutual()
        return [(view._mutual() - least) / max(most - least, _LEAST) for view in views]

    def pushed(self) -> Iterator["Views"]:
        for axis, share in product(self.grid.axes, _AWAY):
            yield self._moved(partial(_rolled, axis=axis, share=share))

    def _moved(self, move: Callable[[Tensor], Tensor]) -> "Views":
        return replace(self, moving=move(self.moving), moving_weight=move(self.moving_weight))

    def _mutual(self) -> float:
        """Return (H_f + H_m) / H of the grey levels where both images are known, 1 for independent images."""
        known = self.both > 0
        if not bool(known.any()):
            return 1.0
        table = _joint_histogram(self.fixed[known], self.moving[known])
        parts = (_entropy(table.sum(axis)) for axis in (0, 1))
        return sum(parts) / max(_entropy(table), _TINY)

    def edge_distance(self) -> float:
        """Return the mean distance in voxels between strong edges of one image and the nearest of the other."""
        known = self.both > 0
        if not bool(known.any()):
            return math.inf
        one, other = (_edges(image, known)[0, 0].nonzero().float() for image in (self.fixed, self.moving))
        if not (len(one) and len(other)):
            return math.inf
        some = ((edges[:: math.ceil(len(edges) / _ASKED)], rest) for edges, rest in ((one, other), (other, one)))
        return sum(float(torch.cdist(*pair).amin(1).mean()) for pair in some) / 2

    def foreground_overlap(self) -> float:
        """Return the Dice overlap of what is brighter than Otsu's threshold, where both images are known."""
        known = self.both > 0
        if not bool(known.any()):
            return 0.0
        first, second = (image[known] > otsu(image[known]) for image in (self.fixed, self.moving))
        return float(2 * (first & second).sum() / (first.sum() + second.sum()).clamp(min=1))


def _joint_histogram(one: Tensor, other: Tensor) -> Tensor:
    """Return the histogram of pairs of values from 0 to 1, each shared between the two nearest levels."""
    places = [values.double().clamp(0, 1) * (_LEVELS - 1) for values in (one, other)]
    i, j = (place.long().clamp(max=_LEVELS - 2) for place in places)
    s, t = places[0] - i, places[1] - j
    table = torch.zeros(_LEVELS**2, dtype=torch.float64, device=one.device)
    for di, dj in product((0, 1), (0, 1)):
        share = (s if di else 1 - s) * (t if dj else 1 - t)
        table += torch.bincount((i + di) * _LEVELS + j + dj, share, _LEVELS**2)
    return table.view(_LEVELS, _LEVELS)


def _entropy(counts: Tensor) -> float:
    share = counts[counts > 0] / counts.sum()
    return -float((share * share.log()).sum())


def _rolled(field: Tensor, axis: int, share: float) -> Tensor:
    return field.roll(round(share * field.shape[axis]), axis)


def _edges(image: Tensor, known: Tensor) -> Tensor:
    """Return where the gradient is among the largest of those that are known."""
    grid = Grid(tuple(image.shape[2:]))
    length = sum(derivative(image, grid, axis).square() for axis in range(grid.dim)) * known
    return (length >= _percentile(length[known], 1 - _EDGES)) & (length > 0)


def otsu(values: Tensor) -> float:
    """Return the threshold that leaves the least variance within the values on either side of it."""
    low, high = (float(end) for end in values.aminmax())
    count = torch.histc(values.float(), 256, min=low, max=high).double()
    centre = low + (high - low) * (torch.arange(256, dtype=torch.float64, device="cpu") + 0.5) / 256
    below, total = count.cumsum(0), (count * centre).cumsum(0)
    above = below[-1] - below
    between = (total * below[-1] - total[-1] * below).square() / (below * above).clamp(min=1)
    return float(centre[between.argmax()])


def with_labels(
    evidence: tuple[Evidence, ...], images: tuple[Tensor, Tensor], labels: tuple[Tensor, Tensor]
) -> tuple[Evidence, ...]:
    """Return the evidence with how well labels go with their images, all ``(B or 1, C or 1, *S)``."""
    found = []
    for index, known in enumerate(evidence):
        pairs = zip(images, labels, strict=True)
        first, second = (label_contrast(_part(image, index), _part(regions, index)) for image, regions in pairs)
        found.append(replace(known, label_contrast=(first, second)))
    return tuple(found)


def label_contrast(image: Tensor, labels: Tensor) -> float:
    """Return which share of the variance in and around a label it explains, the mean over the largest labels.

    Args:
        image: ``(1, C, *S)``.
        labels: ``(1, 1, *S)``, whole numbers, 0 for nothing.

    Notes:
        Around a label is a margin that is about as large as it is. Labels of another image explain little.
    """
    stride = math.ceil((labels.numel() / _SEEN) ** (1 / (labels.dim() - 2)))
    some = (slice(None), slice(None), *[slice(None, None, stride)] * (labels.dim() - 2))
    grey, labels = image.float().mean(1, keepdim=True)[some], labels[some]
    names, counts = labels[labels != 0].unique(return_counts=True)
    largest = names[counts.argsort(descending=True)[:_MOST_LABELS]]
    shares = [_explained(grey, labels == name) for name in largest]
    return sum(shares) / len(shares) if shares else math.nan


def _explained(grey: Tensor, region: Tensor) -> float:
    """Return 1 - (variance inside and outside of a region) / (variance of all), near the region."""
    dim, size = region.dim() - 2, float(region.sum())
    margin = max(1, round(size ** (1 / dim) * (2 ** (1 / dim) - 1) / 2))
    near = box_sum(region.to(grey), 2 * margin + 1) > _KNOWN
    around = grey[near]
    parts = grey[region], grey[near & ~region]
    left = sum(float((part - part.mean()).square().sum()) for part in parts if len(part))
    return 1 - left / max(float((around - around.mean()).square().sum()), _TINY)
