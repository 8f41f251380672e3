"""Templates: the mean shape and the mean intensity of images, from the maps of one reference onto all of them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal, TypeVar, get_args, overload

import torch
from torch import Tensor

from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.fold_free import largest_share
from torchdeform.core.grid import magnitude, per_item
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine, Displacement, Transform, place_of
from torchdeform.core.warp import compose, invert, max_voxels
from torchdeform.deformation.averages import average_maps
from torchdeform.errors import RANGES, ComputationError, InputError, require_choice, require_ranges
from torchdeform.registration.deformable import register
from torchdeform.registration.result import Callback
from torchdeform.registration.settings import RegistrationSettings

T = TypeVar("T")
Pose = Literal["reference", "mean"]

# Determinants below this count as this in the average: at the boundary those of a map without folds may be negative.
_LEAST_DETERMINANT = 0.01

# A correction that would fold the map is halved this often at most.
_HALVINGS = 8


class Lazy(Sequence[T]):
    """A sequence whose items are made whenever they are asked for, so that many large ones need no memory."""

    def __init__(self, count: int, make: Callable[[int], T]) -> None:
        self._indices, self._make = range(count), make

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[T]: ...
    def __getitem__(self, index: int | slice) -> T | Sequence[T]:
        if isinstance(index, slice):
            return [self._make(i) for i in self._indices[index]]
        return self._make(self._indices[index])


@dataclass(frozen=True, kw_only=True)
class AveragingSettings:
    """How maps and intensities are averaged.

    Args:
        pose: where the template is if the images were aligned first: ``reference``, in the reference's own position
            and orientation, only its size and shear being averaged; or ``mean``, in the mean position and orientation,
            for images in one common space.
        match_intensities: bring all images to one mean and one standard deviation first.
        corrections: how often at most the mean of the maps from the template is brought back to the identity.
        tolerance: largest move of that mean, in voxels, that counts as none.

    Raises:
        InputError: a value out of range.
    """

    pose: Pose = "reference"
    match_intensities: bool = True
    corrections: int = 4
    tolerance: float = 0.05

    def __post_init__(self) -> None:
        require_choice(self.pose, get_args(Pose), "pose")
        voxels = (RANGES["not negative"][0], "be a number of voxels, not negative")
        require_ranges(self, "", corrections="at least 1", tolerance=voxels)


_DEFAULT = AveragingSettings()


@dataclass(frozen=True)
class MeanShape:
    """The map M = P ∘ (id + m) that takes points of the reference to the template.

    Attributes:
        place: the grid of both, without pixels.
        displacement: m ``(1, D, *S)`` in units of spacing, array order.
        inverse: displacement of (id + m)⁻¹ on the same grid.
        affine: P, a map of the world; None where the images were not aligned.
        bias: largest move, in voxels, of the mean of the maps: from the reference, then from the template as corrected
            once, twice and so on. The last is what was left at the end.
    """

    place: Image
    displacement: Tensor
    inverse: Tensor
    affine: Affine | None
    bias: tuple[float, ...]

    def recentred(self, from_reference: Transform) -> Transform:
        """Return φ ∘ M⁻¹, from the template to an image, for φ from the reference to that image."""
        back = Displacement(*(replace(self.place, data=u) for u in (self.inverse, self.displacement)))
        first = () if self.affine is None else (self.affine.inverse(),)
        return Transform((*first, back, *from_reference.stages), self.place, from_reference.moving)


@dataclass(frozen=True)
class Template:
    """A template and how the images are taken to it.

    Attributes:
        image: the mean of all images, each brought into the mean shape, on the reference's grid.
        shape: the map from the reference to the template.
        maps: for each image the map that takes points of the template to the image, and brings the image onto the
            template. Its `inverse` takes points of the image to the template.
    """

    image: Image
    shape: MeanShape
    maps: Sequence[Transform]


@torch.no_grad()
def build_template(
    images: Sequence[Image],
    config: RegistrationSettings | None = None,
    *,
    rounds: int = 3,
    reference: Image | None = None,
    averaging: AveragingSettings = _DEFAULT,
    callback: Callback | None = None,
) -> Template:
    """Return the template T = mean of I_i ∘ ψ_i with the mean of the maps ψ_i being the identity.

    Args:
        images: I_i, two or more.
        config: how each is registered to the reference; preset ``default`` when None.
        rounds: how often; each takes the template of the one before as reference.
        reference: where the first round begins, and whose grid is that of the template; the first image when None.
        averaging: how maps and intensities are averaged.
        callback: is shown every step of every registration.

    Returns:
        `Template`, its maps those of the last round.

    Raises:
        InputError: fewer than two images, no round, images that cannot be registered, or channels that do not agree.
        ComputationError: a registration failed, or no template shape without folds was found.

    Notes:
        A round: φ_i from the reference to I_i by `register`; M by `average_shape`; ψ_i = φ_i ∘ M⁻¹; T by
        `average_intensities`. With exact φ_i the choice of the reference does not matter but for its grid.
    """
    if len(images) < 2 or rounds < 1:
        raise InputError(f"a template needs two images and one round at least, got {len(images)} and {rounds}")
    current = images[0] if reference is None else reference
    for _ in range(rounds - 1):
        current = _round(images, current, config, averaging, callback).image
    return _round(images, current, config, averaging, callback)


def _round(
    images: Sequence[Image],
    reference: Image,
    config: RegistrationSettings | None,
    averaging: AveragingSettings,
    callback: Callback | None,
) -> Template:
    return make_template(images, [_map(reference, i, config, callback) for i in images], reference, averaging)


def _map(reference: Image, image: Image, config: RegistrationSettings | None, callback: Callback | None) -> Transform:
    """Return the map from the reference to an image; from itself to itself the identity."""
    if image is reference:
        return identity_map(reference)
    found = register(reference, image, config, callback=callback)
    return Transform.from_displacement(
        found.displacement, reference, inverse=found.inverse, affine=found.affine, moving=image
    )


def identity_map(image: Image) -> Transform:
    """Return the identity of an image's space, as a displacement of 0 on its grid."""
    zero = image.data.new_zeros(1, image.grid.dim, *image.grid.shape)
    return Transform.from_displacement(zero, image, inverse=zero, moving=image)


@torch.no_grad()
def make_template(
    images: Sequence[Image], maps: Sequence[Transform], reference: Image, settings: AveragingSettings = _DEFAULT
) -> Template:
    """Return the template of one round: the mean shape and in it the mean of all images.

    Args:
        images: I_i, each read once.
        maps: φ_i from the reference to I_i: a displacement on the reference's grid, then affine maps or none.
        reference: the image that was registered to all.
        settings: how maps and intensities are averaged.

    Raises:
        InputError: as `average_shape` and `average_intensities`.
        ComputationError: as `average_shape`.

    Notes:
        Maps and images may be `Lazy`: then one of each is in memory at a time.
    """
    shape = average_shape(maps, reference, settings)
    recentred = Lazy(len(maps), lambda i: shape.recentred(maps[i]))
    pulled = (_pulled(image, recentred[i]) for i, image in enumerate(images))
    mean = average_intensities(pulled, match=settings.match_intensities)
    return Template(replace(mean, name="template", pixel_type="float32"), shape, recentred)


def _pulled(image: Image, from_template: Transform) -> Image:
    """Return an image on the template's grid, NaN outside it, by cubic splines within its own range."""
    low, high = float(image.data.min()), float(image.data.max())
    pulled = from_template.image(image, mode="cubic", outside=float("nan"))
    return replace(pulled, data=pulled.data.clamp(low, high))


@torch.no_grad()
def average_shape(maps: Sequence[Transform], reference: Image, settings: AveragingSettings = _DEFAULT) -> MeanShape:
    """Return M with mean of φ_i ∘ M⁻¹ = id, the mean being that of `average_maps`: by determinants and curls.

    Args:
        maps: φ_i = A_i ∘ (id + u_i) from the reference to each image: a displacement on the reference's grid, then
            affine maps or none.
        reference: the image they start from.
        settings: ``pose``, ``corrections`` and ``tolerance``.

    Returns:
        `MeanShape`.

    Raises:
        InputError: no maps, or a map that is none of that kind.
        ComputationError: a correction folds the reference, however short it is made.

    Notes:
        m ← mean ∘ m with the mean of the (id + u_i) ∘ (id + m)⁻¹, until it is the identity: the geometric mean of the
        determinants of the maps from the template is then 1 and the mean of their curls 0, as far as any map can have
        both. Affine parts A_i = Q_i S_i are averaged apart: the symmetric S_i by their logarithms, the rotations Q_i by
        the one nearest to their sum, positions by those of the middle of the grid.
    """
    for index in range(len(maps)):
        _displacement(maps, reference, index)
    grid = reference.grid
    total = reference.data.new_zeros(1, grid.dim, *grid.shape)
    back, bias = total, []
    for _ in range(settings.corrections):
        mean = _mean_displacement(maps, back, reference)
        bias.append(float(max_voxels(mean, grid)))
        if bias[-1] <= settings.tolerance:
            break
        total = _corrected(total, mean, reference)
        back = invert(total, grid)
    return MeanShape(place_of(reference), total, back, _mean_affine(maps, reference, settings.pose), tuple(bias))


def _displacement(maps: Sequence[Transform], reference: Image, index: int) -> Tensor:
    """Return u of one map A ∘ (id + u)."""
    first, *rest = maps[index].stages
    known = all(isinstance(stage, Affine) for stage in rest)
    if not known or not isinstance(first, Displacement) or first.field.grid.shape != reference.grid.shape:
        raise InputError(f"map {index} must be a displacement on the reference's grid, followed by affine maps or none")
    return first.field.data


def _mean_displacement(maps: Sequence[Transform], back: Tensor, reference: Image) -> Tensor:
    """Return the mean of the (id + u_i) ∘ (id + back)."""
    grid = reference.grid
    fields = Lazy(len(maps), lambda i: compose(_displacement(maps, reference, i).to(back), back, grid))
    return average_maps(fields, grid, least=_LEAST_DETERMINANT).value


def _corrected(total: Tensor, mean: Tensor, reference: Image) -> Tensor:
    """Return (id + mean) ∘ (id + total), with less of the mean where all of it would fold."""
    grid = reference.grid

    def corrected(share: Tensor) -> Tensor:
        return compose(per_item(share, mean) * mean, total, grid)

    def accept(share: Tensor) -> Tensor:
        return smallest_determinant(corrected(share), grid) > 0

    share = largest_share(accept, mean.new_ones(1), halvings=_HALVINGS)
    if not bool(share > 0):
        raise ComputationError(f"{reference.name}: its mean shape folds; take another image as reference")
    return corrected(share)


def _mean_affine(maps: Sequence[Transform], reference: Image, pose: Pose) -> Affine | None:
    """Return P: the mean stretch about the middle of the reference, and its mean rotation and position if asked for."""
    dim = reference.grid.dim
    chains = [[stage for stage in map_.stages if isinstance(stage, Affine)] for map_ in maps]
    if not any(chains):
        return None
    affines = [reduce(Affine.then, chain, Affine.identity(dim)) for chain in chains]
    left, sizes, right = torch.linalg.svd(torch.stack([a.matrix.double().cpu() for a in affines]))
    logarithms = right.mT @ torch.diag_embed(sizes.log()) @ right
    matrix = torch.matrix_exp(logarithms.mean(0))
    half = torch.tensor(reference.grid.extent, dtype=torch.float64, device="cpu").view(1, -1, 1) / 2
    middle = reference.to_world(half)
    goal = middle
    if pose == "mean":
        left, _, right = torch.linalg.svd((left @ right).sum(0))  # left @ right is the rotation nearest to the sum
        matrix = left @ right @ matrix
        goal = torch.stack([a(middle) for a in affines]).mean(0)
    return Affine(matrix, (goal[0] - matrix @ middle[0]).squeeze(1))


@torch.no_grad()
def average_intensities(images: Iterable[Image], *, match: bool = True) -> Image:
    """Return the mean over the images that are known at each node, 0 where none is.

    Args:
        images: on one grid, NaN outside an image; read once, one after the other.
        match: scale each to the average mean and the average standard deviation of all, channel by channel.

    Raises:
        InputError: no image, or shapes that do not agree.
    """
    total = count = torch.zeros((), dtype=torch.float32, device="cpu")
    levels, first = [], None
    for image in images:
        first = first or image
        if image.data.shape != first.data.shape:
            shapes = f"{tuple(first.data.shape)} and {tuple(image.data.shape)}"
            raise InputError(f"{image.name}: images of a template must agree in grid and channels, got {shapes}")
        known = image.data.isfinite().all(dim=1, keepdim=True)
        mean, spread = _level(image.data, known) if match else (0.0, 1.0)
        total = torch.where(known, (image.data - mean) / spread, 0.0) + total.to(image.data)
        count = known + count.to(image.data)
        levels.append((mean, spread))
    if first is None:
        raise InputError("a template needs images, got none")
    mean, spread = (sum(values) / len(levels) for values in zip(*levels, strict=True))
    data = torch.where(count > 0, total / count.clamp(min=1) * spread + mean, 0.0)
    return replace(first, data=data.to(first.data.dtype))


def _level(data: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation of each channel over the nodes that are known, ``(1, C, 1, ..)`` each."""
    axes, nodes = tuple(range(2, data.dim())), known.sum().clamp(min=1)
    data = data.where(known, 0.0)
    scale = magnitude(data)
    data = data / scale
    mean = data.sum(axes, keepdim=True) / nodes
    variance = (data - mean).where(known, 0.0).square().sum(axes, keepdim=True) / nodes
    return mean * scale, (variance.sqrt() * scale).clamp(min=torch.finfo(data.dtype).tiny)
