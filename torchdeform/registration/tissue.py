"""What the tissue of the fixed image costs to deform, and how well it was kept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import restrict
from torchdeform.deformation.incompressible import hold_volume
from torchdeform.deformation.rigid import RigidHold
from torchdeform.deformation.tissue import label_fit
from torchdeform.errors import InputError
from torchdeform.fem.weights import Weights, weights_of_shares
from torchdeform.registration.settings import TISSUES, RegistrationSettings

# How often what is rigid is held and what that folds is repaired: twice has been enough.
_ROUNDS = 5


@dataclass(frozen=True)
class TissueFit:
    """How a map treats the nodes of one label; each ``(B,)``, NaN where an item does not have it.

    Attributes:
        residual: largest distance from the rigid motion that fits best, in voxels.
        off: |J − 1| that 99.9 % of the nodes stay below, J by central differences.
        volume: volume after the map / before, counted in simplices.
    """

    residual: Tensor
    off: Tensor
    volume: Tensor


@dataclass(frozen=True)
class TissueOutcome:
    """One label of the tissue.

    Attributes:
        label: its number.
        kind: ``rigid``, ``stiff``, ``incompressible``, ``free``, or ``own`` for prices of its own.
        sliding: whether its border glides.
        nodes: how many nodes of the fixed grid it has ``(B,)``.
        before: before the last correction.
        after: after it.
    """

    label: int
    kind: str
    sliding: bool
    nodes: Tensor
    before: TissueFit
    after: TissueFit


@dataclass(frozen=True)
class Tissue:
    """The labels that the settings name, on one grid.

    Attributes:
        labels: their numbers.
        shares: how much of each node they have ``(B or 1, L, *S)``, from 0 to 1.
        prices: what each costs, by name; what is not there costs what it costs elsewhere.
        kinds: what each is called.
        sliding: whether the border of each glides.
    """

    labels: tuple[int, ...]
    shares: Tensor
    prices: tuple[Mapping[str, float], ...]
    kinds: tuple[str, ...]
    sliding: tuple[bool, ...]

    @classmethod
    def of(cls, labels: Tensor, settings: RegistrationSettings, like: Tensor) -> "Tissue":
        """Return the tissue of an image of labels ``(B or 1, 1, *S)``.

        Args:
            labels: whole numbers.
            settings: what they stand for.
            like: a tensor with the type of the shares.

        Raises:
            InputError: a label that the settings name and no item has.
        """
        numbers = tuple(sorted({*settings.tissues, *settings.sliding}))
        shares = torch.cat([labels == number for number in numbers], dim=1).to(like)
        for number, found in zip(numbers, shares.amax(dim=(0, *range(2, shares.dim()))).tolist(), strict=True):
            if not found:
                raise InputError(f"tissue: no voxel has the label {number} that the settings name; name others")
        named = [settings.tissues.get(number, "free") for number in numbers]
        return cls(
            numbers,
            shares,
            tuple(TISSUES[one] if isinstance(one, str) else one for one in named),
            tuple(one if isinstance(one, str) else "own" for one in named),
            tuple(number in settings.sliding for number in numbers),
        )

    def on(self, grid: Grid, coarse: Grid) -> "Tissue":
        """Return the same on a coarser grid of the same box."""
        return self if grid == coarse else replace(self, shares=restrict(self.shares, grid, coarse))

    def masks(self, kind: str, glides: bool | None = None) -> Tensor:
        """Return the nodes of the labels of a kind ``(B or 1, L', *S)``, bool, of those whose borders glide or not.

        Each node is in one label at most.
        """
        both = enumerate(zip(self.kinds, self.sliding, strict=True))
        wanted = [k for k, (one, slides) in both if one == kind and glides in (None, slides)]
        return self.shares[:, wanted] > 0.5

    def corrected(
        self, u: Tensor, grid: Grid, floor: float, held: Sequence[int] = ()
    ) -> tuple[Tensor, tuple[TissueOutcome, ...]]:
        """Return maps that keep shapes and volumes as asked for, and how well before and after that.

        Args:
            u: displacements ``(B, D, *S)`` in units of spacing, without folds.
            grid: their grid.
            floor: smallest one-sided determinant that is wanted around what is rigid.
            held: axes along which nothing is moved.
        """
        exact = self.exact(u, grid, floor, held)
        before = self._fits(u, grid)
        found = before, before if exact is u else self._fits(exact, grid)
        nodes = (self.shares > 0.5).flatten(2).sum(2).expand(len(u), -1)
        named = zip(self.labels, self.kinds, self.sliding, nodes.unbind(1), *found, strict=True)
        return exact, tuple(TissueOutcome(*one) for one in named)

    def exact(self, u: Tensor, grid: Grid, floor: float, held: Sequence[int] = (), glides: bool = False) -> Tensor:
        """Return maps that keep shapes and volumes of the labels whose borders glide, or of the others.

        A label with a border that glides is corrected in the map of its side, before the sides are joined.
        """
        u = _held_rigid(u, self.hold(grid, glides), grid, floor)
        u = hold_volume(u, self.masks("incompressible", glides), grid, still=self.masks("rigid", glides))
        if held:
            u = repair_folds(u.index_fill(1, torch.tensor(held, device=u.device), 0.0), grid)
        return repair_folds(u, grid)  # where two labels that turn leave no room between them

    def _fits(self, u: Tensor, grid: Grid) -> list[TissueFit]:
        return [TissueFit(*label_fit(u, label, grid)) for label in (self.shares > 0.5).split(1, dim=1)]

    def hold(self, grid: Grid, glides: bool | None = None) -> RigidHold | None:
        """Return what keeps the rigid labels rigid, see `masks`; None where there are none."""
        masks = self.masks("rigid", glides)
        return RigidHold(masks, grid) if bool(masks.any()) else None

    def weights(self, base: Weights) -> Weights:
        """Return what a velocity costs in each element, ``base`` where there is no label."""
        if not any(self.prices):
            return base
        tissues = [replace(base, **price) for price in self.prices]
        return weights_of_shares(self.shares, tissues, base)

    @property
    def gliding(self) -> Tensor:
        """The shares of the labels whose borders glide ``(B or 1, L', *S)``."""
        return self.shares[:, [k for k, slides in enumerate(self.sliding) if slides]]

    @property
    def free(self) -> Tensor:
        """The share of each node ``(B or 1, 1, *S)`` that no price holds."""
        held = [k for k, price in enumerate(self.prices) if price]
        return 1 - self.shares[:, held].sum(1, keepdim=True).clamp(max=1)


def _held_rigid(u: Tensor, hold: RigidHold | None, grid: Grid, floor: float) -> Tensor:
    """Return maps without folds that are rigid on the rigid labels, or nearly where that folds what is around."""
    if hold is None:
        return u
    for _ in range(_ROUNDS):
        held = hold(u, floor)
        u = repair_folds(held, grid)
        if u is held:
            break
    return u
