"""Similarities by name: which features are compared, by what, and with which weight."""

import math
from collections.abc import Callable, Mapping
from numbers import Real

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError, require_choice
from torchdeform.metrics.base import Similarity, at_least_float32
from torchdeform.metrics.correlation import CrossCorrelation, LocalCrossCorrelation
from torchdeform.metrics.gradients import GradientFields
from torchdeform.metrics.information import MutualInformation
from torchdeform.metrics.mind import mind_ssc, neighbour_pairs
from torchdeform.metrics.squares import MeanSquaredDifference

# Windows of LNCC over a voxel along each axis. With 3 in place of 9 it takes a fifth of the time; Dice changes by
# +0.002 (mouse brains), +0.001 (slices, hearts), 0.000 (hippocampi).
_WINDOWS_OVER = 3

# The measures of images, by name: from the fixed image, the window of LNCC and the grid.
_OF_IMAGES: dict[str, Callable[[Tensor, int, Grid], Similarity]] = {
    "ssd": lambda fixed, window, grid: MeanSquaredDifference(fixed),
    "ncc": lambda fixed, window, grid: CrossCorrelation(fixed),
    "lncc": lambda fixed, window, grid: LocalCrossCorrelation(fixed, window, max(1, window // _WINDOWS_OVER)),
    "mi": lambda fixed, window, grid: MutualInformation(fixed),
    "nmi": lambda fixed, window, grid: MutualInformation(fixed, normalised=True),
    "ngf": lambda fixed, window, grid: GradientFields(fixed, grid),
}


SIMILARITIES = ("ssd", "ncc", "lncc", "mi", "nmi", "ngf", "mind")


def similarity_weights(similarity: str | Mapping[str, float]) -> dict[str, float]:
    """Return the measures that a setting ``similarity`` names, with their weights.

    Args:
        similarity: a name of `SIMILARITIES`, which has weight 1, or names with their weights.

    Raises:
        InputError: no name, an unknown one, or a weight that is not positive and finite.
    """
    if not isinstance(similarity, str | Mapping) or not similarity:
        raise InputError(f"similarity must name one of {', '.join(SIMILARITIES)}, or several with their weights")
    weights = {similarity: 1.0} if isinstance(similarity, str) else dict(similarity)
    for name, weight in weights.items():
        require_choice(name, SIMILARITIES, "similarity")
        if isinstance(weight, bool) or not isinstance(weight, Real) or not 0 < weight < math.inf:
            raise InputError(f"similarity: the weight of {name} must be a positive finite number, got {weight!r}")
    return weights


class Combination(Similarity):
    """S = Σ w_k S_k / Σ w_k, each S_k being a similarity of some of the channels.

    Args:
        parts: w_k, the channels that S_k compares, and S_k.
    """

    def __init__(self, parts: list[tuple[float, slice, Similarity]]) -> None:
        total = sum(weight for weight, _, _ in parts)
        self.parts = [(weight / total, channels, part) for weight, channels, part in parts]

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        values, slope = [], torch.zeros_like(warped)
        for weight, channels, part in self.parts:
            own = warped[:, channels]
            value, derivative = part.evaluate(own, mask)
            values.append(weight * value)
            slope[:, channels] += derivative * (weight * warped.shape[1] / own.shape[1])
        return torch.stack(values).sum(0), slope


def on_one_scale(similarity: str | Mapping[str, float]) -> bool:
    """Return whether a measure compares intensities as they are, so that both images need one scale."""
    return "ssd" in similarity_weights(similarity)


def features(similarity: str | Mapping[str, float], image: Tensor) -> Tensor:
    """Return what is warped and compared: the image, its MIND-SSC channels, or the one after the other.

    Args:
        similarity: a name, or names with weights.
        image: ``(B, C, *S)``, scaled to about [0, 1].

    Returns:
        ``(B, C', *S)``: C' is C without ``mind``, C·K with nothing else, C + C·K with both; K = 12 in 3D and 4 in 2D.

    Raises:
        InputError: as `similarity_weights`, `mind_ssc`.
    """
    weights = similarity_weights(similarity)
    if "mind" not in weights:
        return image
    image = at_least_float32(image)
    return mind_ssc(image) if len(weights) == 1 else torch.cat([image, mind_ssc(image)], dim=1)


def make_similarity(
    similarity: str | Mapping[str, float], fixed: Tensor, window: int = 9, *, grid: Grid | None = None
) -> Similarity:
    """Return the similarity of that name, or of those names and weights, to ``fixed``.

    Args:
        similarity: a name, or names with weights.
        fixed: ``(B, C', *S)``, the `features` of the fixed image.
        window: width of the LNCC window in voxels.
        grid: their grid, whose spacing the gradients of ``ngf`` need; spacing 1 when None.

    Returns:
        A `Similarity` whose ``evaluate`` takes the warped features of the moving image.

    Raises:
        InputError: as `similarity_weights`.
    """
    weights, grid = similarity_weights(similarity), grid or Grid(tuple(fixed.shape[2:]))
    if len(weights) == 1:
        return _part(next(iter(weights)), fixed, window, grid)
    channels = fixed.shape[1] // (1 + len(neighbour_pairs(grid.dim))) if "mind" in weights else fixed.shape[1]
    parts = []
    for name, weight in weights.items():
        own = slice(channels, None) if name == "mind" else slice(0, channels)
        parts.append((weight, own, _part(name, fixed[:, own], window, grid)))
    return Combination(parts)


def _part(name: str, fixed: Tensor, window: int, grid: Grid) -> Similarity:
    return MeanSquaredDifference(fixed) if name == "mind" else _OF_IMAGES[name](fixed, window, grid)
