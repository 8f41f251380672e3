"""First-order least-squares forms as data: rows Σ c ∂_a v_k, each with a weight, and the div-curl form among them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.fem.weights import Weights

# A number, or a tensor (B or 1, Q, *E): Q = 1 for one value per element, Q = 2^D for one per Gauss point of it (in the
# order of its corners); E_k = n_k − 1 elements along axis k, or 1 where it does not vary.
Coefficient = float | Tensor


class Term(NamedTuple):
    """c ∂_axis v_component, or c v_component when ``axis`` is None."""

    coefficient: Coefficient
    component: int
    axis: int | None


@dataclass(frozen=True)
class Row:
    """One equation Σ_terms = data of the system, and what a unit of its squared residual costs.

    With ``centre`` it is looked at in the middle of each element alone, where derivatives are their means over it; its
    coefficients then do not vary within elements.
    """

    weight: Coefficient
    terms: tuple[Term, ...]
    centre: bool = False


# The form a(v, w) = Σ_rows ∫ weight · row(v) · row(w), that is half the derivative of Σ_rows ∫ weight · row(v)².
Form = tuple[Row, ...]


def div_curl_form(dim: int, weights: Weights) -> Form:
    """Return the form of ∫ w_div (div v)² + w_curl |curl v|² + w_strain |dev sym ∇v|² + w_zero |v|².

    Args:
        dim: number of axes D.
        weights: w_div, w_curl, w_strain and w_zero.

    Returns:
        The rows of `div_form`, `curl_form`, `strain_form` and `value_form`, without those whose weight is the number 0.

    Notes:
        The least squares of Liu, Liao & Xue 2007, eq. (3.4) and (3.5), with the zeroth-order term A_0 and a strain.
    """
    rows = div_form(dim, weights), curl_form(dim, weights), strain_form(dim, weights.strain)
    return priced((*sum(rows, start=()), *value_form(dim, weights.zero)))


def div_form(dim: int, weights: Weights) -> Form:
    """Return the form of ∫ w_div (div v)²: a row up to 2 w_curl, and one at the centres for what is above that.

    Notes:
        Divergence and curl at every point of an element are more than its corners can make small: with one much dearer
        than the other the elements lock, and the error grows with their ratio. At the centres alone they do not, and
        what vanishes there is held by what is integrated exactly.
    """
    return _in_parts([tuple(Term(1.0, k, k) for k in range(dim))], weights.parts[0])


def curl_form(dim: int, weights: Weights) -> Form:
    """Return the form of ∫ w_curl |curl v|²: a row for each component of the curl, then again as in `div_form`."""
    turns = [(Term(1.0, b, a), Term(-1.0, a, b)) for a, b in CURL_PAIRS[dim]]
    return _in_parts(turns, weights.parts[1])


def strain_form(dim: int, weight: Coefficient) -> Form:
    """Return the form of ∫ w |dev sym ∇v|², which rigid motions and dilations have 0 of.

    Notes:
        |dev sym ∇v|² = Σ_{a<b} ½ (∂_a v_b + ∂_b v_a)² + (∂_a v_a − ∂_b v_b)² / D: two rows for each pair of axes.
    """
    half, part = math.sqrt(1 / 2), math.sqrt(1 / dim)
    pairs = list(combinations(range(dim), 2))
    shears = [(Term(half, b, a), Term(half, a, b)) for a, b in pairs]
    stretches = [(Term(part, a, a), Term(-part, b, b)) for a, b in pairs]
    return tuple(Row(weight, terms) for terms in (*shears, *stretches))


def _in_parts(equations: Sequence[tuple[Term, ...]], weights: tuple[Coefficient, Coefficient]) -> Form:
    return tuple(Row(w, terms, at) for w, at in zip(weights, (False, True), strict=True) for terms in equations)


def priced(form: Form) -> Form:
    """Return the form without the rows that cost nothing."""
    return tuple(row for row in form if isinstance(row.weight, Tensor) or row.weight > 0)


def value_form(dim: int, weight: Coefficient = 1.0) -> Form:
    """Return the form of ∫ weight |v|²: one row for each component of v."""
    return tuple(Row(weight, (Term(1.0, k, None),)) for k in range(dim))


def gradient_form(dim: int, components: int = 1) -> Form:
    """Return the form of Σ_k ∫ |∇v_k|²; its rows are ∂_a v_k with a running fastest."""
    return tuple(Row(1.0, (Term(1.0, k, a),)) for k in range(components) for a in range(dim))


def map_coefficients(form: Form, change: Callable[[Tensor], Tensor]) -> Form:
    """Return the form with ``change`` applied to every weight and coefficient that is a tensor."""

    def changed(c: Coefficient) -> Coefficient:
        return change(c) if isinstance(c, Tensor) else c

    return tuple(
        replace(
            r, weight=changed(r.weight), terms=tuple(t._replace(coefficient=changed(t.coefficient)) for t in r.terms)
        )
        for r in form
    )
