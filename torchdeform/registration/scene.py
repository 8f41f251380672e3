"""What is registered, on one grid: the images as they are compared, where they count, which points belong together."""

from dataclasses import dataclass, replace

from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.registration.guidance import Guidance
from torchdeform.registration.intensities import fill, to_common_scale
from torchdeform.registration.pyramid import restrict
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.similarity import on_one_scale


@dataclass(frozen=True)
class Scene:
    """Two images on one grid and what is known about them.

    Attributes:
        grid: their grid.
        fixed: ``(B, C, *S)``.
        moving: the same shape.
        fixed_mask: weights ``(B, 1, *S)``, or None.
        moving_mask: likewise.
        fixed_points: ``(B, D, n)`` in grid points, or None.
        moving_points: likewise.
    """

    grid: Grid
    fixed: Tensor
    moving: Tensor
    fixed_mask: Tensor | None = None
    moving_mask: Tensor | None = None
    fixed_points: Tensor | None = None
    moving_points: Tensor | None = None

    def on(self, coarse: Grid) -> "Scene":
        """Return the scene on a coarser grid of the same box."""

        def coarser(field: Tensor | None) -> Tensor | None:
            return None if field is None else restrict(field, self.grid, coarse)

        masks = {"fixed_mask": coarser(self.fixed_mask), "moving_mask": coarser(self.moving_mask)}
        images = {"fixed": restrict(self.fixed, self.grid, coarse), "moving": restrict(self.moving, self.grid, coarse)}
        return replace(self, grid=coarse, **images, **masks)

    def scaled(self, settings: RegistrationSettings) -> "Scene":
        """Return the scene with intensities on the scale that the similarity needs."""
        images = to_common_scale(
            (self.fixed, self.moving),
            (self.fixed_mask, self.moving_mask),
            jointly=on_one_scale(settings.similarity),
        )
        return replace(self, fixed=images[0], moving=images[1])


def tensor_scene(fixed: Tensor, moving: Tensor, grid: Grid, guidance: Guidance) -> Scene:
    """Return the scene of two tensors on one grid, filled in where the masks are 0."""
    masks = [_weights(mask, fixed) for mask in (guidance.fixed_mask, guidance.moving_mask)]
    images = [image if mask is None else fill(image, mask) for image, mask in zip((fixed, moving), masks, strict=True)]
    points = [None if p is None else p.to(fixed) for p in (guidance.fixed_points, guidance.moving_points)]
    return Scene(grid, *images, *masks, *points)


def _weights(mask: object, like: Tensor) -> Tensor | None:
    return mask.to(like).expand(like.shape[0], -1, *like.shape[2:]) if isinstance(mask, Tensor) else None
