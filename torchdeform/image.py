"""An image in physical space: values on a grid, and where that grid lies in the world (ITK's LPS convention)."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.grid import Grid
from torchdeform.warp import sample


@dataclass(frozen=True)
class Image:
    """Pixel values with their place in the world.

    Args:
        data: ``(1, C, *S)`` floating point, array order (z, y, x) or (y, x).
        grid: shape and spacing in array order.
        origin: world position (x, y, z) of node 0 in LPS mm; zeros by default.
        direction: ITK's direction matrix, columns are the world directions of the x, y, z index axes; identity by default.
        name: what to call it in messages, usually its path.
        pixel_type: numpy name of the type it is stored with, for writing results alike.

    Raises:
        InputError: the parts do not fit together.
    """

    data: Tensor
    grid: Grid
    origin: tuple[float, ...] = ()
    direction: tuple[tuple[float, ...], ...] = ()
    name: str = "image"
    pixel_type: str = field(default="float32")

    def __post_init__(self) -> None:
        dim = self.grid.dim
        self.grid.check(self.data, f"{self.name}: data")
        identity = tuple(tuple(float(i == j) for j in range(dim)) for i in range(dim))
        object.__setattr__(self, "origin", tuple(map(float, self.origin)) or (0.0,) * dim)
        object.__setattr__(self, "direction", tuple(tuple(map(float, r)) for r in self.direction) or identity)
        if len(self.origin) != dim or len(self.direction) != dim or {len(r) for r in self.direction} != {dim}:
            raise InputError(f"{self.name}: origin and direction must have {dim} axes like the image")
        if abs(float(torch.linalg.det(torch.tensor(self.direction, dtype=torch.float64)))) < 1e-6:
            raise InputError(f"{self.name}: its direction matrix is singular; mend the file's header")

    def to_world(self, points: Tensor) -> Tensor:
        """Map grid points ``(B, D, *T)`` (array order, units of spacing, node 0 at 0) to world points (x, y, z)."""
        return torch.einsum("ij,bj...->bi...", self._rotation(points), points.flip(1)) + self._offset(points)

    def to_grid(self, world: Tensor) -> Tensor:
        """Map world points ``(B, D, *T)`` (x, y, z) to grid points (array order, units of spacing, node 0 at 0)."""
        inverse = torch.linalg.inv(self._rotation(world))
        return torch.einsum("ij,bj...->bi...", inverse, world - self._offset(world)).flip(1)

    def _rotation(self, like: Tensor) -> Tensor:
        return torch.tensor(self.direction, dtype=like.dtype, device=like.device)

    def _offset(self, like: Tensor) -> Tensor:
        return self.grid.along(self.origin, like)


def resample(
    moving: Image, fixed: Image, u: Tensor | None = None, *, mode: str = "linear", outside: float | None = 0.0
) -> Tensor:
    """Return moving(φ(x)) at the nodes x of ``fixed``, both taken in their physical place.

    Args:
        moving: the image to sample.
        fixed: the image whose grid is wanted.
        u: displacement ``(1, D, *S)`` on the fixed grid (array order, units of spacing); φ = id + u, identity when None.
        mode: ``linear`` or ``nearest``.
        outside: value outside the moving image (ITK's resampler uses 0); None continues its edge.

    Returns:
        ``(1, C, *S)`` on the fixed grid.

    Notes:
        One interpolation only. Coordinates are computed in float64, so far-away origins lose nothing.
    """
    points = fixed.grid.points(dtype=torch.float64, device=moving.data.device)
    if u is not None:
        points = points + u
    return sample(moving.data, moving.to_grid(fixed.to_world(points)), moving.grid, mode=mode, outside=outside)
