"""Between the grid of the images and a coarser one that carries the map: linear interpolation and its transpose."""

from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.registration.banded import Banded, gathering, interpolation, multiply


@dataclass(frozen=True)
class Transfer:
    """Fields on two grids of one box.

    Args:
        fine: grid of the images.
        coarse: grid of the map, no finer along any axis.
        like: a tensor with the dtype and device wanted.
    """

    fine: Grid
    coarse: Grid
    like: Tensor

    def up(self, field: Tensor) -> Tensor:
        """Return a field ``(B, C, *coarse)`` at the nodes of the fine grid, by linear interpolation."""
        return multiply(field, self._ups)

    def gather(self, force: Tensor) -> Tensor:
        """Return the force density on the coarse grid that does the same work as one ``(B, C, *fine)``.

        The transpose of `up`, divided by the number of fine nodes to a coarse one.
        """
        return multiply(force, self._downs)

    @cached_property
    def _ups(self) -> list[Banded | None]:
        return [interpolation(few, many, self.like) for many, few in self._counts]

    @cached_property
    def _downs(self) -> list[Banded | None]:
        return [gathering(many, few, self.like) for many, few in self._counts]

    @property
    def _counts(self) -> list[tuple[int, int]]:
        return list(zip(self.fine.shape, self.coarse.shape, strict=True))
