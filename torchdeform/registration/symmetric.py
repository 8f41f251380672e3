"""Registration that does not prefer an image: both are warped into a space between, φ = φ_m ∘ φ_f⁻¹.

The loop sees a batch of twice as many maps, first those to the fixed images, then those to the moving ones. What makes
them pairs is here: a similarity of both, velocities projected to those that move the two against each other, and steps
of half the length that both make or neither.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid, over_slabs
from torchdeform.core.image import Image, box_corners
from torchdeform.core.resampling import MIN_NODES
from torchdeform.core.transform import Affine
from torchdeform.core.warp import compose, invert, sample
from torchdeform.errors import InputError
from torchdeform.metrics.base import Similarity
from torchdeform.metrics.similarity import make_similarity
from torchdeform.registration.landmarks import MidspaceLandmarks, of_other_map
from torchdeform.registration.objective import Coupling, Objective, SimilarityTerm, additions, compared
from torchdeform.registration.optimise import optimise_levels
from torchdeform.registration.problem import Channels, PlacedImage, RegistrationProblem, resample_pair
from torchdeform.registration.result import Callback, LevelRecord
from torchdeform.registration.settings import RegistrationSettings

Direction = tuple[tuple[float, ...], ...]

# The space between goes beyond what both boxes share by this part of its sides, as far as either box goes.
_MARGIN = 0.2

# Steps of the iterations for roots; both converge fast where there is a root.
_ROOT_STEPS = 60


@dataclass(frozen=True)
class MidSpace:
    """The space between two images.

    Attributes:
        problem: both images there, with their masks and landmarks.
        from_fixed: takes grid points of the fixed grid to grid points of the problem.
        to_fixed: the inverse.
    """

    problem: RegistrationProblem
    from_fixed: Callable[[Tensor], Tensor]
    to_fixed: Callable[[Tensor], Tensor]


def optimise_symmetric(
    space: MidSpace, grid: Grid, settings: RegistrationSettings, start: Tensor | None, callback: Callback | None
) -> tuple[Tensor, tuple[LevelRecord, ...]]:
    """Return the displacement of φ = φ_m ∘ φ_f⁻¹ on the fixed grid, and how each level went.

    Args:
        space: the images.
        grid: the fixed grid.
        settings: how.
        start: displacement ``(B, D, *S)`` on the fixed grid to begin with; zero when None.
        callback: is shown every step.
    """
    inner, items = space.problem.grid, len(space.problem.fixed)
    halves = None if start is None else _split(_start_in(space, start, grid), inner)
    shown = None if callback is None else lambda step: callback(replace(step, similarity=step.similarity[:items]))
    halves, records = optimise_levels(space.problem, _of_half(settings), halves, shown, symmetric_objective)
    to_fixed, to_moving = halves.chunk(2)
    inverse = invert(to_fixed, inner)

    def joined(rows: slice) -> Tensor:
        nodes = grid.points(dtype=torch.float64, device=halves.device, rows=rows)
        points = space.from_fixed(nodes)
        points = points + sample(inverse, points, inner)
        points = points + sample(to_moving, points, inner)
        return (space.to_fixed(points) - nodes).to(halves)

    u = over_slabs(joined, grid.shape, halves.device)
    return repair_folds(u, grid, settings.folds.min_determinant), tuple(_of_pairs(one, items) for one in records)


def _of_half(settings: RegistrationSettings) -> RegistrationSettings:
    """Return the settings of either half: two maps with √J each make one with J, and both make half of a step."""
    folds, optimiser = settings.folds, settings.optimiser
    low, soft = folds.min_determinant**0.5, folds.soft_determinant**0.5
    return replace(
        settings,
        folds=replace(folds, min_determinant=low, soft_determinant=soft),
        optimiser=replace(optimiser, step_length=optimiser.step_length / 2),
    )


def _of_pairs(record: LevelRecord, items: int) -> LevelRecord:
    """Return the record of the pairs from that of their maps, of which both are shortened together."""
    return replace(record, similarity=tuple(v[:items] for v in record.similarity), shortened=record.shortened // 2)


def symmetric_objective(problem: RegistrationProblem, grid: Grid, settings: RegistrationSettings) -> Objective:
    """Return what is maximised where both images are warped into a space between, the maps being on ``grid``."""
    channels = compared(problem, settings)
    first, *others = [_mutual_term(problem, one, settings) for one in channels]
    pairs = problem.pairs if settings.points_weight > 0 else None
    more = additions(others, channels[1:], grid)
    landmarks = pairs and MidspaceLandmarks(*pairs, grid)
    return Objective(first, landmarks, _Opposed(), more, settings.points_weight)


def _mutual_term(problem: RegistrationProblem, channels: Channels, settings: RegistrationSettings) -> SimilarityTerm:
    """Return the similarity of channels of both images, both warped."""
    masks, given = None, problem.masks_on(channels.grid)
    if any(mask is not None for mask in given):
        ones = torch.ones_like(channels.fixed[:, :1])
        masks = torch.cat([ones if mask is None else mask for mask in given])
    similarity = _MutualSimilarity(channels, settings.similarity.window)
    return SimilarityTerm(channels.grid, torch.cat([channels.fixed, channels.moving]), similarity, masks)


class _Opposed(Coupling):
    """The two maps of a pair, half a batch apart, move against each other."""

    def velocity(self, v: Tensor) -> Tensor:
        return v - of_other_map(v)

    def all(self, flags: Tensor) -> Tensor:
        return flags & of_other_map(flags)


class _MutualSimilarity(Similarity):
    """(S(a, b) + S(b, a)) / 2 for images a and b of which both are warped.

    ``evaluate`` takes first all a, then all b, ``(2B, C, *S)``, and their masks likewise. It returns S of its pair for
    each of them ``(2B,)``, and the derivative of S(b, a) by a and of S(a, b) by b. Nothing changes when a and b change
    places, except the places.
    """

    def __init__(self, channels: Channels, window: int) -> None:
        self.channels, self.window = channels, window

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        others, of = of_other_map(warped), self.channels
        similarity = make_similarity(of.measure, others, self.window, grid=of.grid)
        value, slope = similarity.evaluate(warped, None if mask is None else mask * of_other_map(mask))
        return (value + of_other_map(value)) / 2, slope


def _start_in(space: MidSpace, u: Tensor, grid: Grid) -> Tensor:
    """Return the displacement that does in the space between what u does in the fixed one."""
    nodes = space.problem.grid.points(dtype=torch.float64, device=u.device)
    points = space.to_fixed(nodes)
    return (space.from_fixed(points + sample(u, points, grid)) - nodes).to(u)


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
    whole = torch.eye(dim + 1, dtype=torch.float64, device="cpu")
    whole[:dim, :dim], whole[:dim, dim] = affine.matrix.double().cpu(), affine.offset.double().cpu()
    half, inverse = whole, torch.eye(dim + 1, dtype=torch.float64, device="cpu")
    for _ in range(_ROOT_STEPS):
        half, inverse = (half + _inverse(inverse)) / 2, (inverse + _inverse(half)) / 2
    if not bool(((half @ half - whole).abs() <= 1e-6 * whole.abs().max()).all()):
        raise InputError("register: symmetric needs an affine map without mirroring or a turn by 180 degrees")
    return Affine(half[:dim, :dim], half[:dim, dim])


def _inverse(matrix: Tensor) -> Tensor:
    return torch.linalg.inv_ex(matrix).inverse  # not finite where there is none, which the root's test finds


def common_axes(fixed: Image, moving: Image) -> Direction:
    """Return the direction matrix of both images if they share it, else that of the world's axes."""
    first, second = (torch.tensor(image.direction, dtype=torch.float64, device="cpu") for image in (fixed, moving))
    world = torch.eye(fixed.grid.dim, dtype=torch.float64, device="cpu").tolist()
    return fixed.direction if torch.allclose(first, second, atol=1e-6) else tuple(map(tuple, world))


def midspace_frame(fixed: Image, moving: Image, axes: Direction) -> Image:
    """Return an empty image between two in one world, the same whichever comes first.

    It lies along ``axes``, covers what the boxes around both have in common and some more, and its spacing is the
    geometric mean of theirs.

    Raises:
        InputError: they have too little in common.
    """
    origin = Image(fixed.data.new_zeros(1, 1, *([2] * fixed.grid.dim)), Grid((2,) * fixed.grid.dim), (), axes)
    corners = [origin.to_grid(image.to_world(box_corners(image.grid))).squeeze(0) for image in (fixed, moving)]
    low = torch.stack([corner.amin(1) for corner in corners])
    high = torch.stack([corner.amax(1) for corner in corners])
    margin = _MARGIN * (high.amin(0) - low.amax(0))
    low, high = (low.amax(0) - margin).maximum(low.amin(0)), (high.amin(0) + margin).minimum(high.amax(0))
    spacing = torch.stack([_spacing_along(image, origin) for image in (fixed, moving)]).log().mean(0).exp()
    shape = ((high - low) / spacing + 1 + 1e-6).floor()
    if bool((shape < min(MIN_NODES, *fixed.grid.shape, *moving.grid.shape)).any()):
        raise InputError(f"{fixed.name} and {moving.name} have too little in common; align them first")
    rest = (high - low - (shape - 1) * spacing) / 2
    first = origin.to_world((low + rest).view(1, -1, 1)).flatten().tolist()
    grid = Grid(tuple(int(n) for n in shape), tuple(spacing.tolist()))
    return Image(fixed.data.new_zeros(1, 1, *grid.shape), grid, tuple(first), axes, "middle")


def _spacing_along(image: Image, place: Image) -> Tensor:
    """Return the width of the image's voxels along the axes of ``place``, in units of the world."""
    steps = torch.diag(torch.tensor(image.grid.spacing, dtype=torch.float64, device="cpu")).unsqueeze(0)
    moved = place.to_grid(image.to_world(steps)) - place.to_grid(image.to_world(torch.zeros_like(steps)))
    return moved.squeeze(0).norm(dim=1)


def midspace_of_tensors(problem: RegistrationProblem) -> MidSpace:
    """Return the space between two images on one grid: it is that of the grid."""
    return MidSpace(problem, _same, _same)


def _same(points: Tensor) -> Tensor:
    return points


def midspace_of_images(fixed: PlacedImage, moving: PlacedImage, affine: Affine | None, axes: Direction) -> MidSpace:
    """Return the space half-way between two images: from there the root of the affine map leads to either.

    Args:
        fixed: the fixed image.
        moving: the moving image, in its own place.
        affine: from the world of the first to that of the second; None for the identity.
        axes: direction of the grid, from `common_axes`.

    Raises:
        InputError: as `root`, `midspace_frame`.
    """
    half = root(affine or Affine.identity(fixed.image.grid.dim))
    back = half.inverse()
    both = fixed.moved(half), moving.moved(back)
    frame = midspace_frame(both[0].image, both[1].image, axes)

    def from_fixed(points: Tensor) -> Tensor:
        return frame.to_grid(half(fixed.image.to_world(points)))

    def to_fixed(points: Tensor) -> Tensor:
        return fixed.image.to_grid(back(frame.to_world(points)))

    return MidSpace(resample_pair(*both, frame), from_fixed, to_fixed)
