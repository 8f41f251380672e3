"""One scene of the world in two images on different grids, with the affine map between them."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine
from torchdeform.metrics.correlation import ForegroundLNCC
from torchdeform.metrics.similarity import make_similarity
from torchdeform.registration.affine.objective import AffineObjective, MaskedImage, NormalisedFrame

TILTED = {
    2: ((math.cos(0.4), -math.sin(0.4)), (math.sin(0.4), math.cos(0.4))),
    3: ((0.936293363584, -0.275095847318, 0.218350663146),
        (0.289629477625, 0.956425085849, -0.036957013525),
        (-0.198669330795, 0.097843395007, 0.975170327202)),
}  # fmt: skip


SHAPES = {2: ((60, 76), (84, 68)), 3: ((32, 40, 48), (40, 44, 50))}


SPACINGS = {2: ((1.4, 1.2), (1.2, 1.3)), 3: ((2.0, 1.6, 1.4), (1.6, 1.7, 1.5))}


SIDES = (60.0, 44.0, 36.0)


def scene(world: Tensor, count: int = 14) -> Tensor:
    """A value for every world point: blobs of different width and height near the origin, no two places alike."""
    random = torch.Generator().manual_seed(0)
    dim = world.shape[1]
    centres = (torch.rand(count, dim, generator=random, dtype=torch.float64) - 0.5) * torch.tensor(SIDES[:dim])
    widths = 5 + 5 * torch.rand(count, generator=random, dtype=torch.float64)
    heights = 50 + 150 * torch.rand(count, generator=random, dtype=torch.float64)
    total = torch.zeros_like(world[:, :1])
    for centre, width, height in zip(centres, widths, heights, strict=True):
        away = (world - centre.view(1, -1, *([1] * (world.dim() - 2)))).square().sum(1, keepdim=True)
        total += height * torch.exp(-away / (2 * width**2))
    return total


def empty(shape, spacing, *, centre=None, tilted=False) -> Image:
    """An image whose box has its middle at ``centre``."""
    grid = Grid(shape, spacing)
    image = Image(torch.zeros(1, 1, *shape), grid, (), TILTED[len(shape)] if tilted else ())
    middle = image.to_world(torch.tensor(grid.extent, dtype=torch.float64).view(1, -1, 1) / 2).flatten()
    target = torch.zeros(len(shape)) if centre is None else torch.as_tensor(centre)
    return replace(image, origin=tuple((target - middle).tolist()))


def picture(place: Image, through: Affine | None = None) -> Image:
    """The scene on the grid of ``place``, each world point being taken through a map first."""
    world = place.to_world(place.grid.points(dtype=torch.float64))
    return replace(place, data=scene(world if through is None else through(world)).float())


def make_pair(true: Affine, *, follow: bool = False, finer: float = 1.0) -> tuple[Image, Image]:
    """Two images with moving(true(x)) = fixed(x), on grids that have nothing in common."""
    dim = len(true.offset)
    (first, second), (wide, other) = SHAPES[dim], SPACINGS[dim]
    fixed = picture(empty(first, wide, tilted=True))
    other = tuple(h * finer for h in other)
    return fixed, picture(empty(second, other, centre=true.offset if follow else None), true.inverse())


def turn(dim: int, degrees: float) -> Tensor:
    axis = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) / math.sqrt(14)
    a, b, c = (math.radians(degrees) * axis).tolist()
    spin = {2: [[0.0, -math.radians(degrees)], [math.radians(degrees), 0.0]], 3: [[0, -c, b], [c, 0, -a], [-b, a, 0]]}
    return torch.matrix_exp(torch.tensor(spin[dim], dtype=torch.float64))


def make_true(linear: Tensor, *shift: float) -> Affine:
    offset = torch.tensor((shift or (3.0, -4.0, 2.0))[: len(linear)], dtype=torch.float64)
    return Affine(linear, offset)


def distance(found: Affine, true: Affine, fixed: Image) -> float:
    """Mean distance of both maps over the fixed grid, in its smallest voxels."""
    world = fixed.to_world(fixed.grid.points(dtype=torch.float64))
    return float((found(world) - true(world)).norm(dim=1).mean()) / min(fixed.grid.spacing)


def make_objective(dim: int, similarity: str = "ncc") -> AffineObjective:
    fixed, moving = make_pair(make_true(turn(dim, 10)))
    weight = torch.rand(fixed.data.shape, generator=torch.Generator().manual_seed(1))
    parts = (
        MaskedImage(replace(fixed, data=fixed.data.double() / 200), weight.double()),
        MaskedImage(replace(moving, data=moving.data.double() / 200)),
    )
    make = {"detail": lambda f, grid: ForegroundLNCC(f, 5)}.get(
        similarity, lambda f, grid: make_similarity(similarity, f, 5, grid=grid)
    )
    return AffineObjective(*parts, NormalisedFrame.of(fixed), make, 0.1)
