"""Landmarks on the fixed grid: where they are, and where those of the moving image end up at each stage."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.core.image import Image
from torchdeform.core.transform import Affine
from torchdeform.core.warp import sample
from torchdeform.metrics.evaluation import landmark_distances
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.result import RegistrationResult
from torchdeform.report.sampling import MOVING, ORIGINAL, WARPED


@dataclass(frozen=True)
class Landmarks:
    """Pairs of landmarks, n of them.

    Attributes:
        fixed: positions in the fixed image in nodes ``(n, D)``, array order.
        moved: those of the moving image, by stage.
        distances: how far apart the pairs are ``(n,)``, by stage, measured as in the tables: in the moving image.
        unit: of the distances.
    """

    fixed: Tensor
    moved: dict[str, Tensor]
    distances: dict[str, Tensor]
    unit: str


def landmarks_of(fixed: Image, result: RegistrationResult, annotations: Annotations) -> Landmarks | None:
    """Return the landmarks of a pair, None without."""
    if annotations.points is None:
        return None
    here, there = (points.detach().cpu().double() for points in annotations.points)
    u, inverse = (w.detach().cpu() for w in (result.displacement, result.inverse))
    affine = result.affine or Affine.identity(fixed.grid.dim)
    start, aligned = fixed.to_grid(here), fixed.to_grid(affine.inverse()(there))
    moved = start + sample(u, start, fixed.grid)
    ends = {
        WARPED: aligned + sample(inverse, aligned, fixed.grid),
        MOVING: aligned,
        ORIGINAL: fixed.to_grid(there),
    }
    maps = {WARPED: affine(fixed.to_world(moved)), MOVING: affine(here), ORIGINAL: here}
    spacing = torch.tensor(fixed.grid.spacing, dtype=torch.float64)
    return Landmarks(
        fixed=start[0].T / spacing,
        moved={stage: end[0].T / spacing for stage, end in ends.items()},
        distances={stage: fixed.in_unit(landmark_distances(world, there)[0]) for stage, world in maps.items()},
        unit=fixed.unit,
    )
