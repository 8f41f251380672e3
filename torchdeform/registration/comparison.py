"""How alike two images are where the maps have taken them: one of them is warped, or both."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchdeform.grid import Grid
from torchdeform.registration.metrics.base import Similarity
from torchdeform.registration.scene import Scene
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.similarity import features, make_similarity
from torchdeform.warp import warp


@dataclass(frozen=True)
class Comparison:
    """Images on one grid, ready to be compared again and again.

    Attributes:
        grid: their grid.
        images: what the maps warp ``(sides·B, C, *S)``: the moving image, or first the fixed and then the moving one.
        similarity: of the warped images.
        masks: their masks, warped likewise, or None.
        still: a mask that is not warped, or None.
        sides: maps of a pair, 1, or 2 where both images are warped.
    """

    grid: Grid
    images: Tensor
    similarity: Similarity
    masks: Tensor | None = None
    still: Tensor | None = None
    sides: int = 1

    def look(self, u: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the images warped by u ``(sides·B, D, *S)``, as they are when None, S per pair, and N ∂S/∂warped."""
        warped = self._masked if u is None else warp(self._masked, u, self.grid)
        del u  # where a coarser grid carries the map, nobody else holds it
        if self.masks is None:
            return warped, *self.similarity.evaluate(warped, self.still)
        warped, mask = warped.tensor_split([-1], dim=1)
        return warped, *self.similarity.evaluate(warped.contiguous(), self._weight(mask))

    @cached_property
    def _masked(self) -> Tensor:
        """The images and their masks, side by side: one sampling costs less than two."""
        return self.images if self.masks is None else torch.cat([self.images, self.masks], dim=1)

    def _weight(self, mask: Tensor) -> Tensor:
        """Return the product of the masks where the maps have taken them."""
        other = self.still if self.sides == 1 else _of_other_side(mask)
        return mask if other is None else mask * other


def compare_from_fixed(scene: Scene, settings: RegistrationSettings) -> Comparison:
    """Return the comparison in which the moving image is warped."""
    fixed, moving = (features(settings.similarity, image) for image in (scene.fixed, scene.moving))
    similarity = make_similarity(settings.similarity, fixed, settings.window, grid=scene.grid)
    return Comparison(scene.grid, moving, similarity, scene.moving_mask, scene.fixed_mask)


def compare_from_middle(scene: Scene, settings: RegistrationSettings) -> Comparison:
    """Return the comparison in which both images are warped."""
    images = torch.cat([features(settings.similarity, image) for image in (scene.fixed, scene.moving)])
    masks = None
    if scene.fixed_mask is not None or scene.moving_mask is not None:
        ones = torch.ones_like(scene.fixed[:, :1])
        masks = torch.cat([ones if mask is None else mask for mask in (scene.fixed_mask, scene.moving_mask)])
    return Comparison(scene.grid, images, _MutualSimilarity(settings, scene.grid), masks, sides=2)


class _MutualSimilarity(Similarity):
    """(S(a, b) + S(b, a)) / 2 for images a and b of which both are warped.

    ``evaluate`` takes first all a, then all b, ``(2B, C, *S)``. It returns S per pair ``(B,)``, and the derivative of
    S(b, a) by a and of S(a, b) by b. Nothing changes when a and b change places, except the places.
    """

    def __init__(self, settings: RegistrationSettings, grid: Grid) -> None:
        self.settings, self.grid = settings, grid

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        others = _of_other_side(warped)
        similarity = make_similarity(self.settings.similarity, others, self.settings.window, grid=self.grid)
        value, slope = similarity.evaluate(warped, mask)
        return torch.stack(value.chunk(2)).mean(0), slope


def _of_other_side(both: Tensor) -> Tensor:
    return both.roll(len(both) // 2, 0)
