"""Outlines in a slice: of regions, of labels, and the edges of a picture, each a list of lines (across, down)."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchdeform.core.grid import Grid
from torchdeform.deformation.monitors import smooth

Floats = NDArray[np.floating]
Lines = list[Floats]  # each (m, 2), in nodes

_BLUR = 0.012  # standard deviation of the Gaussian before edges are looked for, in lengths of the longer side
_STEEP = 0.84  # share of the pixels whose slope is too small for an edge
_LARGE = 4096  # labels below are looked up directly
_SHORTEST = 0.04  # of an edge, in lengths of the longer side


def outlines(labels: NDArray[Any]) -> list[Lines]:
    """Return the closed outlines of every label other than 0 in each slice ``(n, h, w)``, of a region that is True.

    By marching squares, half way between a label's pixels and others: where two touch there is one of each.
    """
    if not labels.any():
        return [[] for _ in labels]
    padded = np.pad(_codes(labels), ((0, 0), (1, 1), (1, 1)))
    down, across = np.mgrid[-1 : padded.shape[1] - 1, -1 : padded.shape[2] - 1].astype(np.float64)
    found: list[Lines] = [[] for _ in labels]
    for number, code, box in _boxes(padded):
        inside = (padded[number][box] == code).astype(np.float64)
        found[number] += _level_lines(across[box], down[box], inside, 0.5)
    return found


def _boxes(codes: NDArray[np.int32]) -> Iterator[tuple[int, int, tuple[slice, slice]]]:
    """Yield the number of the slice, the code and a box, one pixel larger, of each code other than 0."""
    place = np.nonzero(codes)
    key = place[0] * (int(codes.max()) + 1) + codes[place]
    order = np.argsort(key, kind="stable")
    _, firsts = np.unique(key[order], return_index=True)
    ends = [f.reduceat(axis[order], firsts) for axis in place[1:] for f in (np.minimum, np.maximum)]
    for k, first in enumerate(order[firsts]):
        low, high, left, right = (int(end[k]) for end in ends)
        box = (slice(low - 1, high + 2), slice(left - 1, right + 2))
        yield int(place[0][first]), int(codes[tuple(axis[first] for axis in place)]), box


def _codes(labels: NDArray[Any]) -> NDArray[np.int32]:
    """Return labels as small whole numbers, 0 staying 0."""
    if labels.min() >= 0 and labels.max() < _LARGE:
        return labels.astype(np.int32)
    values, codes = np.unique(np.append(labels, 0), return_inverse=True)
    zero = int(np.searchsorted(values, 0))
    moved = np.where(codes < zero, codes + 1, np.where(codes == zero, 0, codes))
    return moved[:-1].reshape(labels.shape).astype(np.int32)


def _level_lines(
    across: NDArray[np.float64], down: NDArray[np.float64], values: NDArray[np.float64], level: float
) -> Lines:
    """Return the lines at a level of values ``(h, w)``, none through those that are not finite."""
    from contourpy import FillType, LineType, SerialContourGenerator, ZInterp

    # The class itself: contourpy's function of the same purpose takes many times as long to check small arrays.
    bad = ~np.isfinite(values)
    generator = SerialContourGenerator(
        across,
        down,
        values,
        bad,
        line_type=LineType.Separate,
        fill_type=FillType.OuterOffset,
        corner_mask=False,
        quad_as_tri=False,
        z_interp=ZInterp.Linear,
        x_chunk_size=0,
        y_chunk_size=0,
    )
    return list(generator.lines(level))  # pyright: ignore[reportReturnType]


def edge_lines(pictures: NDArray[np.floating], spacing: Sequence[float]) -> list[Lines]:
    """Return the edges of each picture ``(n, h, w)``: where the second derivative of the blurred grey values is 0.

    Args:
        pictures: grey values of slices of one image.
        spacing: of the pixels, down and across.

    Notes:
        Marr and Hildreth, Theory of edge detection, 1980. Only where the slope is among the steepest of all slices, and
        only lines that are not short.
    """
    longest = max(n * h for n, h in zip(pictures.shape[1:], spacing, strict=True))
    grid = Grid(pictures.shape[1:], tuple(spacing))
    sigma = max(_BLUR * longest, 0.8 * min(spacing))
    blurred = smooth(torch.as_tensor(pictures).float().unsqueeze(1), grid, sigma)[:, 0].numpy()
    down, across = np.gradient(blurred, *spacing, axis=(1, 2))
    bend = np.gradient(down, spacing[0], axis=1) + np.gradient(across, spacing[1], axis=2)
    slope = np.hypot(down, across)
    bend[slope < max(float(np.quantile(slope[:, ::2, ::2], _STEEP)), 1e-6)] = np.nan
    least, (down, across) = _SHORTEST * longest, np.mgrid[: bend.shape[1], : bend.shape[2]].astype(np.float64)
    levels = (_level_lines(across, down, flat.astype(np.float64), 0.0) for flat in bend)
    return [[line for line in lines if _length(line, spacing) > least] for lines in levels]


def _length(line: Floats, spacing: Sequence[float]) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0) * spacing[::-1], axis=1).sum())
