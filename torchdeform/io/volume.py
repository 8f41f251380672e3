"""Pixels with their place in the world as readers find them, without torch: a process of its own can read them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError

NOT_SQUARE = "has axes that are not at right angles; reslice it onto a rectangular grid first"
NOT_FINITE = "has pixels that are NaN or infinite; replace them first, for instance by 0"

# Types whose values float32, in which images are read, cannot all represent.
_WIDE = ("int32", "uint32", "int64", "uint64", "float64")

# How much the products of the columns of a direction matrix may deviate from those of right angles: headers with three
# digits deviate by up to this much. Less than the second number is left as it is.
_ROUNDED, _EXACT = 5e-3, 1e-6
SINGULAR = 1e-6  # `independence` of directions that lie in a plane


@dataclass(frozen=True)
class Volume:
    """An image as its file stores it.

    Attributes:
        values: pixels ``(*S, C)`` in array order, the type of the file.
        spacing: distance of the pixels along x, y, z in mm.
        origin: world position (x, y, z) of the first pixel in LPS mm.
        direction: world directions of the axes x, y, z as columns.
        unit: what its lengths are shown in, see `Image`.
        remarks: sentences about what the reader had to decide.
        intent: NIfTI's code of what the numbers are, 0 for none.
        stacked: whether the numbers of a pixel stand on the fourth axis of the file, as volumes of a series do.
    """

    values: NDArray[np.generic]
    spacing: tuple[float, ...]
    origin: tuple[float, ...]
    direction: NDArray[np.float64]
    unit: str = "mm"
    remarks: tuple[str, ...] = ()
    intent: int = 0
    stacked: bool = False

    @property
    def size(self) -> tuple[int, ...]:
        """Number of pixels along x, y, z."""
        return self.values.shape[-2::-1]

    def in_units_of(self, length: float, unit: str) -> "Volume":
        """Return the volume whose numbers were in units of ``length`` mm."""
        scaled = [tuple(length * value for value in numbers) for numbers in (self.spacing, self.origin)]
        return replace(self, spacing=scaled[0], origin=scaled[1], unit=unit)


def held_type(kind: np.dtype[Any], *, exact: bool) -> np.dtype[Any]:
    """Return the type that pixels of a file get: float32, or float64 where ``exact`` and float32 merges values."""
    return np.dtype("float64" if exact and kind.name in _WIDE else "float32")


def independence(columns: NDArray[np.float64]) -> float:
    """Return |det| / Π |column|, from 1 to 0: how far columns ``(D, D)`` of any lengths are from lying in a plane."""
    lengths = np.linalg.norm(columns, axis=0)
    return float(abs(np.linalg.det(columns / lengths))) if np.isfinite(lengths).all() and lengths.all() else 0.0


def squared(direction: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """Return the rotation (or mirrored one) nearest to a direction matrix that was rounded.

    Raises:
        InputError: the axes are not at right angles.

    Notes:
        With direction = U S Vᵀ that is U Vᵀ.
    """
    error = np.abs(direction.T @ direction - np.eye(len(direction))).max()
    if not error <= _ROUNDED:
        raise InputError(f"{name} {NOT_SQUARE}")
    if error < _EXACT:
        return direction
    left, _, right = np.linalg.svd(direction)
    return np.asarray(left @ right, np.float64)


def is_stack(size: Sequence[int]) -> bool:
    """Return whether the fourth axis can hold vectors: it has as many numbers as there are axes of space."""
    return len(size) == 4 and size[3] == sum(n > 1 for n in size[:3])


def require_one(path: Path, size: Sequence[int], *, endings: Sequence[str] = ()) -> None:
    """Raise `InputError` if an image of this size (x, y, z, t, ...) is a series.

    Args:
        path: the file.
        size: of its axes.
        endings: names by which nibabel, which then takes a volume out instead of ITK, knows the format.
    """
    if max(size[3:], default=1) == 1:
        return
    first = f"[{', '.join(':::')}{', 0' * (len(size) - 3)}]"
    known = not endings or path.name.endswith(tuple(endings))
    named, rename = (path, "") if known else (f"series{endings[0]}", f"copy it to series{endings[0]}, ")
    take = (
        f'nibabel.save(nibabel.load("{named}").slicer{first}, "frame.nii.gz")'
        if endings
        else f'SimpleITK.WriteImage(SimpleITK.ReadImage("{named}"){first}, "frame.nii.gz")'
    )
    raise InputError(
        f"{path} is a series of {math.prod(size[3:])} volumes, size {tuple(size)}; {rename}take one out and give that: "
        f"{take}"
    )
