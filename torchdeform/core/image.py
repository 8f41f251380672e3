"""An image in physical space: values on a grid, and where that grid is in the world (ITK's LPS convention)."""

import math
from dataclasses import dataclass, replace
from itertools import permutations
from typing import TypeVar

import torch
from torch import Tensor

from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.warp import inside_box, sample
from torchdeform.errors import InputError, require_choice

# Alpha that means opaque, by pixel type; floating types count from 0 to 1.
_OPAQUE = {"uint8": 255.0, "uint16": 65535.0}
_RGBA = 4
# Letters of the world axes x, y, z: what their positive and negative directions point to.
_LETTERS = ("LR", "PA", "SI")

# Units that lengths are shown in, and how long 1 of the world's coordinates is in them.
UNITS = {"px": 1.0, "mm": 1.0, "µm": 1000.0}

_Length = TypeVar("_Length", float, Tensor)

# Directions less independent than this are no axes of a space.
_INDEPENDENT = 1e-6


def independence(matrix: Tensor) -> float:
    """Return how far the columns of a matrix ``(D, D)`` are from lying in a plane, whatever their lengths, 1 to 0.

    Notes:
        |det| / Π |column|: a determinant alone carries the scale of the matrix to the power of D. 1 for right angles.
    """
    matrix = matrix.detach().double()
    return float((torch.linalg.det(matrix).abs() / matrix.norm(dim=0).prod()).nan_to_num(0.0))


@dataclass(frozen=True)
class Image:
    """Pixel values with their place in the world.

    Args:
        data: ``(1, C, *S)`` floating point, array order (z, y, x) or (y, x).
        grid: shape and spacing in array order.
        origin: world position (x, y, z) of node 0 in LPS mm; zeros by default.
        direction: ITK's direction matrix, columns are the world directions of the x, y, z index axes; identity by
            default.
        name: what to call it in messages, usually its path.
        pixel_type: numpy name of the type it is stored with, for writing results alike.
        unit: what its lengths are shown in: ``px`` for files without a spacing, whose pixels are 1 apart, ``mm``, or
            ``µm`` where the file has it. Coordinates are in mm with both of the latter.
        remarks: sentences about what its reader had to decide, which people should know.

    Raises:
        InputError: the parts do not fit together, or an unknown unit.
    """

    data: Tensor
    grid: Grid
    origin: tuple[float, ...] = ()
    direction: tuple[tuple[float, ...], ...] = ()
    name: str = "image"
    pixel_type: str = "float32"
    unit: str = "mm"
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        dim = self.grid.dim
        self.grid.check(self.data, f"{self.name}: data")
        identity = tuple(tuple(float(i == j) for j in range(dim)) for i in range(dim))
        object.__setattr__(self, "origin", tuple(map(float, self.origin)) or (0.0,) * dim)
        object.__setattr__(self, "direction", tuple(tuple(map(float, r)) for r in self.direction) or identity)
        if len(self.origin) != dim or len(self.direction) != dim or {len(r) for r in self.direction} != {dim}:
            raise InputError(f"{self.name}: origin and direction must have {dim} axes like the image")
        require_choice(self.unit, UNITS, f"{self.name}: unit")
        if not all(map(math.isfinite, self.origin)):
            raise InputError(f"{self.name}: its origin {self.origin} is not finite; correct the header of the file")
        if not independence(torch.tensor(self.direction, dtype=torch.float64, device="cpu")) > _INDEPENDENT:
            raise InputError(f"{self.name}: its direction matrix is singular; correct the header of the file")

    def to_world(self, points: Tensor) -> Tensor:
        """Map grid points ``(B, D, *T)`` (array order, units of spacing, node 0 at 0) to world points (x, y, z)."""
        return torch.einsum("ij,bj...->bi...", self._rotation(points), points.flip(1)) + self._offset(points)

    def to_grid(self, world: Tensor) -> Tensor:
        """Map world points ``(B, D, *T)`` (x, y, z) to grid points (array order, units of spacing, node 0 at 0)."""
        inverse = torch.linalg.inv(self._rotation(world))
        return torch.einsum("ij,bj...->bi...", inverse, world - self._offset(world)).flip(1)

    def to(self, device: torch.device | str) -> "Image":
        """Return the same image with its pixels on ``device``."""
        return replace(self, data=self.data.to(device))

    def in_unit(self, length: _Length) -> _Length:
        """Return a length of the world, such as a spacing, in the image's `unit`."""
        return length * UNITS[self.unit]

    def _rotation(self, like: Tensor) -> Tensor:
        return torch.tensor(self.direction, dtype=like.dtype, device=like.device)

    def _offset(self, like: Tensor) -> Tensor:
        origin = torch.tensor(self.origin, dtype=like.dtype, device=like.device)
        return origin.view(1, -1, *([1] * (like.dim() - 2)))  # points may come as a list as well as on a grid


# Outside of an image: a number, None for the nearest value inside, or this for what `surroundings` finds.
AUTO = "auto"

# What surrounds an image is the median of its faces if most of them, this share, are near it: closer than this share of
# the range between its dark and bright ends, these quantiles. Fewer pixels may mark what a scanner cannot see.
_MOSTLY, _NEAR, _ENDS = 0.5, 0.05, (0.05, 0.95)
_SOME = 2**20  # pixels of which quantiles are taken


def resample(
    moving: Image, fixed: Image, u: Tensor | None = None, *, mode: str = "linear", outside: float | str | None = 0.0
) -> Tensor:
    """Return moving(φ(x)) at the nodes x of ``fixed``, both taken in their physical place.

    Args:
        moving: the image to sample.
        fixed: the image whose grid the result has.
        u: displacement ``(1, D, *S)`` on the fixed grid (array order, units of spacing) of φ = id + u; zero when
            None.
        mode: ``linear`` or ``nearest``.
        outside: value outside the moving image (ITK's resampler uses 0); None continues its edge, ``auto`` takes what
            `surroundings` says.

    Returns:
        ``(1, C, *S)`` on the fixed grid; the moving pixels themselves where both images have one grid and one place.

    Notes:
        One interpolation only. Coordinates are computed in float64, so far-away origins lose nothing.
    """
    if u is None and same_place(moving, fixed):
        return moving.data
    grid, device = fixed.grid, moving.data.device
    beyond = outside_value(moving, outside)

    def values(rows: slice) -> Tensor:
        points = grid.points(dtype=torch.float64, device=device, rows=rows)
        points = points if u is None else points + u[:, :, rows]
        return sample(moving.data, moving.to_grid(fixed.to_world(points)), moving.grid, mode=mode, outside=beyond)

    return over_slabs(values, grid.shape, device)


def outside_value(image: Image, outside: float | str | None) -> float | Tensor | None:
    """Return the value outside of an image that a number, None or ``auto`` stands for.

    Raises:
        InputError: another word.
    """
    if not isinstance(outside, str):
        return outside
    require_choice(outside, (AUTO,), f"{image.name}: outside, if it is no number,")
    return surroundings(image)


def surroundings(image: Image) -> Tensor:
    """Return what surrounds an image, such as air or paper, for each channel ``(C,)``.

    Args:
        image: pixels that are not finite do not count.

    Notes:
        The median of the image's faces if most of them are close to it in all channels, else its dark end, below which
        are 5 % of the pixels. Either is a value that occurs in the image, so its type can hold it.
    """
    data, flat = image.data, image.data.flatten(2)
    faces = torch.cat([data.select(axis, end).flatten(2) for axis in range(2, data.dim()) for end in (0, -1)], dim=2)
    some = flat[..., :: 1 + flat.numel() // _SOME]
    faces, some = (torch.where(part.isfinite(), part, torch.nan) for part in (faces, some))
    low, high = some.nanquantile(
        torch.tensor(_ENDS, dtype=torch.float64, device="cpu").to(flat), dim=2, interpolation="lower"
    )
    middle = faces.nanmedian(dim=2).values
    near = ((faces - middle.unsqueeze(2)).abs() <= _NEAR * (high - low).unsqueeze(2)).all(1)
    found = middle if float(near[faces.isfinite().all(1)].double().mean()) > _MOSTLY else low
    return found[0].nan_to_num(0.0, 0.0, 0.0)


def same_place(a: Image, b: Image) -> bool:
    """Return whether both images have the same nodes in the world."""
    return (a.grid, a.origin, a.direction) == (b.grid, b.origin, b.direction)


def box_corners(grid: Grid) -> Tensor:
    """Return the corners of the box of a grid ``(1, D, 2^D)``, float64, the first and the last opposite each other."""
    ends = [torch.tensor([0.0, side], dtype=torch.float64, device="cpu") for side in grid.extent]
    return torch.cartesian_prod(*ends).T.unsqueeze(0)


def background(data: Tensor) -> Tensor:
    """Return the grey value of the background, the median over the faces of the box of ``(1, C, *S)``."""
    faces = [data.select(axis, end).flatten() for axis in range(2, data.dim()) for end in (0, -1)]
    return torch.cat(faces).median()


def centre_of_mass(image: Image, weight: Tensor) -> Tensor:
    """Return the mean position of an image's nodes ``(1, D)`` in the world, float64, weighted by ``(1, 1, *S)``.

    The weights are not negative; where all are 0 it is the origin of the world.
    """
    world = image.to_world(image.grid.points(dtype=torch.float64, device=weight.device)).flatten(2)
    weight = weight.double().flatten(2)
    return (world * weight).sum(2) / weight.sum().clamp(min=torch.finfo(torch.float64).tiny)


def luminance(image: Image) -> Image:
    """Return the grey image that colour is registered on, Y = 0.299 R + 0.587 G + 0.114 B; grey images as they are.

    Args:
        image: 1 channel (grey), 3 (RGB) or 4 (RGBA; what is transparent counts as black).

    Returns:
        The image with one channel, in the same place.

    Raises:
        InputError: another number of channels.

    Notes:
        Differentiable and linear in the colours.
    """
    channels = image.data.shape[1]
    if channels == 1:
        return image
    if channels not in (3, _RGBA):
        raise InputError(f"{image.name} has {channels} channels; give a grey (1), RGB (3) or RGBA (4) image")
    from kornia.color import rgb_to_grayscale

    grey = rgb_to_grayscale(opaque(image).data.flatten(2).unsqueeze(-1))  # one column of pixels, whatever the dimension
    return replace(image, data=grey.view(1, 1, *image.grid.shape))


def opaque(image: Image) -> Image:
    """Return an RGBA image as RGB, what is transparent counting as black; images without alpha as they are."""
    if image.data.shape[1] != _RGBA:
        return image
    colours, alpha = image.data[:, :3], image.data[:, 3:]
    return replace(image, data=colours * (alpha / _OPAQUE.get(image.pixel_type, 1.0)))


def require_registrable(image: Image) -> None:
    """Raise `InputError` unless the pixels are finite and not all the same: otherwise there is nothing to align."""
    if not bool(image.data.isfinite().all()):
        raise InputError(f"{image.name} has pixels that are NaN or infinite; replace them first, for instance by 0")
    if bool((image.data == image.data.flatten(2)[:, :, 0].view(1, -1, *([1] * image.grid.dim))).all()):
        raise InputError(f"{image.name} is constant, so there is nothing to align; check that it is the right file")


def require_same_place(image: Image, other: Image, *, atol: float = 1e-3) -> None:
    """Raise `InputError` unless the nodes of both images are the same points of the world, to ``atol`` of a voxel."""
    if image.grid.shape != other.grid.shape:
        sizes = f"{image.grid.size_text} and {other.grid.size_text}"
        raise InputError(f"{image.name} and {other.name} must lie on one grid, but have {sizes} nodes; resample one")
    ends, others = (some.to_world(box_corners(some.grid)) for some in (image, other))
    apart = (ends - others).norm(dim=1).max()
    if float(apart) > atol * min(other.grid.spacing):
        raise InputError(
            f"{image.name} and {other.name} must lie in one place, but their headers put them "
            f"{image.in_unit(float(apart)):.3g} {image.unit} apart; correct origin, spacing or direction in one of them"
        )


def require_same_dimension(image: Image, other: Image) -> None:
    """Raise `InputError` if one image is 2D and the other 3D."""
    if image.grid.dim != other.grid.dim:
        kinds = f"{image.name} is {image.grid.dim}D but {other.name} is {other.grid.dim}D"
        raise InputError(f"{kinds}; give two images of the same dimension")


def overlap(fixed: Image, moving: Image, *, samples: int = 32) -> float:
    """Return the share of the fixed grid that is inside the moving image, 0 (apart) to 1 (covered).

    Args:
        fixed: the image whose grid is compared.
        moving: the image it should be in; both are taken in their physical place.
        samples: positions compared along each axis, the first and the last node among them.

    Raises:
        InputError: one image is 2D and the other 3D.
    """
    require_same_dimension(fixed, moving)
    sides = [torch.linspace(0, side, samples, dtype=torch.float64, device="cpu") for side in fixed.grid.extent]
    points = torch.stack(torch.meshgrid(*sides, indexing="ij")).unsqueeze(0)
    return float(inside_box(moving.to_grid(fixed.to_world(points)), moving.grid).double().mean())


def orientation(image: Image) -> str:
    """Return what the x, y and z index axes point to, as ``LPS`` (left, posterior, superior) or ``RAI``.

    Args:
        image: 2D or 3D.

    Notes:
        An oblique axis gets the nearest direction. No two axes get the same pair of letters.
    """
    along = permutations(range(image.grid.dim))
    best = max(along, key=lambda axes: sum(abs(image.direction[world][k]) for k, world in enumerate(axes)))
    return "".join(_LETTERS[world][int(image.direction[world][k] < 0)] for k, world in enumerate(best))


def is_oblique(image: Image) -> bool:
    """Return whether an axis deviates from the world axes by more than about one degree."""
    return any(max(abs(row[k]) for row in image.direction) < math.cos(0.02) for k in range(image.grid.dim))
