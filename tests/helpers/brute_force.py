"""Oracles for finite elements, written without the package: dense matrices by Gauss quadrature, loop by loop."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

# (row, column) of the derivative matrix ∂_column v_row with their signs, one list per row of the form.
DIV_CURL = {
    2: [[(0, 0, 1), (1, 1, 1)], [(1, 0, 1), (0, 1, -1)]],
    3: [
        [(0, 0, 1), (1, 1, 1), (2, 2, 1)],
        [(2, 1, 1), (1, 2, -1)],
        [(0, 2, 1), (2, 0, -1)],
        [(1, 0, 1), (0, 1, -1)],
    ],
}


class Brute:
    """Q1 elements on a box: every integral a sum over the Gauss points of every element."""

    def __init__(self, shape: tuple[int, ...], spacing: tuple[float, ...], points: int = 3) -> None:
        self.shape, self.spacing, self.dim = shape, spacing, len(shape)
        self.nodes = np.arange(math.prod(shape)).reshape(shape)
        self.corners = list(itertools.product((0, 1), repeat=self.dim))
        places, weights = np.polynomial.legendre.leggauss(points)
        self.gauss = [
            (q, math.prod(w) * math.prod(spacing) / 2**self.dim)
            for q, w in zip(
                itertools.product((places + 1) / 2, repeat=self.dim),
                itertools.product(weights, repeat=self.dim),
                strict=True,
            )
        ]

    def shape_function(self, corner: tuple[int, ...], q: tuple[float, ...], axis: int | None) -> float:
        """∂_axis N_corner at q of the unit element (N itself for None)."""
        value = 1.0
        for a in range(self.dim):
            if a == axis:
                value *= (1 if corner[a] else -1) / self.spacing[a]
            else:
                value *= q[a] if corner[a] else 1 - q[a]
        return value

    def unknowns(self, element: tuple[int, ...], components: int) -> list[int]:
        local = [int(self.nodes[tuple(e + c for e, c in zip(element, corner, strict=True))]) for corner in self.corners]
        return [k * self.nodes.size + n for k in range(components) for n in local]

    def row(self, terms, q: tuple[float, ...], components: int) -> np.ndarray:
        """Σ c ∂_axis v_k at q as a vector over the unknowns of an element; ``terms`` holds (k, axis, c)."""
        vector = np.zeros((components, len(self.corners)))
        for k, axis, c in terms:
            vector[k] += [c * self.shape_function(corner, q, axis) for corner in self.corners]
        return vector.flatten()

    def places(self, centre: bool):
        """Points and weights of the rule: Gauss points, or the middle of the element."""
        return [((0.5,) * self.dim, math.prod(self.spacing))] if centre else self.gauss

    def matrix(self, rows: Callable, components: int) -> Tensor:
        """Dense matrix of Σ weight row(v)²; ``rows(element, q index)`` gives (weight, terms, at the centre?)."""
        total = np.zeros((components * self.nodes.size,) * 2)
        for element in itertools.product(*(range(n - 1) for n in self.shape)):
            local = np.zeros((components * len(self.corners),) * 2)
            for centre in (False, True):
                for index, (q, volume) in enumerate(self.places(centre)):
                    for weight, terms, at in map(whole_row, rows(element, index)):
                        if at == centre:
                            vector = self.row(terms, q, components)
                            local += volume * weight * np.outer(vector, vector)
            where = self.unknowns(element, components)
            total[np.ix_(where, where)] += local
        return torch.from_numpy(total)

    def load(self, rows: Callable, data: Tensor, components: int) -> Tensor:
        """Dense right-hand side of Σ weight data_row row(N), ``data (R, *S)`` interpolated between its nodes."""
        return self.load_matrix(rows, len(data), components) @ data.flatten()

    def load_matrix(self, rows: Callable, channels: int, components: int) -> Tensor:
        """Dense matrix from nodal data to right-hand sides; a row that is looked at in parts has its one channel."""
        total = np.zeros((components * self.nodes.size, channels * self.nodes.size))
        for element in itertools.product(*(range(n - 1) for n in self.shape)):
            tested, given = self.unknowns(element, components), np.array(self.unknowns(element, 1))
            for centre in (False, True):
                for index, (q, volume) in enumerate(self.places(centre)):
                    values = np.array([self.shape_function(c, q, None) for c in self.corners])
                    some = [row for row in map(whole_row, rows(element, index)) if row[2] == centre]
                    for channel, (weight, terms, _) in zip(range(channels), some, strict=False):
                        column = channel * self.nodes.size + given
                        work = volume * weight * np.outer(self.row(terms, q, components), values)
                        total[np.ix_(tested, column)] += work
        return torch.from_numpy(total)

    def div_curl(self, div=1.0, curl=1.0, zero=0.0, strain=0.0) -> Callable:
        """Rows of the div-curl form; a weight is a number or an array over the elements.

        Divergence and curl count exactly up to twice the weight of the other, and at the centre beyond that.
        """

        def at(weight, element):
            return weight if isinstance(weight, float) else float(weight[element])

        def rows(element, index):
            first, *others = DIV_CURL[self.dim]
            w_div, w_curl, w_strain = (at(weight, element) for weight in (div, curl, strain))
            for part, centre in ((min(w_div, 2 * w_curl), False), (max(w_div - 2 * w_curl, 0.0), True)):
                yield part, first, centre
            for part, centre in ((min(w_curl, 2 * w_div), False), (max(w_curl - 2 * w_div, 0.0), True)):
                yield from ((part, other, centre) for other in others)
            if not isinstance(zero, float) or zero > 0:
                yield from ((at(zero, element), [(k, None, 1.0)]) for k in range(self.dim))
            if w_strain > 0:
                yield from ((w_strain * c, terms) for c, terms in deviatoric(self.dim))

        return rows


def whole_row(row):
    """(weight, terms, at the centre?) of a row that may not say where."""
    return row if len(row) == 3 else (*row, False)


def deviatoric(dim: int):
    """Σ_ij (dev sym ∇v)_ij² entry by entry, with factors."""
    for i, j in itertools.product(range(dim), repeat=2):
        terms = [(i, j, 0.5), (j, i, 0.5)]
        if i == j:
            terms += [(k, k, -1 / dim) for k in range(dim)]
        yield 1.0, terms
