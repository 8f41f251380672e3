"""Mutual information of intensities, from a joint histogram whose bins overlap smoothly (Parzen windows)."""

from collections.abc import Callable, Sequence
from itertools import product

import torch
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.metrics.base import (
    IntensityRange,
    Similarity,
    at_least_float32,
    mean,
    on_unit_scale,
    relative_weight,
    weighted,
)

# The kernels as polynomials: row k holds the coefficients of 1, t, t², .. of what bin i + k gets from a value that is
# t after the start of cell i.
_CUBIC = (
    (1 / 6, -3 / 6, 3 / 6, -1 / 6),
    (4 / 6, 0, -6 / 6, 3 / 6),
    (1 / 6, 3 / 6, 3 / 6, -3 / 6),
    (0, 0, 0, 1 / 6),
)
_LINEAR = ((1, -1), (0, 1))

# Histograms are summed in multiples of this: sums of whole numbers do not depend on their order, so a GPU gives the
# same bits each time. 2^26 voxels fit into 64 bits.
_QUANTUM = 2.0**-36

_FEWEST_BINS = 5

# That of a histogram, which is smooth, is far above it; it stands for that of an empty one.
_LEAST_ENTROPY = 1e-12

# Voxels that are worked on at a time: on a CPU their numbers stay in its cache, elsewhere the memory is bounded.
_PIECE = {"cpu": 2**16}
_LARGE_PIECE = 2**22

# S ``(T,)`` of tables P ``(T, bins of warped, bins of fixed)``, and ∂S/∂P up to terms that the kernels cancel.
_Measure = Callable[[Tensor], tuple[Tensor, Tensor]]


class MutualInformation(Similarity):
    """S = Σ P log(P / (P_w P_f)), P being the joint histogram of warped and fixed intensities, or S = (H_w + H_f) / H.

    Args:
        fixed: ``(B, C, *S)``, scaled to about [0, 1]; what is outside counts as 0 or 1.
        normalised: S = (H_w + H_f) / H with the entropies H of P, P_w and P_f, between 1 and 2.
        bins: along each axis of the histogram, at least 5.

    Raises:
        InputError: too few bins.

    Notes:
        A warped intensity is shared among 4 bins by the cubic B-spline, a fixed one between 2 by the hat function. Both
        are polynomials of the places t, s inside a cell of the histogram, so 8 moments Σ tᵖ sᑫ of each cell are summed
        up, and ∂S/∂warped is one polynomial in each cell, of 6 coefficients. Channels have a histogram each.
    """

    def __init__(self, fixed: Tensor, *, normalised: bool = False, bins: int = 32) -> None:
        self.measure, self.bins = _normalised if normalised else _mutual, _checked_bins(bins)
        cell, place = _cells(at_least_float32(fixed), bins - 1)
        self.cell, self.place = (cell + _first_cells(fixed, (bins - 3) * (bins - 1))).flatten(), place.flatten()

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        warped = at_least_float32(warped)
        weight = relative_weight(mask, warped)
        tables, flat = warped.shape[0] * warped.shape[1], warped.flatten()
        moments = self._moments(flat, None if weight is None else weight.expand_as(warped).flatten(), tables)
        value, slope = self.measure(self._table(moments / warped[0, 0].numel()))
        derivative = self._derivative(flat, self._coefficients(slope).to(flat.dtype)).view(warped.shape)
        return value.view(warped.shape[:2]).mean(1).to(warped.dtype), weighted(derivative, weight)

    def _locate(self, warped: Tensor, piece: slice) -> tuple[Tensor, Tensor, Tensor]:
        """Return the cell (i, j) of some voxels, and t and s, the places inside it."""
        row, t = _cells(warped[piece], self.bins - 3)
        return row.mul_(self.bins - 1).add_(self.cell[piece]), t, self.place[piece]

    def _moments(self, warped: Tensor, weight: Tensor | None, tables: int) -> Tensor:
        """Return Σ weight · sᑫ tᵖ in each cell, in float64: ``(q, p, B·C, i, j)``."""
        rows, columns = self.bins - 3, self.bins - 1
        sums = self.cell.new_zeros(len(_LINEAR) * len(_CUBIC), tables * rows * columns)
        for piece in _pieces(warped):
            cell, t, s = self._locate(warped, piece)
            line = torch.full_like(t, 1 / _QUANTUM) if weight is None else weight[piece] / _QUANTUM
            terms = torch.stack([line, line * s]).unsqueeze(1) * torch.stack([torch.ones_like(t), t, t * t, t * t * t])
            sums.scatter_add_(1, cell.expand(len(sums), -1), terms.flatten(0, 1).long())
        return sums.view(len(_LINEAR), len(_CUBIC), tables, rows, columns).double() * _QUANTUM

    def _table(self, moments: Tensor) -> Tensor:
        """Return P ``(B·C, bins, bins)``: what each cell gives to the bins around it."""
        shares = torch.einsum("qptij,kp,mq->kmtij", moments, *_kernels(moments))
        table = moments.new_zeros(moments.shape[2], self.bins, self.bins)
        for k, m in product(range(len(_CUBIC)), range(len(_LINEAR))):
            table[:, k : k + self.bins - 3, m : m + self.bins - 1] += shares[k, m]
        return table

    def _coefficients(self, slope: Tensor) -> Tensor:
        """Return those of tᵖ sᑫ in Σ ∂S/∂P[i + k, j + m] (bins − 3) cubic'_k(t) linear_m(s): ``(q·p, cell)``."""
        cubic, linear = _kernels(slope)
        cubic = cubic[:, 1:] * slope.new_tensor([power * (self.bins - 3) for power in range(1, len(_CUBIC))])
        blocks = slope.unfold(1, len(_CUBIC), 1).unfold(2, len(_LINEAR), 1)
        return torch.einsum("tijkm,kp,mq->qptij", blocks, cubic, linear).flatten(2).flatten(0, 1)

    def _derivative(self, warped: Tensor, coefficients: Tensor) -> Tensor:
        """Return the polynomial of its cell at every voxel, 0 where an intensity was cut off."""
        derivative = torch.empty_like(warped)
        for piece in _pieces(warped):
            cell, t, s = self._locate(warped, piece)
            inside = (warped[piece] >= 0) & (warped[piece] <= 1)
            local = coefficients.index_select(1, cell).view(len(_LINEAR), -1, len(t))
            lines = (local[:, 2] * t).add_(local[:, 1]).mul_(t).add_(local[:, 0])
            derivative[piece] = torch.addcmul(lines[0], lines[1], s).mul_(inside)
        return derivative


def mutual_information(
    fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None, bins: int = 32, intensity_range: IntensityRange = None
) -> Tensor:
    """Return S = Σ P log(P / (P_w P_f)), P being the joint histogram of warped and fixed intensities.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.
        bins: along each axis of the histogram, at least 5.
        intensity_range: intensities of the first and the last bin, which also get what is outside; None: the smallest
            and the largest of each image where the mask is positive.

    Returns:
        ``(B,)`` in nats, the mean over channels; 0 for independent images.

    Raises:
        InputError: shapes, too few bins.

    Notes:
        Bins overlap as in `MutualInformation`, which has the derivative in closed form. Differentiable, no derivative
        going through the range. Viola & Wells 1997; Thévenaz & Unser 2000.
    """
    return _from_images((fixed, warped), mask, bins, intensity_range, _mutual)


def normalised_mutual_information(
    fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None, bins: int = 32, intensity_range: IntensityRange = None
) -> Tensor:
    """Return S = (H_w + H_f) / H, the entropies of warped, of fixed and of both together.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.
        bins: as for `mutual_information`.
        intensity_range: as for `mutual_information`.

    Returns:
        ``(B,)`` between 1 and 2, the mean over channels; 1 for independent images.

    Raises:
        InputError: shapes, too few bins.

    Notes:
        As `mutual_information`, but does not grow with the part of the images that overlaps. Studholme, Hill & Hawkes,
        "An overlap invariant entropy measure of 3D medical image alignment", 1999.
    """
    return _from_images((fixed, warped), mask, bins, intensity_range, _normalised)


def _from_images(
    images: tuple[Tensor, Tensor], mask: Tensor | None, bins: int, intensity_range: IntensityRange, measure: _Measure
) -> Tensor:
    """Return S from the histogram itself, summed in float64, which autograd can follow."""
    _checked_bins(bins)
    fixed, warped = on_unit_scale(*images, mask, intensity_range)
    if len(fixed) == 0:
        return mean(warped)
    weight = relative_weight(mask, warped)
    column, s = _cells(fixed, bins - 1)
    row, t = _cells(warped, bins - 3)
    cell = (_first_cells(warped, bins**2) + row * bins + column).flatten()
    table = torch.zeros(warped.shape[0] * warped.shape[1] * bins**2, dtype=torch.float64, device=warped.device)
    for (k, cubic), (m, linear) in product(enumerate(_CUBIC), enumerate(_LINEAR)):
        share = weighted(_polynomial(cubic, t) * _polynomial(linear, s), weight)
        table = table.scatter_add(0, cell + k * bins + m, share.double().flatten())
    value, _ = measure(table.view(-1, bins, bins) / warped[0, 0].numel())
    return value.view(warped.shape[:2]).mean(1).to(warped.dtype)


def _mutual(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return S = Σ P log(P / (P_w P_f)) and log(P / (P_w P_f))."""
    joint, warped, fixed = _logarithms(table)
    slope = joint - warped - fixed
    return (table * slope).sum(dim=(1, 2)), slope


def _normalised(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return S = (H_w + H_f) / H and (S log P − log P_w − log P_f) / H."""
    joint, warped, fixed = _logarithms(table)
    entropy = -(table * joint).sum(dim=(1, 2), keepdim=True).clamp(max=-_LEAST_ENTROPY)
    value = -(table * (warped + fixed)).sum(dim=(1, 2), keepdim=True) / entropy
    return value.flatten(), (value * joint - warped - fixed) / entropy


def _logarithms(table: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return log P, log P_w and log P_f, finite where these are 0."""
    tiny = torch.finfo(table.dtype).tiny
    joint, warped, fixed = (
        part.clamp(min=tiny).log() for part in (table, table.sum(2, keepdim=True), table.sum(1, keepdim=True))
    )
    return joint, warped, fixed


def _cells(image: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return in which of ``count`` cells between 0 and 1 each value is, and where in that cell, from 0 to 1."""
    place = image.clamp(0, 1) * count
    cell = place.detach().long().clamp_(0, count - 1)
    return cell, place - cell


def _first_cells(image: Tensor, cells: int) -> Tensor:
    """Return the number of the first cell of each item and channel ``(B, C, 1, ..)``, tables of ``cells`` in a row."""
    items, channels, *shape = image.shape
    numbers = torch.arange(items * channels, device=image.device) * cells
    return numbers.view(items, channels, *([1] * len(shape)))


def _pieces(values: Tensor) -> list[slice]:
    """Return slices of a flat tensor, one for each piece that is worked on at a time."""
    step = _PIECE.get(values.device.type, _LARGE_PIECE)
    return [slice(start, start + step) for start in range(0, len(values), step)]


def _polynomial(coefficients: Sequence[Tensor | float], x: Tensor) -> Tensor:
    """Return Σ coefficient_p xᵖ by Horner's rule."""
    *lower, highest = coefficients
    total = torch.zeros_like(x) + highest
    for coefficient in reversed(lower):
        total = total * x + coefficient
    return total


def _kernels(like: Tensor) -> tuple[Tensor, Tensor]:
    return like.new_tensor(_CUBIC), like.new_tensor(_LINEAR)


def _checked_bins(bins: int) -> int:
    if bins < _FEWEST_BINS:
        raise InputError(f"mutual information: bins must be at least {_FEWEST_BINS}, got {bins}")
    return bins
