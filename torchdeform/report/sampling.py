"""Values of both images, of their labels, masks and tissue at the points of slices, and how they become grey."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchdeform.core.image import Image, luminance, same_place, surroundings
from torchdeform.core.transform import Affine
from torchdeform.core.warp import inside_box, sample
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.result import RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report.planes import Plane

FIXED, WARPED, MOVING, ORIGINAL = "fixed", "warped", "moving", "original"
_PERCENTILES = (0.5, 99.5)


@dataclass(frozen=True)
class Sampled:
    """What one image shows at points ``(1, C, *T)``.

    Attributes:
        colours: from 0 to 1, 1 or 3 channels.
        grey: from 0 to 1.
        inside: where the image has values, bool.
        labels: 0 outside; None without.
        mask: bool; None without.
        tissue: labels of tissue that the settings name, 0 elsewhere; None without.
    """

    colours: Tensor
    grey: Tensor
    inside: Tensor
    labels: Tensor | None = None
    mask: Tensor | None = None
    tissue: Tensor | None = None


class PairSampler:
    """Both images of a pair at nodes of the fixed grid, the moving one at each stage of the registration."""

    def __init__(self, fixed: Image, moving: Image, result: RegistrationResult, annotations: Annotations) -> None:
        self.fixed, self.moving, self.affine = fixed, moving, result.affine
        self.u = result.displacement.detach().cpu()
        self.stages = (WARPED, MOVING) if result.affine is None else (WARPED, MOVING, ORIGINAL)
        warped = replace(moving, data=result.warped.detach().cpu().float(), grid=fixed.grid)
        self._on_grid = {FIXED: _with_grey(fixed), WARPED: _with_grey(warped)}
        tissue = _named(annotations.tissue, result.settings)
        self._fixed = _Side(fixed, annotations.fixed_labels, annotations.fixed_mask, tissue)
        self._moving = _Side(moving, annotations.moving_labels, annotations.moving_mask)

    def at(self, image: str, points: Tensor, chosen: Callable[[Tensor], Tensor]) -> Sampled:
        """Return what an image shows at some nodes; labels and masks where both images can be compared.

        Args:
            image: one of the names above.
            points: the nodes ``(1, D, *T)`` in units of spacing.
            chosen: takes a field on the fixed grid to its values there.
        """
        values = chosen(self._on_grid[image]) if image in self._on_grid else None
        if image == FIXED:
            return self._fixed.at(_Nodes(self.fixed, None, points), values)
        affine = None if image == ORIGINAL else self.affine
        nodes = _Nodes(self.fixed, affine, points + chosen(self.u) if image == WARPED else points)
        return self._moving.at(nodes, values, labels=image != ORIGINAL, mask=image == WARPED)

    def at_slices(self, image: str, plane: Plane, numbers: Sequence[int]) -> Sampled:
        """Return what an image shows in slices, each part ``(n, C, n_down, n_across)``."""
        found = self.at(image, plane.points(numbers).to(self.u), lambda field: plane.chosen(field, numbers))
        parts = {name: None if part is None else plane.arrange(part) for name, part in vars(found).items()}
        return replace(found, **parts)


def _named(tissue: object, settings: RegistrationSettings) -> Image | None:
    """Return the labels of tissue that the settings name, 0 elsewhere; None without."""
    if not isinstance(tissue, Image):
        return None
    names = torch.tensor([*settings.tissues, *settings.sliding], device=tissue.data.device)
    return replace(tissue, data=tissue.data * torch.isin(tissue.data, names.to(tissue.data)))


def _with_grey(image: Image) -> Tensor:
    """Return the colours of an image and their grey values as channels, of a grey image only these."""
    values = grey(image)
    return torch.cat((image.data[:, :3], values), dim=1).float() if _coloured(image.data) else values.float()


@dataclass(frozen=True)
class _Nodes:
    """Points ``(1, D, *T)`` of the fixed grid, that ``affine`` takes from its world to that of another image."""

    fixed: Image
    affine: Affine | None
    points: Tensor

    def on(self, image: Image) -> Tensor:
        """Return where they are on the grid of an image."""
        return _mapped(self.fixed, image, self.affine, self.points)


class _Side:
    """One image with its labels, its mask and its tissue."""

    def __init__(self, image: Image, labels: object, mask: object, tissue: object = None) -> None:
        self._image, self._labels, self._mask, self._tissue = image, labels, mask, tissue
        self._data = _with_grey(image)
        self._empty = surroundings(replace(image, data=self._data))
        self._colours, self._grey = ends(image.data), ends(self._data[:, -1:])

    def at(self, nodes: _Nodes, values: Tensor | None, *, labels: bool = True, mask: bool = True) -> Sampled:
        """Return what is at the nodes; the pixels are ``values`` if given."""
        place = nodes.on(self._image)
        inside = inside_box(place, self._image.grid)
        if values is None:
            values = sample(self._data, place, self._image.grid)
            values = values.where(inside, self._empty.view(1, -1, *[1] * self._image.grid.dim))
        greys = _between(values[:, -1:], *self._grey)
        colours = _between(values[:, :3], *self._colours) if values.shape[1] > 1 else greys
        parts = (self._labels if labels else None, self._mask if mask else None, self._tissue)
        return Sampled(colours, greys, inside, *(self._nearest(part, nodes, place, inside) for part in parts))

    def _nearest(self, part: object, nodes: _Nodes, place: Tensor, inside: Tensor) -> Tensor | None:
        """Return labels, a mask or tissue at the nodes, 0 outside."""
        if not isinstance(part, Image):
            return None
        if not same_place(part, self._image):
            place = nodes.on(part)
            inside = inside_box(place, part.grid)
        return sample(part.data.float(), place, part.grid, mode="nearest") * inside


def sample_at_fixed(values: Tensor, image: Image, fixed: Image, points: Tensor) -> Tensor:
    """Return values on an image's grid at points of the fixed grid ``(1, D, *T)``, 0 outside the image."""
    return sample(values.float(), _mapped(fixed, image, None, points), image.grid, outside=0.0)


def _mapped(fixed: Image, image: Image, affine: Affine | None, points: Tensor) -> Tensor:
    """Return where points of the fixed grid are on an image's grid.

    The three maps from grid to grid are one matrix, so that points may be float32 however far away the origin is.
    """
    matrix, offset = (part.to(points) for part in _from_grid_to_grid(fixed, image, affine))
    return (matrix @ points.flatten(2) + offset).view(points.shape)


def _from_grid_to_grid(fixed: Image, image: Image, affine: Affine | None) -> tuple[Tensor, Tensor]:
    """Return M ``(D, D)`` and t ``(D, 1)`` of the map x ↦ M x + t from points of one grid to those of the other."""
    dim = fixed.grid.dim
    world = fixed.to_world(torch.cat((torch.zeros(dim, 1), torch.eye(dim)), dim=1).double().unsqueeze(0))
    ends = image.to_grid(world if affine is None else affine(world))[0]
    return ends[:, 1:] - ends[:, :1], ends[:, :1]


def to_unit(values: Tensor, scale: Tensor) -> Tensor:
    """Return values with the dark and bright ends of ``scale`` at 0 and 1, one scale for all colours, without alpha.

    Of channels that are no colours the first is used. NaN becomes 0.
    """
    return _between(values[:, _shown_channels(scale)], *ends(scale))


def _between(values: Tensor, low: float, high: float) -> Tensor:
    return ((values - low) / max(high - low, 1e-12)).clamp(0, 1).nan_to_num(0.0)


def ends(values: Tensor) -> tuple[float, float]:
    """Return the dark and the bright end of the channels that are shown."""
    low, high = quantiles(values[:, _shown_channels(values)], *_PERCENTILES)
    return low, high


def _shown_channels(values: Tensor) -> slice:
    return slice(0, 3 if _coloured(values) else 1)


def _coloured(values: Tensor) -> bool:
    return values.shape[1] in (3, 4)  # colours, without and with alpha


def grey(image: Image) -> Tensor:
    """Return the luminance of a colour picture, else the first channel, ``(1, 1, *S)``."""
    return luminance(image).data if _coloured(image.data) else image.data[:, :1]


def quantiles(values: Tensor, *percent: float) -> list[float]:
    """Return percentiles of the finite values, of at most a million of them at regular steps."""
    flat = values.reshape(-1)
    some = flat[:: 1 + flat.numel() // 2**20]
    finite = some[some.isfinite()].cpu()
    return [float(q) for q in np.percentile(finite.numpy(), percent)] if len(finite) else [0.0] * len(percent)
