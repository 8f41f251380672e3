"""Settings of the alignment that comes before a registration."""

from collections.abc import Mapping
from dataclasses import dataclass

from torchdeform.errors import require_choice, require_ranges
from torchdeform.metrics.similarity import similarity_weights

ALIGNMENTS = ("none", "translation", "rigid", "similarity", "affine")

# Nodes of the coarsest level at most, on which all starts are tried.
COARSEST_NODES = 4096

# Nodes of the finest level and width of the LNCC window where nothing else is asked for. In 2D finer levels made the
# map worse (brain slices, tissue sections): one part fits in every detail, and the rest, which bends, goes with it.
_NODES = {2: 20_000, 3: 150_000}
_WINDOW = {2: 7, 3: 5}


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings:
    """How images are aligned.

    Args:
        kind: ``none``, ``translation``, ``rigid`` (rotation and shift), ``similarity`` (and one scale) or ``affine``.
        similarity: name, or names with weights, as in `RegistrationSettings`. ``lncc`` alone is `ForegroundLNCC`, which
            also finds maps between many different contrasts; ``nmi`` is for those it does not. ``mind`` suits tissue
            sections that turn little.
        window: width of the LNCC window in voxels of each level, odd; 7 in 2D and 5 in 3D when None.
        rotations: try rotations all around, and mirror images, at the coarsest level; otherwise only the files'
            geometry and the centres are starts, which finds rotations up to some 30°.
        nodes: nodes of the finest level at most, 20 000 in 2D and 150 000 in 3D when None. More take longer, and are
            better only where one affine map fits everything.
        min_overlap: share of the smaller image (or mask) that must lie in the other one.
        steps: evaluations of the similarity at most on each level.

    Raises:
        InputError: a value out of range, named.
    """

    kind: str = "affine"
    similarity: str | Mapping[str, float] = "lncc"
    window: int | None = None
    rotations: bool = True
    nodes: int | None = None
    min_overlap: float = 0.3
    steps: int = 40

    def __post_init__(self) -> None:
        require_choice(self.kind, ALIGNMENTS, "align.kind")
        similarity_weights(self.similarity)
        if not isinstance(self.similarity, str):  # a copy of our own, and a dict, which `asdict` can take
            object.__setattr__(self, "similarity", dict(self.similarity))
        enough = (lambda nodes: nodes >= COARSEST_NODES, f"be at least {COARSEST_NODES}")
        share = (lambda overlap: 0 < overlap <= 1, "be above 0, and 1 at most")
        require_ranges(self, "align.", window="window", min_overlap=share, nodes=enough, steps="at least 1")

    def window_in(self, dim: int) -> int:
        """Return the width of the window for images of ``dim`` axes."""
        return self.window or _WINDOW[dim]

    def nodes_in(self, dim: int) -> int:
        """Return the nodes of the finest level at most for images of ``dim`` axes."""
        return self.nodes or _NODES[dim]
