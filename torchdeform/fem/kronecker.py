"""Forms with constant coefficients applied without a matrix: sums of Kronecker products of tridiagonal 1D matrices.

∫ ∂_a N ∂_b N over a box is a product over its axes of the assembled 1D matrices M = ∫NᵢNⱼ, K = ∫Nᵢ'Nⱼ', C = ∫Nᵢ'Nⱼ, Cᵀ.
Integration by parts, Cᵀ = E − C with E = diag(−1, 0, .., 0, 1), leaves one mixed matrix and a term on two faces. So
couplings between components that cancel inside (all of them when w_div = w_curl) cancel as numbers, before the work.
"""

from collections import defaultdict
from functools import lru_cache

from torch import Tensor
from torch.autograd import Function

from torchdeform.core.grid import Grid, over_items
from torchdeform.fem.elements import INTERVAL, Factor, Matrix

# One product: coefficient, output component, input component, one factor per axis.
Product = tuple[float, int, int, tuple[Factor, ...]]

# Products as (factors, coefficient), the powers of the spacing multiplied in.
_Terms = list[tuple[tuple[Factor, ...], float]]


def apply_products(products: tuple[Product, ...], x: Tensor, grid: Grid, outputs: int) -> Tensor:
    """Return y with y_i = Σ coefficient · (⊗_axis matrix) x_j over the products from j to i.

    Args:
        products: the sum.
        x: nodal values ``(B, C, *S)``.
        grid: the grid.
        outputs: number of output components.

    Returns:
        ``(B, outputs, *S)``.

    Notes:
        Linear; its derivative is the transposed sum, to every degree. The vector Laplacian takes 8 tridiagonal products
        per component in 3D, each three passes over one component.
    """
    return _Apply.apply(x, products, grid, outputs)


class _Apply(Function):
    @staticmethod
    def forward(x: Tensor, products: tuple[Product, ...], grid: Grid, outputs: int) -> Tensor:
        out = x.new_zeros(x.shape[0], outputs, *grid.shape)
        for (target, source, face_axis), terms in _plan(products, grid.spacing).items():
            _add(out[:, target], terms, x[:, source], face_axis)
        return out

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        x, *ctx.settings = inputs
        ctx.inputs = x.shape[1]

    @staticmethod
    def jvp(ctx, tangent: Tensor, *_: None) -> Tensor:
        return _Apply.apply(tangent, *ctx.settings)

    @staticmethod
    def vmap(info, in_dims, x: Tensor, products: tuple[Product, ...], grid: Grid, outputs: int):
        return over_items(lambda items: _Apply.apply(items, products, grid, outputs), x, in_dims[0]), 0

    @staticmethod
    def backward(ctx, *grads: Tensor):
        products, grid, _ = ctx.settings
        transposed = tuple((c, j, i, tuple((b, a, mean) for a, b, mean in factors)) for c, i, j, factors in products)
        return apply_products(transposed, grads[0], grid, ctx.inputs), None, None, None


@lru_cache(maxsize=256)
def _plan(products: tuple[Product, ...], spacing: tuple[float, ...]) -> dict[tuple[int, int, int | None], _Terms]:
    """Collect the products to i from j with E along one axis, or none, under (i, j, axis); what cancels is left out."""
    sums: dict = defaultdict(lambda: defaultdict(float))
    for coefficient, target, source, factors in products:
        for h, factor in zip(spacing, factors, strict=True):
            coefficient *= h ** INTERVAL[factor][1]
        for sign, face_axis, expanded in _by_parts(factors):
            sums[target, source, face_axis][expanded] += sign * coefficient
    plan = {key: [(f, c) for f, c in terms.items() if c != 0] for key, terms in sums.items()}
    return {key: terms for key, terms in plan.items() if terms}


def _by_parts(factors: tuple[Factor, ...]) -> list[tuple[float, int | None, tuple[Factor, ...]]]:
    """Replace Cᵀ by E − C; a product of two first derivatives has at most one Cᵀ."""
    if (False, True, False) not in factors:
        return [(1.0, None, factors)]
    axis = factors.index((False, True, False))
    expanded = (*factors[:axis], (True, False, False), *factors[axis + 1 :])
    return [(1.0, axis, expanded), (-1.0, None, expanded)]


def _add(out: Tensor, terms: _Terms, x: Tensor, face_axis: int | None) -> None:
    """Add Σ terms x to ``out (B, *S)``; E along ``face_axis`` takes −x at its first nodes and x at its last ones."""
    axes = tuple(a for a in range(x.dim() - 1) if a != face_axis)
    if face_axis is None:
        out.add_(_evaluate(terms, x, axes))
        return
    for node, sign in ((0, -1.0), (x.shape[1 + face_axis] - 1, 1.0)):
        face = x.narrow(1 + face_axis, node, 1)
        out.narrow(1 + face_axis, node, 1).add_(_evaluate(terms, face, axes), alpha=sign)


def _evaluate(terms: _Terms, x: Tensor, axes: tuple[int, ...]) -> Tensor:
    """Return Σ coefficient · (⊗_axes matrix) x; products with the same factor along the first axis share that pass."""
    axis, rest = axes[0], axes[1:]
    if not rest:
        return _tridiagonal(x, axis, [(INTERVAL[factors[axis]][0], c) for factors, c in terms])
    total = None
    for factor in dict.fromkeys(factors[axis] for factors, _ in terms):
        inner = _evaluate([t for t in terms if t[0][axis] == factor], x, rest)
        total = _tridiagonal(inner, axis, [(INTERVAL[factor][0], 1.0)], total)
    return x if total is None else total


def _tridiagonal(x: Tensor, axis: int, parts: list[tuple[Matrix, float]], out: Tensor | None = None) -> Tensor:
    """Add the assembly of Σ c·m, 2×2, over the intervals of one axis times ``x (B, *S)`` to ``out``, new when None."""
    (a, b), (c, d) = [[sum(scale * m[i][j] for m, scale in parts) for j in (0, 1)] for i in (0, 1)]
    dim, last = axis + 1, x.shape[axis + 1] - 1
    out = x * (a + d) if out is None else out.add_(x, alpha=a + d)
    out.narrow(dim, 0, last).add_(x.narrow(dim, 1, last), alpha=b)
    out.narrow(dim, 1, last).add_(x.narrow(dim, 0, last), alpha=c)
    out.select(dim, 0).sub_(x.select(dim, 0), alpha=d)
    out.select(dim, last).sub_(x.select(dim, last), alpha=a)
    return out
