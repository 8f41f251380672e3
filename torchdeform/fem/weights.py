"""The weights of the div-curl least squares: what a unit of divergence, of rotation and of velocity costs."""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError

Weight = float | Tensor


@dataclass(frozen=True)
class Weights:
    """Weights of ∫ w_div (div v − α)² + w_curl |curl v − β|² + w_zero |v|².

    Args:
        div: w_div > 0. A number, or a tensor ``(B or 1, 1, *E)`` with one value per element, E_k = n_k − 1, or 1 where
            it does not vary.
        curl: w_curl > 0, as ``div``.
        zero: w_zero ≥ 0 per squared unit of spacing, as ``div``; √(w_div / w_zero) is the length beyond which v decays.

    Raises:
        InputError: a number out of range (values of tensors are looked at by `check`).
    """

    div: Weight = 1.0
    curl: Weight = 1.0
    zero: Weight = 0.0

    def __post_init__(self) -> None:
        for name, value in self._items():
            if not isinstance(value, Tensor):
                _require_range(name, float(value), float(value))

    def check(self, grid: Grid) -> None:
        """Raise `InputError` unless shapes fit the elements of ``grid`` and every value is in range."""
        for name, value in self._items():
            if not isinstance(value, Tensor):
                continue
            fits = value.dim() == 0 or (
                value.dim() == grid.dim + 2
                and value.shape[1] == 1
                and all(e in (1, n - 1) for e, n in zip(value.shape[2:], grid.shape, strict=True))
            )
            if not fits:
                want = ", ".join(str(n - 1) for n in grid.shape)
                raise InputError(
                    f"Weights: {name} must be a number or have shape (B, 1, {want}), got {tuple(value.shape)}"
                )
            _require_range(name, *torch.stack(value.detach().aminmax()).tolist())

    @property
    def constant(self) -> bool:
        """True when no weight varies over space (it may still vary over the batch)."""
        return all(w.shape[1:].numel() == 1 for w in self.tensors)

    @property
    def isotropic(self) -> bool:
        """True when w_div = w_curl for certain: tensors that agree while each wants its own gradient do not count."""
        if self.div is self.curl:
            return True
        tensors = [w for w in (self.div, self.curl) if isinstance(w, Tensor)]
        sizes = {w.numel() if isinstance(w, Tensor) else 1 for w in (self.div, self.curl)}
        if len(sizes) > 1 or any(w.requires_grad for w in tensors):
            return False
        same = self.div == self.curl
        return bool(same.all()) if isinstance(same, Tensor) else same

    @property
    def zero_positive(self) -> bool:
        """True when w_zero > 0 everywhere."""
        return bool((self.zero > 0).all()) if isinstance(self.zero, Tensor) else self.zero > 0

    def mean(self) -> "Weights":
        """Return the weights averaged over the elements of each batch item."""
        return Weights(**{name: _mean(w) for name, w in self._items()})

    def to(self, like: Tensor) -> "Weights":
        """Return the weights with tensors moved to the type and device of ``like``."""
        return self.with_tensors(tuple(w.to(like) for w in self.tensors))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The weights that are tensors, in the order div, curl, zero."""
        return tuple(w for _, w in self._items() if isinstance(w, Tensor))

    def with_tensors(self, tensors: tuple[Tensor, ...]) -> "Weights":
        """Return the weights with those that are tensors replaced, in the order of `tensors`."""
        rest = iter(tensors)
        return Weights(**{name: next(rest) if isinstance(w, Tensor) else w for name, w in self._items()})

    def _items(self) -> list[tuple[str, Weight]]:
        return [(f.name, getattr(self, f.name)) for f in fields(self)]


def _mean(weight: Weight) -> Weight:
    if not isinstance(weight, Tensor) or weight.dim() == 0:
        return weight
    return weight.mean(dim=tuple(range(1, weight.dim())), keepdim=True)


def _require_range(name: str, least: float, greatest: float) -> None:
    large_enough = least >= 0 if name == "zero" else least > 0  # NaN is not
    if not large_enough or not greatest < math.inf:
        wanted = "finite and at least 0" if name == "zero" else "finite and positive"
        raise InputError(f"Weights: {name} must be {wanted}, got {greatest if large_enough else least:g}")
