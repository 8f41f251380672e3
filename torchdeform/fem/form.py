"""First-order least-squares forms as data: rows Σ c ∂_a v_k, each with a weight, and the div-curl form among them."""

from collections.abc import Callable
from dataclasses import dataclass
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
    """One equation Σ_terms = data of the system, and what a unit of its squared residual costs."""

    weight: Coefficient
    terms: tuple[Term, ...]


# The form a(v, w) = Σ_rows ∫ weight · row(v) · row(w), that is half the derivative of Σ_rows ∫ weight · row(v)².
Form = tuple[Row, ...]


def div_curl_form(dim: int, weights: Weights) -> Form:
    """Return the form of ∫ w_div (div v)² + w_curl |curl v|² + w_zero |v|².

    Args:
        dim: number of axes D.
        weights: w_div, w_curl and w_zero.

    Returns:
        One row for the divergence, one per component of the curl, and D for the values unless w_zero is the number 0.

    Notes:
        The least squares of Liu, Liao & Xue 2007, eq. (3.4) and (3.5), with the zeroth-order term A_0.
    """
    div = Row(weights.div, tuple(Term(1.0, k, k) for k in range(dim)))
    curl = [Row(weights.curl, (Term(1.0, b, a), Term(-1.0, a, b))) for a, b in CURL_PAIRS[dim]]
    has_values = isinstance(weights.zero, Tensor) or weights.zero > 0
    return (div, *curl, *(value_form(dim, weights.zero) if has_values else ()))


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
        Row(changed(r.weight), tuple(t._replace(coefficient=changed(t.coefficient)) for t in r.terms)) for r in form
    )
