"""Interpolation at scattered points: nearest, linear, cubic B-spline as in ITK's resampler; and one for labels."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import MAX_POOL
from torchdeform.core.warp import sample, with_outside
from torchdeform.errors import InputError, require_choice

Sampler = Callable[[Tensor], Tensor]
Outside = float | Tensor | None  # for all channels, or one per channel (C,)
_Support = list[tuple[Tensor, Tensor]]  # nodes and weights
_Kernel = tuple[tuple[float, float, float, float], ...]

# The cubic B-spline on its four intervals, as polynomials in the fraction t of a voxel: t³, t², t, 1.
_SPLINE: _Kernel = (
    (-1 / 6, 1 / 2, -1 / 2, 1 / 6),
    (1 / 2, -1, 0, 2 / 3),
    (-1 / 2, 1 / 2, 1 / 2, 1 / 6),
    (1 / 6, 0, 0, 0),
)

# A Gaussian of half a voxel gives this share to either neighbour; below it is combined with linear interpolation.
_SIDE = 1 / (2 + math.exp(2))
_LABEL_KERNEL: _Kernel = (
    (0, 0, -_SIDE, _SIDE),
    (0, 0, 3 * _SIDE - 1, 1 - 2 * _SIDE),
    (0, 0, 1 - 3 * _SIDE, _SIDE),
    (0, 0, _SIDE, 0),
)

# Nodes whose labels count are at most this far from the nearest one; and the number of points done at once.
_RADIUS = 2
_POINTS_AT_ONCE = 2**16


def interpolator(image: Tensor, grid: Grid, *, mode: str = "linear", outside: Outside = 0.0) -> Sampler:
    """Return the function p ↦ image(p).

    Args:
        image: ``(1, C, *S)`` on ``grid``.
        grid: the grid of the image.
        mode: ``nearest`` (halves up, as ITK rounds), ``linear``, ``cubic`` (B-spline through the values, mirrored at
            the outermost nodes; it can overshoot them), or ``label`` (of the values around, the one whose indicator is
            largest there, smoothed by a Gaussian of half a voxel and interpolated linearly).
        outside: value more than half a voxel outside Ω; None takes the value at the nearest point of Ω.

    Returns:
        A function of points ``(B, D, *T)`` (units of spacing, array order, float64 for full precision) that returns
        ``(B, C, *T)`` in the image's type.

    Raises:
        InputError: shape, mode; labels that are not finite.

    Notes:
        Nearest and label keep values exactly and have no gradient in the points; linear is second order, cubic fourth,
        both differentiable in image and points. Cubic reads 4^D nodes a point: about 20 times the time of linear in 3D.
        So does label, but only near borders; its memory does not grow with the number of labels. At a border it is
        linear interpolation that decides, so borders stay smooth where nearest makes steps, but also rounds off what is
        thinner than two voxels.
    """
    grid.check(image, "interpolator: image")
    require_choice(mode, _MODES, "interpolation")
    return _MODES[mode](image, grid, outside)


def _linear(image: Tensor, grid: Grid, outside: Outside) -> Sampler:
    return lambda points: sample(image, points, grid, outside=outside)


def _nearest(image: Tensor, grid: Grid, outside: Outside) -> Sampler:
    values = image.flatten(2)[0]

    def at(points: Tensor) -> Tensor:
        index = _index(points, grid)
        node = torch.zeros_like(index[0], dtype=torch.long)
        for x, n, stride in zip(index, grid.shape, grid.strides, strict=True):
            node += torch.floor(x.detach() + 0.5).nan_to_num().clamp(0, n - 1).long() * stride
        return with_outside(_take(values, node), points, grid, outside)

    return at


def _label(image: Tensor, grid: Grid, outside: Outside) -> Sampler:
    if not bool(image.isfinite().all()):
        raise InputError("labels must be finite numbers, but some are NaN or infinite; replace them first, say by 0")
    nearest = _nearest(image, grid, None)
    near_border = _nearest(_near_border(image.detach()), grid, None)

    def at(points: Tensor) -> Tensor:
        index = _index(points.detach(), grid)
        found, unsure = nearest(points), near_border(points)
        for channel, values in enumerate(image.detach().flatten(2)[0]):
            there = unsure[:, channel].nonzero(as_tuple=True)
            for some in zip(*(part.split(_POINTS_AT_ONCE) for part in there), strict=True):
                near = [x[some].clamp(0, n - 1) for x, n in zip(index, grid.shape, strict=True)]
                found[:, channel][some] = _heaviest_label(*_weighted_labels(values, near, grid))
        return with_outside(found, points, grid, outside)

    return at


def _near_border(image: Tensor) -> Tensor:
    """Return where not all nodes whose labels count have the same one ``(1, C, *S)``, bool."""
    low, high = -image, image
    for axis in range(2, image.dim()):
        radius = [_RADIUS if a == axis else 0 for a in range(2, image.dim())]
        window = [2 * r + 1 for r in radius]
        low, high = (MAX_POOL[len(radius)](part, window, 1, radius).view(image.shape) for part in (low, high))
    return low + high != 0


def _weighted_labels(values: Tensor, index: list[Tensor], grid: Grid) -> tuple[Tensor, Tensor]:
    """Return the labels of the nodes around each position, given in voxels, and their weights, ``(4^D, N)`` each."""
    nodes = torch.zeros_like(index[0], dtype=torch.long).unsqueeze(0)
    weights = torch.ones_like(nodes, dtype=torch.float32)
    for x, n, stride in zip(index, grid.shape, grid.strides, strict=True):
        near = _support(x, n, stride, torch.float32, _LABEL_KERNEL)
        nodes = torch.cat([nodes + node for node, _ in near])
        weights = torch.cat([weights * weight for _, weight in near])
    return values[nodes], weights


def _heaviest_label(labels: Tensor, weights: Tensor) -> Tensor:
    """Return for each column the label with the largest sum of weights.

    Label by label, that of the heaviest node first, as long as what is left could be heavier than the best so far.
    """
    found, best = labels[0].clone(), torch.zeros_like(weights[0])
    open_ = torch.arange(len(found), device=found.device)
    while len(open_):
        candidate = labels.gather(0, weights.argmax(0, keepdim=True))
        own = weights * (labels == candidate)
        total, weights = own.sum(0), weights - own
        better = total > best[open_]
        found[open_[better]], best[open_[better]] = candidate[0, better], total[better]
        undecided = weights.sum(0) > best[open_]
        open_, labels, weights = open_[undecided], labels[:, undecided], weights[:, undecided]
    return found


def _cubic(image: Tensor, grid: Grid, outside: Outside) -> Sampler:
    coefficients = spline_coefficients(image, grid).flatten(2)[0]

    def at(points: Tensor) -> Tensor:
        index = _index(points, grid)
        if outside is None:
            index = tuple(x.clamp(0, n - 1) for x, n in zip(index, grid.shape, strict=True))
        along = zip(index, grid.shape, grid.strides, strict=True)
        supports = [_support(x, n, stride, image.dtype, _SPLINE) for x, n, stride in along]
        start = torch.zeros_like(index[0], dtype=torch.long)
        return with_outside(_weighted_sum(coefficients, supports, start), points, grid, outside)

    return at


def _weighted_sum(values: Tensor, supports: list[_Support], start: Tensor) -> Tensor:
    """Return Σ w_a Σ w_b .. values[start + a + b + ..] over the four nodes a, b, .. along each axis."""
    if not supports:
        return _take(values, start)
    terms = [w.unsqueeze(1) * _weighted_sum(values, supports[1:], start + node) for node, w in supports[0]]
    return sum(terms[1:], start=terms[0])


_MODES: dict[str, Callable[[Tensor, Grid, Outside], Sampler]] = {
    "nearest": _nearest,
    "linear": _linear,
    "cubic": _cubic,
    "label": _label,
}
MODES = tuple(_MODES)

# The default mode for labels, and the modes that copy values.
LABEL_MODE = "label"
COPYING = ("nearest", LABEL_MODE)


def spline_coefficients(image: Tensor, grid: Grid) -> Tensor:
    """Return c with Σ_j c_j B(i − j) = image_i along every axis, B the cubic B-spline, mirrored at the last nodes.

    Notes:
        The kernel (1/6, 4/6, 1/6) is a product on the Fourier side of the mirrored row: (2 + cos ω) / 3. Exact.
    """
    for axis, n in zip(grid.axes, grid.shape, strict=True):
        mirrored = torch.cat((image, image.narrow(axis, 1, n - 2).flip(axis)), dim=axis)
        waves = torch.arange(n, dtype=image.dtype, device=image.device) * (math.pi / (n - 1))
        response = ((2 + waves.cos()) / 3).view(-1, *([1] * (image.dim() - 1 - axis)))
        spectrum = torch.fft.rfft(mirrored, dim=axis) / response
        image = torch.fft.irfft(spectrum, n=2 * n - 2, dim=axis).narrow(axis, 0, n)
    return image


def _index(points: Tensor, grid: Grid) -> tuple[Tensor, ...]:
    """Return for each axis the position in voxels ``(B, *T)``."""
    return tuple(points[:, k] / h for k, h in enumerate(grid.spacing))


def _support(index: Tensor, count: int, stride: int, dtype: torch.dtype, kernel: _Kernel) -> _Support:
    """Return the four nodes around each position along one axis, mirrored into the grid, and their weights."""
    start = torch.floor(index.detach())
    t = (index - start).to(dtype)
    first, period = start.nan_to_num().clamp(-(2.0**52), 2.0**52).long() - 1, 2 * (count - 1)
    nodes = ((first + step) % period for step in range(4))
    weights = (((a * t + b) * t + c) * t + d for a, b, c, d in kernel)
    return [(torch.minimum(n, period - n) * stride, w) for n, w in zip(nodes, weights, strict=True)]


def _take(values: Tensor, nodes: Tensor) -> Tensor:
    """Return values ``(C, N)`` at positions ``(B, *T)`` of the flattened grid as ``(B, C, *T)``."""
    return values.index_select(1, nodes.flatten()).view(-1, *nodes.shape).movedim(0, 1)
