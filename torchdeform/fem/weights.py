"""The weights of the div-curl least squares: what divergence, rotation, change of shape and velocity cost."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchdeform.core.grid import Grid, common_batch
from torchdeform.core.tables import in_transformation
from torchdeform.errors import InputError

Weight = float | Tensor

# How much dearer than the other divergence or curl may be before elements lock.
_MOST_DEAR = 2.0


@dataclass(frozen=True)
class Weights:
    """Weights of ∫ w_div (div v − α)² + w_curl |curl v − β|² + w_strain |dev sym ∇v|² + w_zero |v|².

    Args:
        div: w_div > 0. A number, or a tensor ``(B or 1, 1, *E)`` with one value per element, E_k = n_k − 1, or 1 where
            it does not vary.
        curl: w_curl ≥ 0, as ``div``; positive where ``strain`` is 0.
        zero: w_zero ≥ 0 per squared unit of spacing, as ``div``; √(w_div / w_zero) is the length beyond which v decays.
        strain: w_strain ≥ 0, as ``div``: the price of a change of shape, dev sym ∇v = (∇v + ∇vᵀ)/2 − (div v) I/D.
            Where w_curl is 0 a rigid motion costs w_zero alone, whatever div and strain do.

    Raises:
        InputError: a number out of range (values of tensors are looked at by `check`).
    """

    div: Weight = 1.0
    curl: Weight = 1.0
    zero: Weight = 0.0
    strain: Weight = 0.0

    def __post_init__(self) -> None:
        for name, value in self._items():
            if not isinstance(value, Tensor):
                _require_range(name, float(value), float(value))
        if not isinstance(self.curl, Tensor) and not isinstance(self.strain, Tensor):
            _require_held(self.curl + self.strain)

    def check(self, grid: Grid) -> None:
        """Raise `InputError` unless shapes fit the elements of ``grid`` and every value is in range."""
        self.check_shapes(grid)
        for name, value in self._items():
            if isinstance(value, Tensor):
                _require_range(name, *_extremes(value))
        common_batch("Weights", *self.tensors)
        held = self.curl + self.strain
        if isinstance(held, Tensor):
            _require_held(float(held.detach().amin()))

    def check_shapes(self, grid: Grid) -> None:
        """Raise `InputError` unless shapes fit the elements of ``grid``."""
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

    @property
    def constant(self) -> bool:
        """True when no weight varies over space (it may still vary over the batch)."""
        return all(w.shape[1:].numel() == 1 for w in self.tensors)

    @property
    def isotropic(self) -> bool:
        """True when w_div = w_curl, w_strain = 0 for certain: tensors that want gradients of their own do not count."""
        if not isinstance(self.strain, float | int) or self.strain > 0:
            return False
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

    @property
    def parts(self) -> tuple[tuple[Weight, Weight], tuple[Weight, Weight]]:
        """What of w_div, and of w_curl, is integrated exactly, and what at the centres, see `form.div_form`.

        Exactly: up to twice what the other costs.
        """
        return _parts(self.div, self.curl), _parts(self.curl, self.div)

    def without_strain(self, dim: int) -> "Weights":
        """Return the weights of div and curl alone that price fields without flow through the faces alike.

        Constant weights given, ∫ |dev sym ∇v|² = ∫ (1 − 1/D) (div v)² + ½ |curl v|² for them.
        """
        if not isinstance(self.strain, Tensor) and self.strain == 0:
            return self
        return Weights(self.div + self.strain * (1 - 1 / dim), self.curl + self.strain / 2, self.zero)

    def typical(self) -> "Weights":
        """Return what each weight is at a quarter of the elements or below, for each batch item.

        Those of the cheapest part of a map: a part that is dearer by any factor then takes few steps more, see
        `FastTransform`, a thin one that is cheaper does not count.
        """
        return Weights(**{name: _share(w, 4) for name, w in self._items()})

    def base(self, dim: int) -> "Weights":
        """Return constant weights of div and curl alone, for each batch item: those of the cheapest sixteenth."""
        return Weights(**{name: _share(w, 16) for name, w in self.without_strain(dim)._items()})

    def to(self, like: Tensor) -> "Weights":
        """Return the weights with tensors moved to the type and device of ``like``."""
        return self.with_tensors(tuple(w.to(like) for w in self.tensors))

    def detached(self) -> "Weights":
        """Return the weights with tensors that want no gradient."""
        return self.with_tensors(tuple(w.detach() for w in self.tensors))

    @property
    def values(self) -> tuple[Weight, ...]:
        """All weights, in the order of the fields."""
        return tuple(w for _, w in self._items())

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """The weights that are tensors, in the order of the fields."""
        return tuple(w for w in self.values if isinstance(w, Tensor))

    def with_tensors(self, tensors: tuple[Tensor, ...]) -> "Weights":
        """Return the weights with those that are tensors replaced, in the order of `tensors`."""
        rest = iter(tensors)
        return Weights(**{name: next(rest) if isinstance(w, Tensor) else w for name, w in self._items()})

    def _items(self) -> list[tuple[str, Weight]]:
        return [(f.name, getattr(self, f.name)) for f in fields(self)]


def weights_of_labels(labels: Tensor, by_label: Mapping[int, Weights], rest: Weights, grid: Grid) -> Weights:
    """Return the weights of tissues that are given as labels, soft over one voxel; see `weights_of_shares`.

    Args:
        labels: whole numbers at the nodes ``(B, 1, *S)``.
        by_label: what the labels cost, in numbers.
        rest: what all other labels cost, in numbers.
        grid: the grid.

    Raises:
        InputError: shape.
    """
    if tuple(labels.shape[1:]) != (1, *grid.shape):
        want = ", ".join(map(str, grid.shape))
        raise InputError(f"weights_of_labels: labels must have shape (B, 1, {want}), got {tuple(labels.shape)}")
    shares = [labels == label for label in by_label] or [torch.zeros_like(labels)]
    return weights_of_shares(torch.cat(shares, dim=1).to(torch.get_default_dtype()), list(by_label.values()), rest)


def weights_of_shares(shares: Tensor, tissues: Sequence[Weights], rest: Weights) -> Weights:
    """Return the weights of nodes of which tissues have shares.

    Args:
        shares: how much of each node a tissue has ``(B, L, *S)``, in sum at most 1.
        tissues: what they cost, in numbers.
        rest: what costs what is left of a node, in numbers.

    Returns:
        Weights by element ``(B, 1, *E)``, each the mean of what the corners cost; a number where all cost the same.
    """
    share, costs = _corner_mean(shares), {}
    for field in fields(Weights):
        costs[field.name] = other = getattr(rest, field.name)
        more = [getattr(tissue, field.name) - other for tissue in tissues]
        if any(more):
            column = share.new_tensor(more).view(1, -1, *[1] * (share.dim() - 2))
            costs[field.name] = other + (share * column).sum(1, keepdim=True)
    return Weights(**costs)


def _corner_mean(nodes: Tensor) -> Tensor:
    for axis in range(2, nodes.dim()):
        size = nodes.shape[axis] - 1
        nodes = (nodes.narrow(axis, 0, size) + nodes.narrow(axis, 1, size)) / 2
    return nodes


def _parts(weight: Weight, other: Weight) -> tuple[Weight, Weight]:
    like = next((w for w in (weight, other) if isinstance(w, Tensor)), None)
    if like is not None:
        first, second = (torch.as_tensor(w, dtype=like.dtype, device=like.device) for w in (weight, other))
        exact = torch.minimum(first, _MOST_DEAR * second)
    else:
        exact = min(float(weight), _MOST_DEAR * float(other))
    return exact, weight - exact


def _share(weight: Weight, parts: int) -> Weight:
    """Return the smallest weight that at least one of so many parts of the elements has, or less."""
    if not isinstance(weight, Tensor) or weight.dim() == 0:
        return weight
    flat = weight.detach().flatten(1)
    return flat.kthvalue(1 + flat.shape[1] // parts, dim=1).values.view(-1, *([1] * (weight.dim() - 1)))


def _extremes(weight: Tensor) -> list[float]:
    try:
        return torch.stack(weight.detach().aminmax()).tolist()
    except RuntimeError as error:
        if not in_transformation():
            raise
        raise InputError(
            "Weights: torch.func.vmap cannot run over weights here; give them as one batch (B, 1, *E), or solve by "
            "nn.DivCurlVelocity"
        ) from error


def _require_held(least: float) -> None:
    if not least > 0:
        raise InputError("Weights: curl must be finite and positive where strain is 0, got 0 for both")


def _require_range(name: str, least: float, greatest: float) -> None:
    large_enough = least > 0 if name == "div" else least >= 0  # NaN is not
    if not large_enough or not greatest < math.inf:
        wanted = "finite and positive" if name == "div" else "finite and at least 0"
        raise InputError(f"Weights: {name} must be {wanted}, got {greatest if large_enough else least:g}")
