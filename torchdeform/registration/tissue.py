"""What the tissue of the fixed image costs to deform, and how well it was kept."""

from dataclasses import dataclass

from torch import Tensor


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
