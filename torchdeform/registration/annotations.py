"""What is known of two images beside them: masks, landmarks, labels, features, tissue; whether it goes with them."""

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError

T = TypeVar("T")

# What is given of both images or of none.
PAIRED = ("points", "labels", "features")
_FEATURES = ("fixed_features", "moving_features")


@dataclass(frozen=True, kw_only=True)
class Annotations:
    """Masks, landmarks and labels; for tensors they are tensors, for images masks and labels are `Image`s.

    Args:
        fixed_mask: where the fixed image counts: weights from 0 to 1 ``(B or 1, 1, *S)``, or an `Image` whose values
            other than 0 mean yes. What lies where the mask is 0 has no influence, and may be NaN.
        moving_mask: where the moving image counts, likewise; it moves with the image.
        fixed_points: landmarks ``(B, D, n)``: for tensors in array order in units of spacing, node 0 at the origin; for
            images in the world, (x, y, z) in mm.
        moving_points: the same landmarks in the moving image, in the same order.
        fixed_labels: whole numbers ``(B, 1, *S)``, 0 for what is not looked at; or an `Image` of them.
        moving_labels: likewise of the moving image. Labels are only measured, unless ``labels_weight`` is positive.
        fixed_features: channels to compare ``(B or 1, K, *S)``, or an `Image` of them, on any grid; see ``features`` in
            `RegistrationSettings`.
        moving_features: the same channels of the moving image.
        tissue: whole numbers on the fixed image, as ``fixed_labels``; what they stand for say the settings ``tissues``
            and ``sliding``.

    Raises:
        InputError: points, labels or features of one image only, or points whose shapes do not fit or that are not
            finite.
    """

    fixed_mask: Tensor | Image | None = None
    moving_mask: Tensor | Image | None = None
    fixed_points: Tensor | None = None
    moving_points: Tensor | None = None
    fixed_labels: Tensor | Image | None = None
    moving_labels: Tensor | Image | None = None
    fixed_features: Tensor | Image | None = None
    moving_features: Tensor | Image | None = None
    tissue: Tensor | Image | None = None

    def __post_init__(self) -> None:
        for name in PAIRED:
            given = [getattr(self, f"{side}_{name}") is not None for side in ("fixed", "moving")]
            if given[0] != given[1]:
                missing = "fixed" if given[1] else "moving"
                raise InputError(f"{missing}_{name} are missing: give {name} of both images, or of none")
        if self.fixed_points is not None and self.moving_points is not None:
            _require_pairs(self.fixed_points, self.moving_points)

    def to(self, device: torch.device | str) -> "Annotations":
        """Return the same with everything on ``device``."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return Annotations(**{name: None if part is None else part.to(device) for name, part in parts.items()})

    @property
    def labels(self) -> tuple[Any, Any] | None:
        """The labels of both images, None without."""
        return both(self.fixed_labels, self.moving_labels)

    @property
    def features(self) -> tuple[Any, Any] | None:
        """The features of both images, None without."""
        return both(self.fixed_features, self.moving_features)

    @property
    def masks(self) -> "Annotations":
        """The masks alone."""
        return Annotations(fixed_mask=self.fixed_mask, moving_mask=self.moving_mask)

    @property
    def points(self) -> tuple[Tensor, Tensor] | None:
        """The landmarks of both images, None without."""
        return both(self.fixed_points, self.moving_points)

    def require_tensors(self, grid: Grid, items: int) -> None:
        """Raise `InputError` unless everything given is a tensor that goes with images ``(items, C, *S)``."""
        for name in ("fixed_mask", "moving_mask", "fixed_labels", "moving_labels", "tissue"):
            field = getattr(self, name)
            if field is not None:
                _require_field(field, name, grid, items)
        for name in _FEATURES if self.features else ():
            _require_features(getattr(self, name), name, grid, items)
        _require_one_count(self.features, _FEATURES)
        if self.fixed_points is not None and tuple(self.fixed_points.shape[:2]) != (items, grid.dim):
            given = tuple(self.fixed_points.shape)
            raise InputError(f"fixed_points must have shape ({items}, {grid.dim}, n), got {given}")

    def require_images(self, dim: int) -> None:
        """Raise `InputError` unless masks and labels are images of ``dim`` axes, and points go with them."""
        for name in ("fixed_mask", "moving_mask", "fixed_labels", "moving_labels", "tissue"):
            field = getattr(self, name)
            if field is None:
                continue
            if not isinstance(field, Image):
                raise InputError(f"{name} must be an Image, because the images are")
            if field.grid.dim != dim or field.data.shape[1] != 1:
                kind = f"{field.grid.dim}D with {field.data.shape[1]} channels"
                raise InputError(f"{name}: {field.name} must be {dim}D with one channel, but is {kind}; choose another")
        for name, field in zip(_FEATURES, self.features or (), strict=False):
            _require_feature_image(field, name, dim)
        both = self.features and tuple(image.data for image in self.features)
        _require_one_count(both, tuple(image.name for image in self.features or ()))
        if self.fixed_points is not None and tuple(self.fixed_points.shape[:2]) != (1, dim):
            raise InputError(f"fixed_points must have shape (1, {dim}, n), got {tuple(self.fixed_points.shape)}")


def both(first: T | None, second: T | None) -> tuple[T, T] | None:
    """Return both, None without."""
    return None if first is None or second is None else (first, second)


def _require_pairs(fixed: Tensor, moving: Tensor) -> None:
    if fixed.dim() != 3 or fixed.shape != moving.shape or fixed.shape[2] == 0:
        shapes = f"{tuple(fixed.shape)} and {tuple(moving.shape)}"
        raise InputError(f"fixed_points and moving_points must both have shape (B, D, n), n at least 1, got {shapes}")
    if not bool(fixed.isfinite().all() and moving.isfinite().all()):
        raise InputError("fixed_points and moving_points must be finite; leave out pairs that are not known")


def _require_field(field: Tensor | Image, name: str, grid: Grid, items: int) -> None:
    if not isinstance(field, Tensor):
        raise InputError(f"{name} must be a tensor, because the images are")
    if tuple(field.shape) not in {(count, 1, *grid.shape) for count in (1, items)}:
        raise InputError(f"{name} must have shape {(items, 1, *grid.shape)}, got {tuple(field.shape)}")
    if name.endswith("mask"):
        require_mask(field, name)


def _require_features(field: Tensor | Image, name: str, grid: Grid, items: int) -> None:
    if not isinstance(field, Tensor) or field.shape[:1] not in ((1,), (items,)) or field.shape[2:] != grid.shape:
        raise InputError(f"{name} must be a tensor {(items, 'K', *grid.shape)}, because the images are tensors")
    if not bool(field.isfinite().all()):
        raise InputError(f"{name} has values that are NaN or infinite; make them finite")


def _require_feature_image(field: Tensor | Image, name: str, dim: int) -> None:
    if not isinstance(field, Image):
        raise InputError(f"{name} must be an Image, because the images are")
    if field.grid.dim != dim:
        raise InputError(f"{name}: {field.name} must be {dim}D as the images are, but is {field.grid.dim}D")
    if not bool(field.data.isfinite().all()):
        raise InputError(f"{name}: {field.name} has values that are NaN or infinite; make them finite")


def _require_one_count(features: tuple[Tensor, Tensor] | None, names: tuple[str, ...]) -> None:
    if features is not None and features[0].shape[1] != features[1].shape[1]:
        counts = " and ".join(f"{n} has {f.shape[1]} channels" for n, f in zip(names, features, strict=True))
        raise InputError(f"{counts}; features of both images must be the same channels")


def require_mask(mask: Tensor, name: str) -> None:
    """Raise `InputError` unless the weights lie between 0 and 1, and every item has one that is positive."""
    values = mask.to(torch.float32) if mask.dtype == torch.bool else mask
    if not bool(((values >= 0) & (values <= 1)).all()):
        raise InputError(f"{name} must hold weights from 0 to 1; make it one with mask > 0")
    if not bool((values > 0).flatten(1).any(1).all()):
        raise InputError(f"{name} is 0 everywhere, so there is nothing to register; check that it is the right one")
