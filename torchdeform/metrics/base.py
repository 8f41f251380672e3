"""What the measures share: the interface, weights from masks, intensities on a common scale."""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from torchdeform.core.grid import per_item
from torchdeform.errors import InputError

# Axes of a batch of images, in 2D and in 3D.
DIMENSIONS = (4, 5)

# Intensities that are taken for 0 and 1; None: the smallest and the largest of each image.
IntensityRange = tuple[float, float] | None


class Similarity(ABC):
    """A similarity S(fixed, warped) to be maximised, with everything that depends on the fixed image computed once."""

    @abstractmethod
    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return S and its derivative.

        Args:
            warped: ``(B, C, *S)``, on the intensity scale of the fixed image.
            mask: weight of each voxel ``(B, 1, *S)``, 0 to 1, usually the product of the fixed mask and the warped
                moving mask; all ones when None.

        Returns:
            S per item ``(B,)``, a weighted mean over voxels and channels; and N ∂S/∂warped ``(B, C, *S)``, N being the
            number of voxels and channels, so that the derivative does not depend on the size of the image. It is 0
            where the weight is. Float32, or float64 if the images are.

        Raises:
            InputError: the mask has another shape.

        Notes:
            Of a mask without a voxel nothing is known: S is 0, which for ``ssd`` and ``mind`` is the best there is, so
            whoever compares positions asks for overlap besides. The derivative is 0.
        """


def at_least_float32(x: Tensor) -> Tensor:
    """Return x, in float32 if it has fewer bits: sums over an image are beyond float16 and bfloat16."""
    return x if x.dtype in (torch.float32, torch.float64) else x.float()


def relative_weight(mask: Tensor | None, image: Tensor) -> Tensor | None:
    """Return the mask divided by its mean, so that the weighted mean of q is the mean of weight · q; None if None.

    Args:
        mask: ``(B or 1, 1, *S)``, not negative; booleans are 0 and 1.
        image: ``(B, C, *S)``, gives dtype and shape.

    Returns:
        ``(B or 1, 1, *S)`` with mean 1, or 0 throughout where the mask is.

    Raises:
        InputError: the mask has another shape.
    """
    if mask is None:
        return None
    _check_mask(mask, image)
    mask = mask.to(image.dtype)
    return mask / per_item(mask.flatten(1).mean(1).clamp(min=torch.finfo(mask.dtype).tiny), mask)


def _check_mask(mask: Tensor, image: Tensor) -> None:
    items, _, *shape = image.shape
    if mask.dim() != image.dim() or mask.shape[0] not in (1, items) or list(mask.shape[1:]) != [1, *shape]:
        raise InputError(f"similarity: mask must have shape {(items, 1, *shape)}, got {tuple(mask.shape)}")


def weighted(x: Tensor, weight: Tensor | None) -> Tensor:
    """Return weight · x, or x itself without a weight."""
    return x if weight is None else x * weight


def mean(x: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the mean of weight · x over voxels and channels, ``(B,)``."""
    return weighted(x, weight).flatten(1).mean(1)


def channel_mean(x: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the mean of weight · x over voxels, ``(B, C, 1, ..)``."""
    return weighted(x, weight).mean(dim=tuple(range(2, x.dim())), keepdim=True)


def checked(fixed: Tensor, warped: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return both images at least in float32.

    Raises:
        InputError: they are no floating-point ``(B, C, *S)`` of one shape with 2 or 3 axes in S, or the mask does not
            fit.
    """
    if fixed.shape != warped.shape or fixed.dim() not in DIMENSIONS:
        shapes = f"{tuple(fixed.shape)} and {tuple(warped.shape)}"
        raise InputError(f"similarity: fixed and warped must have one shape (B, C, *S), got {shapes}")
    if not (fixed.is_floating_point() and warped.is_floating_point()):
        raise InputError(f"similarity: images must be floating-point, got {fixed.dtype} and {warped.dtype}")
    if mask is not None:
        _check_mask(mask, fixed)
    return at_least_float32(fixed), at_least_float32(warped)


def on_unit_scale(
    fixed: Tensor, warped: Tensor, mask: Tensor | None, intensity_range: IntensityRange
) -> tuple[Tensor, Tensor]:
    """Return (image − low) / (high − low) of both images, at least in float32.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, any unit.
        mask: ``(B or 1, 1, *S)`` or None.
        intensity_range: low and high of both; None takes the smallest and the largest value of each channel of each
            image where the mask is positive, as constants: no derivative goes through them. A flat channel becomes 0.

    Raises:
        InputError: as `checked`.
    """
    fixed, warped = checked(fixed, warped, mask)
    return _to_unit(fixed, mask, intensity_range), _to_unit(warped, mask, intensity_range)


def _to_unit(image: Tensor, mask: Tensor | None, intensity_range: IntensityRange) -> Tensor:
    if intensity_range is not None:
        return (image - intensity_range[0]) / (intensity_range[1] - intensity_range[0])
    with torch.no_grad():
        outside = torch.zeros_like(image, dtype=torch.bool) if mask is None else (mask <= 0).expand_as(image)
        voxels = tuple(range(2, image.dim()))
        low = image.masked_fill(outside, torch.inf).amin(voxels, keepdim=True)
        high = image.masked_fill(outside, -torch.inf).amax(voxels, keepdim=True)
        width = torch.where(high > low, high - low, 1)
    return (image - torch.where(high >= low, low, 0)) / width
