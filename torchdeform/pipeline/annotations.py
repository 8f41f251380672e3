"""Whether landmarks, labels and features belong to the image that they are given for."""

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from torchdeform.core.image import Image, overlap, require_same_place
from torchdeform.errors import InputError
from torchdeform.pipeline.preflight import ERROR, WARNING, Finding
from torchdeform.registration.annotations import Annotations

_MARGIN = 3.0  # voxels by which a landmark may lie outside without a word
_PIXELS = "px"
_COVERED = 0.9  # share of an image in its labels, and of these in it, below which there is a warning


def check_annotations(
    image: Image, points: Tensor | None, path: Path | None, labels: Image | None
) -> Iterator[Finding]:
    """Yield what looks wrong with the landmarks, of the file ``path``, and the labels of an image."""
    if points is not None and path is not None:
        yield from check_points(image, points, path)
    if labels is not None:
        yield from check_labels(image, labels)


def check_points(image: Image, points: Tensor, path: Path) -> Iterator[Finding]:
    """Landmarks that lie outside of their image.

    Args:
        image: the image.
        points: positions in the world ``(N, D)``, LPS mm.
        path: the file that they are from.
    """
    grid = image.grid
    place = image.to_grid(points.T.unsqueeze(0))[0]
    sides = torch.tensor(grid.extent, dtype=torch.float64).unsqueeze(1)
    beyond = torch.maximum(-place, place - sides).clamp(min=0)
    spacing = torch.tensor(grid.spacing, dtype=torch.float64).unsqueeze(1)
    outside = (beyond > _MARGIN * spacing).any(dim=0)
    if count := int(outside.sum()):
        farthest = image.in_unit(float(beyond.norm(dim=0).max()))
        text = (
            f"{count} of {len(points)} points of {path} lie outside of {image.name}, the farthest by "
            f"{farthest:.4g} {image.unit}; check their unit (mm or pixels), directions (LPS or RAS) and the image"
        )
        yield Finding(ERROR if count == len(points) else WARNING, text)


def check_labels(image: Image, labels: Image, what: str = "labels") -> Iterator[Finding]:
    """Labels of another size than their image, or in another place.

    Args:
        image: the image.
        labels: regions of it, or other values. A grid of their own is fine if it covers the same part of the world.

    Notes:
        Pictures have no place in the world, so labels and picture must agree pixel by pixel.
    """
    if labels.grid.dim != image.grid.dim:  # refused with the number of axes
        return
    try:
        require_same_place(labels, image)
    except InputError as error:
        apart = str(error)
    else:
        return
    if _PIXELS in (image.unit, labels.unit):
        yield Finding(ERROR, _of_another_size(image, labels, apart, what))
        return
    shares = overlap(image, labels), overlap(labels, image)
    if max(shares) == 0:
        yield Finding(ERROR, f"{labels.name} lies beside {image.name}; correct the origin and spacing in its header")
    elif min(shares) < _COVERED:
        text = f"{labels.name} covers {shares[0]:.0%} of {image.name} and lies in it with {shares[1]:.0%} of itself"
        yield Finding(WARNING, f"{text}; check the origin and spacing in its header")


def check_features(images: tuple[Image, Image], features: tuple[Image | None, Image | None]) -> Iterator[Finding]:
    """Yield what looks wrong with channels to compare: of one image only, unlike, in another place, constant."""
    first, second = features
    if first is None and second is None:
        return
    try:
        Annotations(fixed_features=first, moving_features=second).require_images(images[0].grid.dim)
    except InputError as error:
        yield Finding(ERROR, str(error))
        return
    for image, channels in zip(images, features, strict=True):
        if channels is not None:
            yield from check_labels(image, channels, "features")
            if bool((channels.data == channels.data[:, :, *[slice(1)] * channels.grid.dim]).all()):
                yield Finding(
                    ERROR, f"{channels.name} is constant, so there is nothing to compare; give other features"
                )


def _of_another_size(image: Image, labels: Image, apart: str, what: str) -> str:
    if labels.grid.shape == image.grid.shape:
        return f"{apart}, or save both with the same spacing"
    return (
        f"{labels.name} is {labels.grid.size_text} but {image.name} is {image.grid.size_text}; give {what} with a "
        "value for every pixel, turned as the image is"
    )
