"""Registration that does not prefer an image: both are warped into a space between, φ = φ_m ∘ φ_f⁻¹."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.fold_free import mended
from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.image import Image
from torchdeform.core.resampling import MIN_NODES
from torchdeform.core.transform import Affine
from torchdeform.core.warp import compose, invert, sample
from torchdeform.errors import InputError
from torchdeform.registration.optimise import climb_levels
from torchdeform.registration.problem import Scene, Subject, place
from torchdeform.registration.result import Callback, LevelRecord
from torchdeform.registration.settings import RegistrationSettings

Direction = tuple[tuple[float, ...], ...]

# The space between goes beyond what both boxes share by this part of its sides, as far as either box goes.
_MARGIN = 0.2

# Steps of the iterations for roots; both converge fast where there is a root.
_ROOT_STEPS = 60


@dataclass(frozen=True)
class Middle:
    """The space between two images.

    Attributes:
        scene: both images there, with their masks and landmarks.
        from_fixed: takes grid points of the fixed grid to grid points of the scene.
        to_fixed: the inverse.
    """

    scene: Scene
    from_fixed: Callable[[Tensor], Tensor]
    to_fixed: Callable[[Tensor], Tensor]


def climb_from_middle(
    middle: Middle, grid: Grid, settings: RegistrationSettings, start: Tensor | None, callback: Callback | None
) -> tuple[Tensor, tuple[LevelRecord, ...]]:
    """Return the displacement of φ = φ_m ∘ φ_f⁻¹ on the fixed grid, and how each level went.

    Args:
        middle: the images.
        grid: the fixed grid.
        settings: how.
        start: displacement ``(B, D, *S)`` on the fixed grid to begin with; zero when None.
        callback: is shown every step.
    """
    inner = middle.scene.grid
    halves = None if start is None else _split(_start_between(start, grid, middle), inner)
    halves, records = climb_levels(middle.scene, _half(settings), halves, callback)
    to_fixed, to_moving = halves.chunk(2)
    inverse = invert(to_fixed, inner)

    def joined(rows: slice) -> Tensor:
        nodes = grid.points(dtype=torch.float64, device=halves.device, rows=rows)
        points = middle.from_fixed(nodes)
        points = points + sample(inverse, points, inner)
        points = points + sample(to_moving, points, inner)
        return (middle.to_fixed(points) - nodes).to(halves)

    u = over_slabs(joined, grid.shape, halves.device)
    return mended(u, grid, settings.min_determinant), records


def _half(settings: RegistrationSettings) -> RegistrationSettings:
    """Return the settings of either half: two maps with √J each make one with J."""
    low, soft = settings.min_determinant**0.5, settings.soft_determinant**0.5
    return replace(settings, min_determinant=low, soft_determinant=soft)


def _start_between(u: Tensor, grid: Grid, middle: Middle) -> Tensor:
    """Return the displacement that does in the middle space what u does in the fixed one."""
    nodes = middle.scene.grid.points(dtype=torch.float64, device=u.device)
    points = middle.to_fixed(nodes)
    return (middle.from_fixed(points + sample(u, points, grid)) - nodes).to(u)


def _split(u: Tensor, grid: Grid) -> Tensor:
    """Return the displacements of φ_f = φ_m⁻¹ and of φ_m with φ_m ∘ φ_m = id + u, as near as that can be had."""
    half = u / 2
    for _ in range(_ROOT_STEPS):
        half = half + (u - compose(half, half, grid)) / 2
    return torch.cat([invert(half, grid), half])


def root(affine: Affine) -> Affine:
    """Return H with H ∘ H = affine, by the iteration of Denman and Beavers.

    Raises:
        InputError: there is none near the identity: the map turns by half a circle, or mirrors.
    """
    dim = affine.offset.numel()
    whole = torch.eye(dim + 1, dtype=torch.float64)
    whole[:dim, :dim], whole[:dim, dim] = affine.matrix.double().cpu(), affine.offset.double().cpu()
    half, inverse = whole, torch.eye(dim + 1, dtype=torch.float64)
    for _ in range(_ROOT_STEPS):
        half, inverse = (half + _inverse(inverse)) / 2, (inverse + _inverse(half)) / 2
    if not bool(((half @ half - whole).abs() <= 1e-6 * whole.abs().max()).all()):
        raise InputError("register: symmetric needs an affine map without mirroring or a turn by 180 degrees")
    return Affine(half[:dim, :dim], half[:dim, dim])


def _inverse(matrix: Tensor) -> Tensor:
    return torch.linalg.inv_ex(matrix).inverse  # not finite where there is none, which the root's test finds


def common_axes(fixed: Image, moving: Image) -> Direction:
    """Return the direction matrix of both images if they share it, else that of the world's axes."""
    first, second = (torch.tensor(image.direction, dtype=torch.float64) for image in (fixed, moving))
    world = torch.eye(fixed.grid.dim).tolist()
    return fixed.direction if torch.allclose(first, second, atol=1e-6) else tuple(map(tuple, world))


def middle_frame(fixed: Image, moving: Image, axes: Direction) -> Image:
    """Return an empty image between two in one world, the same whichever comes first.

    It lies along ``axes``, covers what the boxes around both have in common and some more, and its spacing is the
    geometric mean of theirs.

    Raises:
        InputError: they have too little in common.
    """
    origin = Image(fixed.data.new_zeros(1, 1, *([2] * fixed.grid.dim)), Grid((2,) * fixed.grid.dim), (), axes)
    corners = [origin.to_grid(_corners(image)).squeeze(0) for image in (fixed, moving)]
    low = torch.stack([corner.amin(1) for corner in corners])
    high = torch.stack([corner.amax(1) for corner in corners])
    margin = _MARGIN * (high.amin(0) - low.amax(0))
    low, high = (low.amax(0) - margin).maximum(low.amin(0)), (high.amin(0) + margin).minimum(high.amax(0))
    spacing = torch.stack([_spacing_along(image, origin) for image in (fixed, moving)]).log().mean(0).exp()
    shape = ((high - low) / spacing + 1 + 1e-6).floor()
    if bool((shape < MIN_NODES).any()):
        raise InputError(f"{fixed.name} and {moving.name} have too little in common; align them first")
    rest = (high - low - (shape - 1) * spacing) / 2
    first = origin.to_world((low + rest).view(1, -1, 1)).flatten().tolist()
    grid = Grid(tuple(int(n) for n in shape), tuple(spacing.tolist()))
    return Image(fixed.data.new_zeros(1, 1, *grid.shape), grid, tuple(first), axes, "middle")


def _corners(image: Image) -> Tensor:
    ends = [torch.tensor([0.0, side], dtype=torch.float64) for side in image.grid.extent]
    return image.to_world(torch.cartesian_prod(*ends).T.unsqueeze(0))


def _spacing_along(image: Image, place: Image) -> Tensor:
    """Return the width of the image's voxels along the axes of ``place``, in units of the world."""
    steps = torch.diag(torch.tensor(image.grid.spacing, dtype=torch.float64)).unsqueeze(0)
    moved = place.to_grid(image.to_world(steps)) - place.to_grid(image.to_world(torch.zeros_like(steps)))
    return moved.squeeze(0).norm(dim=1)


def between_tensors(scene: Scene) -> Middle:
    """Return the space between two images on one grid: it is that of the grid."""
    return Middle(scene, _same, _same)


def _same(points: Tensor) -> Tensor:
    return points


def between_images(fixed: Subject, moving: Subject, affine: Affine | None, axes: Direction) -> Middle:
    """Return the space half-way between two images: from there the root of the affine map leads to either.

    Args:
        fixed: the fixed image.
        moving: the moving image, in its own place.
        affine: from the world of the first to that of the second; None for the identity.
        axes: direction of the grid, from `common_axes`.

    Raises:
        InputError: as `root`, `middle_frame`.
    """
    half = root(affine or Affine.identity(fixed.image.grid.dim))
    back = half.inverse()
    both = fixed.moved(half), moving.moved(back)
    frame = middle_frame(both[0].image, both[1].image, axes)

    def from_fixed(points: Tensor) -> Tensor:
        return frame.to_grid(half(fixed.image.to_world(points)))

    def to_fixed(points: Tensor) -> Tensor:
        return fixed.image.to_grid(back(frame.to_world(points)))

    return Middle(place(*both, frame), from_fixed, to_fixed)
