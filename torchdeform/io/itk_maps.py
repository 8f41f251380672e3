"""ITK's transform files as plain numbers. ITK reads them in a process of its own, since a bad file may crash it."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.files import native_stderr
from torchdeform.io.gate import DAMAGED
from torchdeform.io.isolated import isolated
from torchdeform.io.maps import Field, Linear, Spline, to_field

if TYPE_CHECKING:
    import SimpleITK as sitk

# A linear map is evaluated at points this far (mm) from the origin, so that large offsets cost its matrix no digits.
_STEP = 1024.0

_TEXT = (".tfm", ".txt")
_UNKNOWN = re.compile(r"create an instance of ['\"]?(\w+)")
_GRIDS = ("BSpline", "DisplacementField")  # transforms whose first fixed parameters are the size of a grid


def read(path: Path, known: str) -> list[Linear | Field | Spline]:
    """Return the maps of a file in the order in which points go through them.

    Args:
        path: the file.
        known: what can be read, for the sentence.

    Raises:
        InputError: damaged, of another kind, or with a transform that is no linear map, field or B-spline.
    """
    return isolated(_read, path, known, path=path)


def _read(path: Path, known: str) -> list[Linear | Field | Spline]:
    import SimpleITK as sitk

    if path.suffix.lower() in _TEXT:
        _require_grids(path)
    with native_stderr() as printed:
        try:
            transform = sitk.ReadTransform(str(path))
        except Exception as error:  # noqa: BLE001 - ITK's, and Python's for what it cannot convert
            if unknown := _UNKNOWN.search(str(error)):
                raise InputError(f"{path} holds a {unknown[1]}, which ITK cannot read; write it as a field") from None
            raise InputError(f"{path} cannot be read as a transform; give {known}") from None
    if any("more than one transform" in line for line in printed):
        raise InputError(f"{path} holds several transforms side by side; write them as one composite, .h5")
    if transform.GetDimension() not in (2, 3):
        raise InputError(f"{path} is a transform of {transform.GetDimension()}D; give one of 2D or 3D")
    return _maps(transform, str(path))


def _require_grids(path: Path) -> None:
    """Raise `InputError` unless a text has as many parameters as the sizes of its grids ask for."""
    for block in re.split(rb"(?m)^Transform:\s*", path.read_bytes())[1:]:
        lines = dict(re.findall(rb"(?m)^(\w*Parameters):([^\n]*)", block))
        fixed = lines.get(b"FixedParameters", b"").split()
        dim = next((d for d in (2, 3) if re.match(rb"\w+_%d_" % d, block)), 0)
        if block.startswith(tuple(name.encode() for name in _GRIDS)) and dim:
            sizes = [float(number) for number in fixed[:dim]] if len(fixed) >= dim else [math.nan]
            if len(lines.get(b"Parameters", b"").split()) != dim * math.prod(sizes):
                raise InputError(f"{path} {DAMAGED}")


def _maps(transform: "sitk.Transform", name: str) -> list[Linear | Field | Spline]:
    """Return the parts of ITK's transform in the order in which they are applied; ITK stores the reverse."""
    import SimpleITK as sitk

    if transform.IsLinear():  # true for composites of linear maps, too
        return [_linear(transform)]
    transform = transform.Downcast()
    if isinstance(transform, sitk.CompositeTransform):
        parts = [transform.GetNthTransform(k) for k in reversed(range(transform.GetNumberOfTransforms()))]
        return [found for part in parts for found in _maps(part, name)]
    if isinstance(transform, sitk.DisplacementFieldTransform):
        field = transform.GetDisplacementField()
        return [Field(sitk.GetArrayFromImage(field).astype(np.float64), *_place(field))]
    if isinstance(transform, sitk.BSplineTransform):
        images = transform.GetCoefficientImages()
        coefficients = np.stack([sitk.GetArrayFromImage(image) for image in images], axis=-1)
        return [Spline(coefficients, *_place(images[0]), transform.GetOrder())]
    raise InputError(f"{name} holds a {transform.GetName()}, which cannot be read here; {to_field(name)}")


def _place(image: "sitk.Image") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    dim = image.GetDimension()
    return np.array(image.GetOrigin()), np.array(image.GetSpacing()), np.reshape(image.GetDirection(), (dim, dim))


def _linear(transform: "sitk.Transform") -> Linear:
    """Return a linear map of any kind, found from where it maps the origin and one point on each axis."""
    dim = transform.GetDimension()
    ends = [transform.TransformPoint([_STEP * (k == axis) for k in range(dim)]) for axis in range(-1, dim)]
    offset, *columns = np.array(ends)
    return Linear((np.stack(columns, axis=1) - offset[:, None]) / _STEP, offset)
