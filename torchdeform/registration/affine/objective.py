"""The objective of an alignment: the similarity of two images at one resolution as a function of the map."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.derivatives import derivative
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, box_corners
from torchdeform.core.resampling import restrict, with_spacing
from torchdeform.core.warp import sample
from torchdeform.metrics.similarity import Similarity
from torchdeform.registration.affine.lie import homogeneous

# Weight of plain displacement in the metric, so that flat images have one too.
_DAMPING = 1e-3

# Numbers that a batch of maps may hold at once.
_CHUNK = 2**21


@dataclass(frozen=True)
class MaskedImage:
    """An image and the weight of its voxels.

    Args:
        image: one or more channels.
        weight: ``(1, 1, *S)`` in [0, 1]; None means 1 everywhere.
    """

    image: Image
    weight: Tensor | None = None

    def coarser(self, voxel: float) -> "MaskedImage":
        """Return both at voxels of about this width, smoothed so that nothing aliases; thicker voxels stay."""
        grid = self.image.grid
        coarse = with_spacing(grid, voxel)
        weight = None if self.weight is None else restrict(self.weight, grid, coarse)
        return MaskedImage(replace(self.image, data=restrict(self.image.data, grid, coarse), grid=coarse), weight)

    def with_data(self, data: Tensor) -> "MaskedImage":
        """Return the image with other values ``(1, C, *S)``."""
        return replace(self, image=replace(self.image, data=data))

    def cropped(self, margin: int) -> "MaskedImage":
        """Return the box around all voxels with a weight, ``margin`` voxels wider; the whole without weights."""
        if self.weight is None:
            return self
        grid, places = self.image.grid, self.weight[0, 0].nonzero()
        first = [max(0, int(low) - margin) for low in places.amin(0)]
        last = [min(n - 1, int(high) + margin) for high, n in zip(places.amax(0), grid.shape, strict=True)]
        cut = (slice(None), slice(None), *(slice(a, b + 1) for a, b in zip(first, last, strict=True)))
        shape = tuple(b - a + 1 for a, b in zip(first, last, strict=True))
        corner = torch.tensor(
            [a * h for a, h in zip(first, grid.spacing, strict=True)], dtype=torch.float64, device="cpu"
        )
        origin = tuple(self.image.to_world(corner.view(1, -1, 1)).flatten().tolist())
        image = replace(self.image, data=self.image.data[cut], grid=Grid(shape, grid.spacing), origin=origin)
        return MaskedImage(image, self.weight[cut])


@dataclass(frozen=True)
class NormalisedFrame:
    """Coordinates q = (x − centre) / radius of the world, so that shifts and turns are numbers of one size."""

    centre: Tensor
    radius: float

    @classmethod
    def of(cls, image: Image) -> "NormalisedFrame":
        """Return the frame in which the image's box has its centre at 0 and its corners at distance 1."""
        corners = image.to_world(box_corners(image.grid))[0]
        return cls(corners.mean(1), float((corners[:, -1] - corners[:, 0]).norm()) / 2)

    def from_world(self, points: Tensor) -> Tensor:
        """Return q for world points ``(B, D, N)``."""
        return (points - self.centre.view(1, -1, 1)) / self.radius

    def to_grid(self, image: Image) -> Tensor:
        """Return the matrix ``(D + 1, D + 1)`` that takes [q; 1] to grid points of the image."""
        dim = len(self.centre)
        ends = torch.eye(dim, dim + 1, dtype=torch.float64, device="cpu").unsqueeze(0)
        places = image.to_grid(self.centre.view(1, -1, 1) + self.radius * ends)[0]
        return homogeneous(places[:, :dim] - places[:, dim:], places[:, dim])

    def to_affine(self, matrix: Tensor) -> tuple[Tensor, Tensor]:
        """Return M and t of the world map x ↦ M x + t whose matrix on [q; 1] this is."""
        linear, shift = matrix[:-1, :-1], matrix[:-1, -1]
        return linear, self.centre + self.radius * shift - linear @ self.centre


class AffineObjective:
    """The similarity of two images as a function of the map between them, at one resolution.

    Args:
        fixed: image whose nodes are compared, and their weight.
        moving: image that is sampled there, and its weight.
        frame: coordinates of the maps.
        make: returns the similarity to a fixed image ``(B, C, *S)`` on its grid.
        min_overlap: with less overlap the similarity is −∞, 0 to 1.
        sizes: smallest and largest factor of length; beyond them it is −∞ too.

    Notes:
        A map is a matrix ``(D + 1, D + 1)`` on [q; 1], float64 on the CPU. Weights are taken for constants in the
        derivative. The derivative of the moving image is its central difference, interpolated.
    """

    def __init__(
        self,
        fixed: MaskedImage,
        moving: MaskedImage,
        frame: NormalisedFrame,
        make: Callable[[Tensor, Grid], Similarity],
        min_overlap: float,
        sizes: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        self.fixed, self.moving, self.frame, self.min_overlap = fixed, moving, frame, min_overlap
        self._volumes = tuple(size**fixed.image.grid.dim for size in sizes)
        grid = fixed.image.grid
        world = fixed.image.to_world(grid.points(dtype=torch.float64)).flatten(2)
        self.points = _with_ones(frame.from_world(world)[0]).to(fixed.image.data)
        self.voxel = grid.cell_volume ** (1 / grid.dim) / frame.radius
        self._place = frame.to_grid(moving.image)
        self._channels = _with_slopes(moving)
        self._corners = _with_ones(frame.from_world(fixed.image.to_world(box_corners(grid)))[0])
        self._make, self._made = make, {}

    @property
    def dim(self) -> int:
        """Number of axes D."""
        return self.fixed.image.grid.dim

    @property
    def fields(self) -> int:
        """Number of fields that are sampled for a map: the channels, their slopes, and the weight."""
        return self._channels.shape[1]

    def evaluate(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Return S ``(B,)`` and ∂S/∂ξ ``(B, D, D + 1)`` for maps followed by q + ξ [q; 1], see `Objective`.

        With g = ∂S/∂warped and P the matrix from [q; 1] to the moving grid, ∂S/∂ξ = Pᵀ Σ g ∇moving [q; 1]ᵀ.
        """
        place, warped, slopes, weight = self._warped(maps)
        value, derivative = self._similarity(len(maps)).evaluate(warped, weight)
        force = (derivative.unsqueeze(2) * slopes).sum(1).flatten(2)
        moment = (force @ self.points.T).double().cpu() / (force.shape[2] * warped.shape[1])
        return self._with_overlap(maps, value, weight)[0], place[:, :-1, :-1].transpose(1, 2) @ moment

    def values(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Return S and the overlap, each ``(B,)``; any number of maps."""
        size = max(1, _CHUNK // (self.fields * self.points.shape[1]))
        parts = []
        for some in maps.split(size):
            _, warped, _, weight = self._warped(some)
            value, _ = self._similarity(len(some)).evaluate(warped, weight)
            parts.append(torch.stack(self._with_overlap(some, value, weight)))
        value, overlap = torch.cat(parts, dim=1)
        return value, overlap

    def metric(self, maps: Tensor) -> Tensor:
        """Return Σ ∇warped∇warpedᵀ ⊗ [q; 1][q; 1]ᵀ / N and a little of the same without the image, see `Objective`."""
        place, _, slopes, weight = self._warped(maps)
        slopes = torch.einsum("bkj,bckn->bcjn", place[:, :-1, :-1].to(slopes), slopes.flatten(3))
        rows = (slopes.unsqueeze(3) * self.points).flatten(2, 3) * weight.flatten(2).sqrt().unsqueeze(1)
        image = (rows @ rows.transpose(2, 3)).sum(1).double().cpu() / self.points.shape[1]
        points = self.points.double().cpu()
        single = torch.eye(len(points) - 1, dtype=torch.float64, device="cpu")
        plain = torch.kron(single, points @ points.T / points.shape[1])
        size = torch.diagonal(image, dim1=1, dim2=2).sum(1).clamp(min=1e-12) / torch.trace(plain)
        return image + _DAMPING * size.view(-1, 1, 1) * plain

    def longest_move(self, moves: Tensor) -> Tensor:
        """Return the longest displacement in voxels at the corners of the fixed image, see `Objective`."""
        return (moves @ self._corners).norm(dim=1).amax(1) / self.voxel

    def _similarity(self, items: int) -> Similarity:
        """Return the similarity to that many copies of the fixed image."""
        if items not in self._made:
            image = self.fixed.image
            self._made[items] = self._make(image.data.expand(items, *image.data.shape[1:]), image.grid)
        return self._made[items]

    def _with_overlap(self, maps: Tensor, value: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Return S, −∞ for what cannot be, and the overlap: 1 when the smaller image lies wholly in the other."""
        grids = self.fixed.image.grid, self.moving.image.grid
        weights = [1.0 if m.weight is None else float(m.weight.mean()) for m in (self.fixed, self.moving)]
        volume = torch.linalg.det(maps[:, :-1, :-1]).abs()
        most = (weights[1] * grids[1].volume / grids[0].volume / volume).clamp(max=weights[0])
        overlap = weight.flatten(1).double().mean(1).cpu() / most
        small, large = self._volumes
        wrong = (overlap < self.min_overlap) | (volume < small) | (volume > large)
        return torch.where(wrong, -torch.inf, value.double().cpu()), overlap

    def _warped(self, maps: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the matrices [q; 1] -> grid, moving at the mapped nodes, its slopes along its axes, and the weight."""
        grid = self.fixed.image.grid
        place = self._place @ maps
        points = (place[:, :-1].to(self.points) @ self.points).unflatten(2, grid.shape)
        values = sample(self._channels, points, self.moving.image.grid, outside=0.0)
        count = self.moving.image.data.shape[1]
        weight = values[:, -1:] if self.fixed.weight is None else values[:, -1:] * self.fixed.weight
        return place, values[:, :count], values[:, count:-1].unflatten(1, (count, grid.dim)), weight


def _with_slopes(moving: MaskedImage) -> Tensor:
    """Return the image, its derivatives along its own axes, channel by channel, and its weight, as channels."""
    data, grid = moving.image.data, moving.image.grid
    slopes = torch.stack([derivative(data, grid, axis) for axis in range(grid.dim)], dim=2).flatten(1, 2)
    weight = torch.ones_like(data[:, :1]) if moving.weight is None else moving.weight
    return torch.cat([data, slopes, weight], dim=1)


def _with_ones(points: Tensor) -> Tensor:
    return torch.cat([points, torch.ones_like(points[:1])])
