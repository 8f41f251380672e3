"""Planes through images: the image itself in 2D; axial, coronal and sagittal slices in 3D."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, orientation
from torchdeform.errors import InputError, require_choice

PLANES = ("axial", "coronal", "sagittal")
SIDES = ("left", "right", "top", "bottom")
# What a piece of an image and its size are called in 2D and in 3D.
WORDS = {2: {"voxel": "pixel", "volume": "area"}, 3: {"voxel": "voxel", "volume": "volume"}}
_OPPOSITE = dict(zip("LRPAIS", "RLAPSI", strict=True))


@dataclass(frozen=True)
class Plane:
    """A way to cut a grid: the axes it shows (down, across), and which of them are flipped to the usual view.

    ``letters`` say which side of the body is at the left, right, top and bottom of the picture; empty in 2D.
    """

    name: str
    grid: Grid
    axes: tuple[int, int]
    flipped: tuple[bool, bool]
    letters: str = ""

    @property
    def through(self) -> int | None:
        """The array axis along which slices are counted; None in 2D, where there is one slice."""
        others = set(range(self.grid.dim)) - set(self.axes)
        return others.pop() if others else None

    @property
    def depth(self) -> int:
        """Number of slices."""
        return 1 if self.through is None else self.grid.shape[self.through]

    @property
    def middle(self) -> int:
        """Number of the middle slice."""
        return self.depth // 2

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes down and across."""
        return self.grid.shape[self.axes[0]], self.grid.shape[self.axes[1]]

    @property
    def aspect(self) -> float:
        """Height of a pixel over its width."""
        return self.grid.spacing[self.axes[0]] / self.grid.spacing[self.axes[1]]

    @property
    def height_over_width(self) -> float:
        """Shape of the plane in the world."""
        return self.aspect * self.shape[0] / self.shape[1]

    def cut(self, field: Tensor, slices: Sequence[int]) -> Tensor:
        """Return slices ``(n, C, n_down, n_across)`` of a field ``(1, C, *S)``."""
        return self._upright(self.chosen(field, slices)[0])

    def points(self, slices: Sequence[int]) -> Tensor:
        """Return the nodes of slices as points of the grid ``(1, D, *T)``, T having D axes; see `arrange`."""
        steps = [
            torch.arange(n, dtype=torch.float64) * h for n, h in zip(self.grid.shape, self.grid.spacing, strict=True)
        ]
        if self.through is not None:
            steps[self.through] = steps[self.through][list(slices)]
        return torch.stack(torch.meshgrid(*steps, indexing="ij")).unsqueeze(0)

    def arrange(self, values: Tensor) -> Tensor:
        """Return values ``(1, C, *T)`` at `points` as slices ``(n, C, n_down, n_across)``."""
        return self._upright(values[0])

    def chosen(self, field: Tensor, slices: Sequence[int]) -> Tensor:
        """Return slices of a field ``(1, C, *S)`` in the order of its axes, ``(1, C, *T)``."""
        if self.through is None:
            return field
        return field.index_select(self.through + 2, torch.tensor(list(slices), device=field.device))

    def _upright(self, field: Tensor) -> Tensor:
        """Bring a field ``(C, *T)`` to ``(n, C, down, across)``."""
        stack = field.unsqueeze(0) if self.through is None else field.movedim(self.through + 1, 0)
        return stack if self.axes[0] < self.axes[1] else stack.transpose(2, 3)


def planes_of(image: Image) -> list[Plane]:
    """Return the planes to show: the image itself in 2D; axial, coronal and sagittal ones in 3D.

    Volumes are shown as radiologists see them: superior up, anterior up or left, the patient's left on the right.
    """
    if image.grid.dim == 2:
        return [Plane("image", image.grid, (0, 1), (False, False))]
    z, y, x = _axes_along_world(image)
    against = [image.direction[world][2 - axis] < 0 for world, axis in ((2, z), (1, y), (0, x))]
    flipped = dict(zip((z, y, x), (not against[0], against[1], against[2]), strict=True))
    ends = orientation(image)[::-1]  # where each array axis points to
    planes = []
    for name, axes in zip(PLANES, ((y, x), (z, x), (z, y)), strict=True):
        turned = (flipped[axes[0]], flipped[axes[1]])
        bottom, right = (_OPPOSITE[ends[axis]] if turn else ends[axis] for axis, turn in zip(axes, turned, strict=True))
        planes.append(Plane(name, image.grid, axes, turned, _OPPOSITE[right] + right + _OPPOSITE[bottom] + bottom))
    return planes


def chosen_plane(image: Image, name: str | None, index: int | None) -> tuple[Plane, int]:
    """Return the plane of a name and the slice of an index; by default the axial plane and the middle slice.

    Raises:
        InputError: an unknown name, any name in 2D, or a slice that does not exist.
    """
    planes = {plane.name: plane for plane in planes_of(image)}
    if name is not None:
        require_choice(name, PLANES, "plane")
        if name not in planes:
            raise InputError(f"plane: {image.name} is 2D and has no {name} plane; leave plane out")
    plane = planes[name] if name else next(iter(planes.values()))
    if index is not None and not 0 <= index < plane.depth:
        raise InputError(f"index: there are {plane.depth} {plane.name} slices, from 0; there is no slice {index}")
    return plane, plane.middle if index is None else index


def _axes_along_world(image: Image) -> tuple[int, ...]:
    """Return the array axes that are closest to the world axes z, y and x."""
    return max(
        permutations(range(3)),
        key=lambda axes: sum(abs(image.direction[2 - k][2 - axis]) for k, axis in enumerate(axes)),
    )
