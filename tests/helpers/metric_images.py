"""Random images and masks, and the similarity measures by name, for the tests of the measures."""

from collections.abc import Callable

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.metrics.correlation import lncc, ncc
from torchdeform.metrics.gradients import ngf
from torchdeform.metrics.information import mutual_information, normalised_mutual_information
from torchdeform.metrics.squares import mind, ssd

SHAPES = [(11, 14), (7, 9, 8)]


UNIT = (0.0, 1.0)


# The functions of images, on intensities that are already between 0 and 1.
ON_UNIT: dict[str, Callable[..., Tensor]] = {
    "ssd": ssd,
    "ncc": lambda f, w, mask=None: ncc(f, w, mask=mask, intensity_range=UNIT),
    "lncc": lambda f, w, mask=None: lncc(f, w, mask=mask, window=5, intensity_range=UNIT),
    "mi": lambda f, w, mask=None: mutual_information(f, w, mask=mask, intensity_range=UNIT),
    "nmi": lambda f, w, mask=None: normalised_mutual_information(f, w, mask=mask, intensity_range=UNIT),
    "ngf": lambda f, w, mask=None: ngf(f, w, mask=mask, intensity_range=UNIT),
}


ANY: dict[str, Callable[..., Tensor]] = {
    "ssd": ssd,
    "ncc": ncc,
    "lncc": lncc,
    "mi": mutual_information,
    "nmi": normalised_mutual_information,
    "ngf": ngf,
    "mind": mind,
}


CONTRAST_FREE = ["lncc", "mi", "nmi", "ngf", "mind"]


def images(shape: tuple[int, ...], channels: int = 1, items: int = 2, seed: int = 0, low: float = 0.0) -> Tensor:
    """Two related images with values from ``low`` to 1 − ``low``, float64: ``(2, B, C, *S)``."""
    generator = torch.Generator().manual_seed(seed)
    fixed, noise = torch.rand(2, items, channels, *shape, generator=generator, dtype=torch.float64)
    pair = torch.stack([fixed, 0.7 * fixed.square() + 0.3 * noise])
    return low + (1 - 2 * low) * pair


def smooth(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    """An image of waves, ``(1, 1, *S)``, from 0 to 1."""
    x = Grid(shape).points(dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(1, 1, *shape, dtype=torch.float64)
    for _ in range(6):
        wave = torch.rand(1, len(shape), generator=generator, dtype=torch.float64).view(1, -1, *([1] * len(shape)))
        total = total + torch.sin((0.9 * wave * x).sum(1, keepdim=True) + 6 * wave[:, :1])
    return (total - total.min()) / (total.max() - total.min())


def soft_mask(shape: tuple[int, ...], items: int = 2, seed: int = 5) -> Tensor:
    """Weights between 0 and 1, a third of them 0, more to one side."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(items, 1, *shape, generator=generator, dtype=torch.float64)
    mask[..., : shape[-1] // 3] = 0
    return mask
