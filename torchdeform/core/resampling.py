"""Matrices along the axes of a field, with few entries a row, near one another: interpolation, smoothing, windows."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.tables import kept

# Factor by which voxels grow until a grid has few enough nodes.
_COARSER = 1.05

# Gives what a field ``(B, C, *S)`` is in some rows of its first axis.
Rows = Callable[[slice], Tensor]

# Rows of a slab at least: fewer are not worth the calls.
_SLAB_ROWS = 8

# Rows of a block: with fewer rows fewer of its entries are 0, but small products are slow. Two fields of 4096² on half
# as many nodes an axis: 0.1 s, against 1.4 s when entries are taken one by one.
_ROWS = {"cpu": 32, "cuda": 256}

# Matrices of no more entries than this are one block: a call costs more than the products with their zeros.
_SMALL = 2**13

# A Gaussian is cut off at so many standard deviations.
_REACH = 3


@dataclass(frozen=True)
class Banded:
    """A matrix as dense blocks of some rows and the columns that those need.

    Attributes:
        shape: rows and columns.
        blocks: the first column and the entries ``(rows, columns)`` of each.
    """

    shape: tuple[int, int]
    blocks: tuple[tuple[int, Tensor], ...]

    def along(self, field: Tensor, axis: int) -> Tensor:
        """Return the product with every line of a field ``(B, C, *S)`` along an axis of the tensor.

        Notes:
            The same order of summation in every run. Differentiable; where a gradient is wanted by the dense matrix,
            whose derivative is one product as well.
        """
        shape = (*field.shape[:axis], self.shape[0], *field.shape[axis + 1 :])
        if torch.is_grad_enabled() and field.requires_grad:
            last = axis == field.dim() - 1
            return field @ self._dense.T if last else (self._dense @ field.flatten(axis + 1)).view(shape)
        lines = _lines(field.contiguous(), axis)
        if len(self.blocks) == 1:
            return self._whole(lines, axis == field.dim() - 1).view(shape)
        factors = [
            (entries.expand(len(lines), -1, -1), lines.narrow(1, first, entries.shape[1]))
            for first, entries in self.blocks
        ]
        found = field.new_empty(shape)
        parts = _lines(found, axis).split([len(entries) for _, entries in self.blocks], dim=1)
        for pair, part in zip(factors, parts, strict=True):
            torch.bmm(*pair, out=part)
        return found

    def _whole(self, lines: Tensor, last: bool) -> Tensor:
        """Return the product of the only block with lines as `_lines` gives them, in the order of a field's memory."""
        first, entries = self.blocks[0]
        lines = lines.narrow(1, first, entries.shape[1])
        return lines[0].T @ entries.T if last else entries @ lines

    @cached_property
    def _dense(self) -> Tensor:
        with torch.inference_mode(False), torch.no_grad():
            columns = self.shape[1]
            rows = [F.pad(entries, (k, columns - k - entries.shape[1])) for k, entries in self.blocks]
            return torch.cat(rows)


def _lines(field: Tensor, axis: int) -> Tensor:
    """Return a view ``(n, size, m)`` of a field with ``size`` nodes along the axis."""
    before, size, after = math.prod(field.shape[:axis]), field.shape[axis], math.prod(field.shape[axis + 1 :])
    if axis == field.dim() - 1:
        return field.view(before, size).T.unsqueeze(0)
    return field.view(before, size, after)


def least_rows(shape: Sequence[int]) -> int:
    """Return the rows of a slab at least; all where gradients may be wanted, to which every slab would add a whole."""
    return shape[0] if torch.is_grad_enabled() else _SLAB_ROWS


def multiply(field: Tensor, factors: Sequence[Banded | None]) -> Tensor:
    """Return the products of a field ``(B, C, *S)`` with one matrix an axis; None leaves an axis as it is."""
    for axis, factor in enumerate(factors, start=2):
        field = field if factor is None else factor.along(field, axis)
    return field


def rows_of_product(field: Tensor, factors: Sequence[Banded | None]) -> Rows:
    """Return what gives some rows of `multiply`, for products with more nodes than the field."""
    first, *others = factors
    field = multiply(field, [first])
    return lambda rows: multiply(field[:, :, rows], [None, *others])


def multiply_by_rows(
    values: Rows, shape: Sequence[int], device: torch.device, first: Banded | None, others: Sequence[Banded | None]
) -> Tensor:
    """Return `multiply` of a field on ``shape`` that is made slab by slab, for products with fewer nodes."""
    parts = over_slabs(lambda rows: multiply(values(rows), [None, *others]), shape, device, least=least_rows(shape))
    return multiply(parts, [first])


def interpolation(coarse: int, fine: int, like: Tensor) -> Banded | None:
    """Return linear interpolation from nodes of an axis to more of them, both with one at each end; None for as many.

    Args:
        coarse: number of nodes that are given.
        fine: number of nodes of the result.
        like: a tensor with the dtype and device of the result.
    """
    return None if coarse == fine else banded(*_linear(coarse, fine), (fine, coarse), like)


def interpolation_transpose(fine: int, coarse: int, like: Tensor) -> Banded | None:
    """Return the transpose of `interpolation`, divided by the number of fine intervals to a coarse one."""
    rows, columns, values = _linear(coarse, fine)
    return None if coarse == fine else banded(columns, rows, values * ((coarse - 1) / (fine - 1)), (coarse, fine), like)


def hat_average(field: Tensor, coarse: Grid) -> Tensor:
    """Return the mean of a field ``(B, C, *S)`` around each node of a coarser grid, weighted by its hat function.

    Args:
        field: on a grid of the same box.
        coarse: the grid of the result.
    """
    counts = zip(field.shape[2:], coarse.shape, strict=True)
    return multiply(field, [_hats(many, few, field.dtype, field.device) for many, few in counts])


@kept(64)
def _hats(fine: int, coarse: int, dtype: torch.dtype, device: torch.device) -> Banded | None:
    """Return the transpose of linear interpolation, every row divided by its sum."""
    if coarse == fine:
        return None
    columns, rows, values = _linear(coarse, fine)
    sums = values.new_zeros(coarse).index_add_(0, rows, values)
    return banded(rows, columns, values / sums[rows], (coarse, fine), torch.empty(0, dtype=dtype, device=device))


def restriction(fine: int, coarse: int, blur: float, like: Tensor) -> Banded | None:
    """Return smoothing by a Gaussian, continued by its values at the ends, and linear interpolation to fewer nodes.

    Args:
        fine: number of nodes that are given.
        coarse: number of nodes of the result.
        blur: standard deviation in voxels of the coarse axis.
        like: a tensor with the dtype and device of the result.
    """
    if coarse == fine:
        return None
    sigma = blur * (fine - 1) / (coarse - 1)
    radius = math.ceil(_REACH * sigma)
    offset = torch.arange(-radius, radius + 1, device="cpu")
    kernel = torch.softmax(-(offset.double() ** 2) / (2 * sigma**2), dim=0)
    rows, columns, values = (part.unsqueeze(1) for part in _linear(fine, coarse))
    columns, values = (columns + offset).clamp(0, fine - 1), values * kernel
    flat = rows.expand_as(columns).flatten(), columns.flatten(), values.flatten()
    return banded(*flat, (coarse, fine), like)


def _linear(given: int, asked: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows, columns and values of linear interpolation from so many nodes of an interval to others."""
    rows = torch.arange(asked, device="cpu")
    place = rows.double() * ((given - 1) / (asked - 1))
    left = place.long().clamp(max=given - 2)
    share = place - left
    return rows.repeat(2), torch.cat([left, left + 1]), torch.cat([1 - share, share])


def banded(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int], like: Tensor) -> Banded:
    """Return the matrix with the entries ``values`` in these rows and columns ``(n,)``, those of one place being added.

    Args:
        rows: whole numbers.
        columns: whole numbers, near one another in rows that are.
        values: entries.
        shape: rows and columns of the matrix.
        like: a tensor with the dtype and device of the result.
    """
    blocks, size = [], shape[0] if math.prod(shape) <= _SMALL else _ROWS.get(like.device.type, 256)
    for start in range(0, shape[0], size):
        here = (rows >= start) & (rows < start + size)
        near = columns[here] if bool(here.any()) else columns.new_zeros(1)
        first = int(near.min())
        entries = values.new_zeros(min(size, shape[0] - start), int(near.max()) + 1 - first)
        entries.index_put_((rows[here] - start, columns[here] - first), values[here], accumulate=True)
        blocks.append((first, entries.to(like)))
    return Banded(shape, tuple(blocks))


def box_sum(x: Tensor, window: int, stride: int = 1) -> Tensor:
    """Return Σ x over the window around each node, cut off at the boundary, or around the nodes of `centres` only.

    Args:
        x: ``(B, C, *S)``.
        window: width in nodes, odd.
        stride: nodes from one window to the next along every axis.

    Returns:
        ``(B, C, *W)``, W = ⌈S / stride⌉.

    Notes:
        Linear, with stride 1 self-adjoint. No running total, so nothing cancels in float32.
    """
    return box_sum_by_rows(lambda rows: x[:, :, rows], x.shape[2:], x, window, stride)


def box_sum_by_rows(values: Rows, shape: Sequence[int], like: Tensor, window: int, stride: int) -> Tensor:
    """Return `box_sum` of a field on ``shape``, of the type of ``like``, that is made slab by slab."""
    first, *others = (_windows(n, window, stride, like.dtype, like.device)[0] for n in shape)
    return multiply_by_rows(values, shape, like.device, first, others)


def box_sum_transpose(y: Tensor, window: int, stride: int, shape: tuple[int, ...]) -> Rows:
    """Return at each node Σ y over the windows that hold it: the transpose of `box_sum` on ``shape``.

    Args:
        y: ``(B, C, *W)``, one number for each window.
        window: width in nodes, odd.
        stride: nodes from one window to the next along every axis.
        shape: S.

    Returns:
        What gives some rows of the first axis of ``(B, C, *S)``.
    """
    return rows_of_product(y, [_windows(n, window, stride, y.dtype, y.device)[1] for n in shape])


def centres(x: Tensor, stride: int) -> Tensor:
    """Return the entries of ``(B, C, *S)`` at the nodes around which `box_sum` takes its windows."""
    for axis in range(2, x.dim()):
        x = _at_centres(x, axis, stride)
    return x


def _at_centres(x: Tensor, axis: int, stride: int) -> Tensor:
    """Return every ``stride``-th entry, what is left over shared out between both ends."""
    first = (x.shape[axis] - 1) % stride // 2
    return x[(slice(None),) * axis + (slice(first, None, stride),)]


@kept(64)
def _windows(size: int, window: int, stride: int, dtype: torch.dtype, device: torch.device) -> tuple[Banded, Banded]:
    """Return the matrix of ones where the window of a row holds the node of a column, and its transpose."""
    like = torch.empty(0, dtype=dtype, device=device)
    middle = _at_centres(torch.arange(size, device="cpu"), 0, stride).unsqueeze(1)
    nodes = middle + torch.arange(window, device="cpu") - window // 2
    inside = (nodes >= 0) & (nodes < size)
    rows, columns = torch.arange(len(middle), device="cpu").unsqueeze(1).expand_as(nodes)[inside], nodes[inside]
    ones, count = torch.ones(len(rows), dtype=torch.float32, device="cpu"), len(middle)
    return banded(rows, columns, ones, (count, size), like), banded(columns, rows, ones, (size, count), like)


@dataclass(frozen=True)
class Transfer:
    """Fields on two grids of one box.

    Args:
        fine: grid of the images.
        coarse: grid of the map, no finer along any axis.
        like: a tensor with the dtype and device of the result.
    """

    fine: Grid
    coarse: Grid
    like: Tensor

    def up(self, field: Tensor) -> Rows:
        """Return a field ``(B, C, *coarse)`` at the nodes of the fine grid, by linear interpolation."""
        return rows_of_product(field, self._ups)

    def gather(self, force: Rows) -> Tensor:
        """Return the force density on the coarse grid that does the same work as one ``(B, C, *fine)``.

        The transpose of `up`, divided by the number of fine nodes to a coarse one.

        Args:
            force: gives it in some rows of the first axis.
        """
        first, *others = self._downs
        return multiply_by_rows(force, self.fine.shape, self.like.device, first, others)

    @cached_property
    def _ups(self) -> list[Banded | None]:
        return [interpolation(few, many, self.like) for many, few in self._counts]

    @cached_property
    def _downs(self) -> list[Banded | None]:
        return [interpolation_transpose(many, few, self.like) for many, few in self._counts]

    @property
    def _counts(self) -> list[tuple[int, int]]:
        return list(zip(self.fine.shape, self.coarse.shape, strict=True))


# A level keeps at least this many nodes along an axis.
MIN_NODES = 8

# A level has at least this many along its longest axis: hippocampi (36×51×36) gain 0.008 Dice without their third one.
_MIN_LONGEST = 16

# Standard deviation of the smoothing before a level, in voxels of that level.
_BLUR = 0.5

# The word for linear interpolation in `F.interpolate`, and the means and maxima over windows, by dimension.
LINEAR_MODES = {2: "bilinear", 3: "trilinear"}
AVERAGE_POOL = {2: F.avg_pool2d, 3: F.avg_pool3d}
MAX_POOL = {2: F.max_pool2d, 3: F.max_pool3d}


def pyramid_grids(grid: Grid, levels: int) -> list[Grid]:
    """Return the grids of the levels, coarse to fine, the last being ``grid``.

    Args:
        grid: the finest grid.
        levels: number of levels at most.

    Returns:
        Grids of the same box. Each level has about twice the spacing of the next, counted from the smallest spacing, so
        thick slices are coarsened last. Levels with fewer than 16 nodes along every axis are left out.
    """
    grids = [grid]
    for level in range(1, levels):
        coarser = coarsened(grid, 2**level)
        if coarser.shape != grids[0].shape and max(coarser.shape) >= _MIN_LONGEST:
            grids.insert(0, coarser)
    return grids


def coarsened(grid: Grid, factor: float) -> Grid:
    """Return the grid of the same box whose spacing is about ``factor`` times the smallest one of ``grid``."""
    return with_spacing(grid, min(grid.spacing) * factor)


def with_spacing(grid: Grid, spacing: float) -> Grid:
    """Return the grid of the same box with about this spacing; larger ones stay, and so do 8 nodes of an axis."""
    return grid.with_shape(
        n if h >= spacing else min(n, max(MIN_NODES, round(side / spacing) + 1))
        for n, h, side in zip(grid.shape, grid.spacing, grid.extent, strict=True)
    )


def with_nodes(grid: Grid, most: int) -> Grid:
    """Return the grid of the same box with no more than so many nodes, of about one spacing; itself if it has not."""
    spacing, coarse = min(grid.spacing), grid
    while math.prod(coarse.shape) > most:
        spacing *= _COARSER
        coarse = with_spacing(grid, spacing)
    return coarse


def restrict(image: Tensor, grid: Grid, coarse: Grid) -> Tensor:
    """Return the image on a coarser grid of the same box, smoothed first so that nothing aliases.

    Args:
        image: ``(B, C, *S)`` on ``grid``.
        grid: its grid.
        coarse: the grid of the result.
    """
    counts = zip(grid.shape, coarse.shape, strict=True)
    return multiply(image, [restriction(many, few, _BLUR, image) for many, few in counts])


def prolong(u: Tensor, grid: Grid) -> Tensor:
    """Return a displacement on a finer grid of the same box, by linear interpolation between its nodes.

    Args:
        u: ``(B, D, *S)`` in units of spacing.
        grid: the grid of the result.
    """
    if tuple(u.shape[2:]) == grid.shape:
        return u
    return F.interpolate(u, size=grid.shape, mode=LINEAR_MODES[grid.dim], align_corners=True)
