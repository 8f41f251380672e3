"""Weights that are dearer by any factor on some elements, solved for the stress there.

Let K = A + Cᵀ e C (see `excess`), A the matrix of constant weights that transforms invert. With the stress p = e C v of
what is dearer, v = A⁻¹ (load − Cᵀ p), where

    (e⁻¹ + C A⁻¹ Cᵀ) p = C A⁻¹ load.

Conjugate gradients for p = s q see none of the motions that cost nothing there, and how dear the others are matters
little: C A⁻¹ Cᵀ is near a projection. Its inverse is nearly that on the whole grid, cut off,

    (ε + C A⁻¹ Cᵀ)⁻¹ = (1 − C (ε A + CᵀC)⁻¹ Cᵀ)/ε,

by one more transform. So a step costs two transforms, and products on the dear elements alone.
"""

import torch
from torch import Tensor

from torchdeform.fem.excess import Excess, excesses
from torchdeform.fem.fast_transform import FastTransform, transform_is_exact
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.base import Status
from torchdeform.solvers.cg import Operator, Settings, norms, solve

# ε: how much of A regularises the inverse on the whole grid.
_SHARE = 0.1
# From which ratio to the base on this pays; below which part of the dearest kind of row another is a minor one.
_DEAR, _MINOR = 30.0, 0.01


def suits(system: DivCurlSystem) -> bool:
    """Tell whether some elements are far dearer than others, none much cheaper, and transforms invert the base."""
    if system.also_fixed is not None or system.weights.constant:
        return False
    weights = system.weights.detached()
    base, like = weights.base(system.grid.dim), next(w for w in weights.tensors if w.dim() > 0)
    if not transform_is_exact(system.grid, base, system.boundary):
        return False
    over = torch.stack([torch.stack(e.aminmax()) for e in excesses(weights, base, system.grid, like)])
    scale = _scale(base)
    return bool((over[:, 0].amin() >= -1e-6 * scale) & (over[:, 1].amax() > _DEAR * scale))


class StressGuess:
    """v with K v = load by conjugate gradients for the stress, a `Guess`.

    Args:
        system: a system that `suits`.
        like: a tensor with the type and device of the loads.

    Notes:
        Dear rows share one scale, which keeps the search among stresses that a motion can have; a minor kind of row, or
        one that is alone, can have any, and its scale is bounded where its excess falls off.
    """

    def __init__(self, system: DivCurlSystem, like: Tensor) -> None:
        weights = system.weights.detached().to(like)
        base = weights.base(system.grid.dim)
        self.excess, scale = Excess(system.grid, weights, base, like), _scale(base)
        means, limit = [float(e.mean()) for e in self.excess.excess], scale / _SHARE
        minor = [mean < _MINOR * max(means) for mean in means]
        lone = sum(n for n, small in zip(self.excess.rows, minor, strict=True) if not small) == 1
        units = [scale if small else scale * mean / max(means) for small, mean in zip(minor, means, strict=True)]
        weigh, local, back = [], [], []
        for small, unit, e in zip(minor, units, self.excess.excess, strict=True):
            dearest = e.amax(dim=2, keepdim=True)
            dearest = torch.where(dearest > 0, dearest, 1)  # an item may have nothing that is dear
            bounded = small or lone
            stretch = (e / (e + limit) if bounded else e / dearest).sqrt()
            weigh.append(unit**0.5 * stretch)
            local.append(unit / (e + limit) if bounded else (unit / dearest).expand_as(e))
            back.append(e / (unit**0.5 * stretch).clamp(min=1e-30))
        self.weigh, self.local, self.back = (self.excess.by_row(f) for f in (weigh, local, back))
        shares = [u * m / (m + limit) if s else u for s, u, m in zip(minor, units, means, strict=True)]
        whole = _plus(base, dict(zip(self.excess.kinds, shares, strict=True)), system.grid.dim)
        exact, near = FastTransform(), FastTransform(approximate=True)
        self.soft = exact.init(DivCurlSystem(system.grid, base, system.boundary), like)
        self.dear = near.init(DivCurlSystem(system.grid, whole, system.boundary), like)

    def __call__(self, b: Tensor, tolerance: Tensor, max_steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return v, the steps, and which items met the tolerance on their load, as far as rounding lets them."""
        free = self.soft(b)
        settings = Settings(self._precondition, 0.0, tolerance, max_steps, norm=self._load_norm, restart=False)
        found = solve(Operator(self._stiffness), self._stressed(free), None, settings)
        v = free - self.soft(self._force(found.value))
        met = [status in (Status.CONVERGED, Status.ROUNDING) for status in found.status]
        return v, found.steps, torch.tensor(met, device=b.device)

    def _stressed(self, v: Tensor) -> Tensor:
        """Return s C v."""
        return self.excess.of(v) * self.weigh

    def _force(self, q: Tensor) -> Tensor:
        """Return Cᵀ s q."""
        return self.excess.transposed(q * self.weigh)

    def _stiffness(self, q: Tensor) -> Tensor:
        return self._stressed(self.soft(self._force(q))).addcmul_(q, self.local)

    def _precondition(self, r: Tensor) -> Tensor:
        return (r - self._stressed(self.dear(self._force(r)))) / _SHARE

    def _load_norm(self, r: Tensor) -> Tensor:
        """What a residual of the stress leaves of the load."""
        return norms(self.excess.transposed(r * self.back))


def _scale(base: Weights) -> float:
    """The largest weight of the base."""
    return max(float(torch.as_tensor(w).max()) for w in (base.div, base.curl))


def _plus(base: Weights, shares: dict[str, float], dim: int) -> Weights:
    """Return ε base + the shares, as weights that the transforms take."""
    div, curl, zero, strain = (shares.get(name, 0.0) for name in ("div", "curl", "zero", "strain"))
    div, curl = div + shares.get("div_centre", 0.0), curl + shares.get("curl_centre", 0.0)
    own = Weights(_SHARE * base.div + div, _SHARE * base.curl + curl, _SHARE * base.zero + zero, strain)
    return own.without_strain(dim)
