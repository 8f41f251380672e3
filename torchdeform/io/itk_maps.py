"""ITK's transform files as plain numbers. ITK reads them in a process of its own, since a bad file may crash it."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError
from torchdeform.io.files import native_stderr
from torchdeform.io.gate import DAMAGED, reading
from torchdeform.io.isolated import isolated
from torchdeform.io.loading import volume_of
from torchdeform.io.maps import Linear, Spline, to_field
from torchdeform.io.volume import Volume

if TYPE_CHECKING:
    import SimpleITK as sitk

# A linear map is evaluated at points this far (mm) from the origin, so that large offsets cost its matrix no digits.
_STEP = 1024.0

_TEXT = (".tfm", ".txt")
_UNKNOWN = re.compile(r"create an instance of ['\"]?(\w+)")
_AFFINE, _ONE_PER_AXIS = ("Affine", "MatrixOffsetTransformBase"), ("Translation", "Scale")
_COUNTS = {"Rigid2D": 3, "Euler2D": 3, "Similarity2D": 4, "Versor": 3, "Euler3D": 6, "VersorRigid3D": 6,
           "QuaternionRigid": 7, "Similarity3D": 7, "ScaleVersor3D": 9, "ScaleSkewVersor3D": 15}  # fmt: skip
_GRIDS = ("BSpline", "DisplacementField")  # transforms whose first fixed parameters are the size of a grid


def read(path: Path, known: str) -> list[Linear | Spline | Volume]:
    """Return the maps of a file in the order in which points go through them.

    Args:
        path: the file.
        known: what can be read, for the sentence.

    Raises:
        InputError: damaged, of another kind, or with a transform that is no linear map, field or B-spline.
    """
    return isolated(_read, path, known, path=path)


def _read(path: Path, known: str) -> list[Linear | Spline | Volume]:
    import SimpleITK as sitk

    if path.suffix.lower() in _TEXT:
        with reading(path):
            _require_whole(path)
    with native_stderr() as printed:
        try:
            transform = sitk.ReadTransform(str(path))
        except Exception as error:  # noqa: BLE001 - ITK's, and Python's for what it cannot convert
            if unknown := _UNKNOWN.search(str(error)):
                raise InputError(f"{path} holds a {unknown[1]}, which ITK cannot read; write it as a field") from None
            if isinstance(error, KeyError):
                what = "a transform that SimpleITK has no class for"
                raise InputError(f"{path} holds {what}; write it as an AffineTransform or as a field") from None
            raise InputError(f"{path} cannot be read as a transform; give {known}") from None
    if any("more than one transform" in line for line in printed):
        raise InputError(f"{path} holds several transforms side by side; write them as one composite, .h5")
    if transform.GetDimension() not in (2, 3):
        raise InputError(f"{path} is a transform of {transform.GetDimension()}D; give one of 2D or 3D")
    with native_stderr():  # of matrices without sense
        return _maps(transform, str(path))


def _require_whole(path: Path) -> None:
    """Raise `InputError` unless every transform of a text has all its parameters, and finite ones.

    Notes:
        ITK takes the identity where the line of fixed parameters is cut off, and crashes at numbers that are none.
    """
    for block in re.split(r"(?m)^[ \t]*Transform:\s*", path.read_text(encoding="utf-8", errors="replace"))[1:]:
        found = re.match(r"(\w+?)_\w+_([23])_", block)
        if found is None or found[1].startswith("Composite"):
            continue
        lines = dict(re.findall(r"(?m)^[ \t]*(\w*Parameters):([^\n]*)", block))
        if not {"Parameters", "FixedParameters"} <= lines.keys():
            raise InputError(f"{path} {DAMAGED}")
        own, fixed = (np.array(lines[key].split(), np.float64) for key in ("Parameters", "FixedParameters"))
        if not (np.isfinite(own).all() and np.isfinite(fixed).all()):
            raise InputError(f"{path} holds numbers that are not finite; make it again")
        if len(own) != _count(found[1], int(found[2]), fixed, len(own)):
            raise InputError(f"{path} {DAMAGED}")


def _count(name: str, dim: int, fixed: NDArray[np.float64], default: int) -> float:
    """Return how many parameters a transform of ITK has."""
    if name.startswith(_GRIDS):
        return dim * math.prod(fixed[:dim]) if len(fixed) >= dim else math.nan
    sizes = dict.fromkeys(_AFFINE, dim * (dim + 1)) | dict.fromkeys(_ONE_PER_AXIS, dim) | _COUNTS
    return sizes.get(name.removesuffix("Transform"), default)


def _maps(transform: "sitk.Transform", name: str) -> list[Linear | Spline | Volume]:
    """Return the parts of ITK's transform in the order in which they are applied; ITK stores the reverse."""
    import SimpleITK as sitk

    if transform.IsLinear():  # true for composites of linear maps, too
        return [_linear(transform)]
    transform = transform.Downcast()
    if isinstance(transform, sitk.CompositeTransform):
        parts = [transform.GetNthTransform(k) for k in reversed(range(transform.GetNumberOfTransforms()))]
        return [found for part in parts for found in _maps(part, name)]
    if isinstance(transform, sitk.DisplacementFieldTransform):
        return [volume_of(transform.GetDisplacementField())]
    if isinstance(transform, sitk.BSplineTransform):
        return [Spline(volume_of(sitk.Compose(transform.GetCoefficientImages())), transform.GetOrder())]
    raise InputError(f"{name} holds a {transform.GetName()}, which cannot be read here; {to_field(name)}")


def _linear(transform: "sitk.Transform") -> Linear:
    """Return a linear map of any kind, found from where it maps the origin and one point on each axis."""
    dim = transform.GetDimension()
    ends = [transform.TransformPoint([_STEP * (k == axis) for k in range(dim)]) for axis in range(-1, dim)]
    offset, *columns = np.array(ends)
    return Linear((np.stack(columns, axis=1) - offset[:, None]) / _STEP, offset)
