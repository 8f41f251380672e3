"""Random maps for augmentation: within bounds on determinant and curl, without folds, with their inverse."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid, per_item
from torchdeform.core.resampling import prolong
from torchdeform.core.warp import invert
from torchdeform.errors import InputError, require_ranges
from torchdeform.nn.heads import flow_to_monitor, scale_to_bounds, with_mean_one
from torchdeform.nn.precision import full_precision
from torchdeform.nn.spatial import SpatialTransformer

# Nodes of the grid on which the map is found, per node of the noise: the flow is smooth between the random numbers.
_REFINEMENT = 4

# The share of the bounds that a map is given before it is interpolated.
_MARGIN = 0.9

# Steps of the midpoint rule.
_STEPS = 4


@dataclass(frozen=True)
class RandomMap:
    """Maps φ = id + u that were drawn, one per item.

    Attributes:
        displacement: u ``(B, D, *S)`` in units of spacing.
        grid: its grid.
    """

    displacement: Tensor
    grid: Grid

    @cached_property
    def inverse(self) -> Tensor:
        """The displacement ``(B, D, *S)`` of φ⁻¹, by `invert`, computed when it is first asked for."""
        return invert(self.displacement, self.grid)


class RandomDeformation(nn.Module):
    """Carry image, labels and points by one random map, which keeps bounds on its determinant and curl.

    Random numbers on a coarse grid become a monitor f between the bounds and a curl; the map is that of Version 1 with
    div v = f − 1, curl v = g. What the grid cannot follow, or a bound forbids, is drawn back: the bounds always hold.

    Args:
        grid: the grid of images, labels and displacements.
        determinant: bounds below and above 1: every one-sided determinant is at least the first, no determinant of
            central differences above the second.
        curl: bound of every component of curl u.
        nodes: nodes of the random numbers along the longest side of Ω; more make finer maps.
        probability: with which an item is moved at all.
        outside: value of images and labels outside Ω; None continues the edge. φ keeps Ω, so none is needed.

    Raises:
        InputError: a value out of range.

    Notes:
        Ω is mapped onto Ω, and no map has folds by the full certificate. The noise is drawn on the CPU from the given
        generator, or from torch's, so the same seed gives the same maps on every device, to
        rounding. Not differentiable in what is
        random; images keep their gradient.
    """

    def __init__(
        self,
        grid: Grid,
        *,
        determinant: tuple[float, float] = (0.5, 2.0),
        curl: float = 0.5,
        nodes: int = 8,
        probability: float = 1.0,
        outside: float | None = None,
    ) -> None:
        super().__init__()
        if not 0 < determinant[0] < 1 < determinant[1] < math.inf:
            raise InputError(f"RandomDeformation: determinant needs 0 < low < 1 < high, got {determinant}")
        self.grid, self.determinant, self.curl = grid, (float(determinant[0]), float(determinant[1])), float(curl)
        self.nodes, self.probability = nodes, probability
        several = (lambda n: n >= 2, "be at least 2")
        require_ranges(self, "RandomDeformation: ", curl="finite, not negative", nodes=several, probability="0 to 1")
        self.carry = SpatialTransformer(grid, outside=outside)

    @torch.no_grad()
    def draw(self, items: int, *, like: Tensor | None = None, generator: torch.Generator | None = None) -> RandomMap:
        """Return random maps.

        Args:
            items: how many, B.
            like: a tensor of the device wanted, and of the dtype if that is float64; float32 on the CPU when None.
            generator: of the CPU; torch's own when None.
        """
        noise = self._noise(items, generator)
        if like is not None:
            noise = noise.to(like.device, torch.float64 if like.dtype == torch.float64 else torch.float32)
        return RandomMap(self._maps(noise), self.grid)

    def forward(
        self,
        image: Tensor,
        label: Tensor | None = None,
        points: Tensor | None = None,
        *,
        maps: RandomMap | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor | tuple[Tensor, ...]:
        """Return what is given, moved by one map per item: the image alone, or a tuple.

        Args:
            image: ``(B, C, *S)``; it is pulled back, new(x) = image(φ(x)).
            label: ``(B, C, *S)`` of any dtype, likewise, by the nearest voxel.
            points: ``(B, D, *T)`` in units of spacing; they go with what the image shows, that is by φ⁻¹, which
                costs an inversion.
            maps: the maps to use, from `draw`; new ones when None.
            generator: for new ones.

        Raises:
            InputError: shapes.
        """
        chosen = maps or self.draw(image.shape[0], like=image, generator=generator)
        moved = [self.carry(image, chosen.displacement)]
        if label is not None:
            moved.append(self.carry.label(label, chosen.displacement))
        if points is not None:
            moved.append(self.carry.points(points, chosen.inverse))
        return moved[0] if len(moved) == 1 else tuple(moved)

    def _noise(self, items: int, generator: torch.Generator | None) -> Tensor:
        """Return numbers between −1 and 1 for the monitor and the curl, ``(B, 1 + C, *coarse)``, 0 where none moves."""
        longest = max(self.grid.extent)
        shape = [max(2, round(self.nodes * side / longest)) for side in self.grid.extent]
        kind: dict[str, Any] = {"generator": generator, "dtype": torch.float32, "device": "cpu"}
        noise = 2 * torch.rand(items, 1 + len(CURL_PAIRS[self.grid.dim]), *shape, **kind) - 1
        return noise * per_item(torch.rand(items, **kind) < self.probability, noise)

    @full_precision
    def _maps(self, noise: Tensor) -> Tensor:
        counts = zip(self.grid.shape, noise.shape[2:], strict=True)
        grid = self.grid.with_shape([min(n, _REFINEMENT * (m - 1) + 1) for n, m in counts])
        noise, (low, high) = prolong(noise, grid), self.determinant
        rising = noise[:, :1].clamp(min=0) * math.log(high)
        falling = noise[:, :1].clamp(max=0) * -math.log(low)
        f = with_mean_one(torch.exp(rising + falling), grid)
        u = flow_to_monitor(f, self.curl * noise[:, 1:], grid, _STEPS)
        u = u * per_item((noise != 0).flatten(1).any(1), u)
        # Most of what must be drawn back is where that costs little; the second look rarely finds anything.
        u = scale_to_bounds(u, grid, low**_MARGIN, high**_MARGIN, _MARGIN * self.curl)
        return scale_to_bounds(prolong(u, self.grid), self.grid, low, high, self.curl)

    def extra_repr(self) -> str:
        bounds = f"determinant={self.determinant}, curl={self.curl:g}, nodes={self.nodes}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {bounds}, probability={self.probability:g}"
