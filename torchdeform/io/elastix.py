"""Parameter files of elastix, ``TransformParameters.0.txt``, and the files that they build on."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PureWindowsPath

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.gate import read_text
from torchdeform.io.maps import Linear, Numbers, Spline

_ENTRY = re.compile(r"\((\w+)\s(.*)\)\s*(?://.*)?")
_VALUE = re.compile(r'"([^"]*)"|([^\s"]+)')
_START = re.compile(rb"\s*(//[^\n]*\n\s*)*\(\w+[ \t]")
_INITIAL = ("InitialTransformParameterFileName", "InitialTransformParametersFileName")
_LONGEST = 32  # files that build on each other

_ADVICE = "run `transformix -def all -tp {} -out folder` and give its deformationField"

Entries = Mapping[str, Sequence[str]]


def is_elastix(head: bytes) -> bool:
    """Return whether a file that starts like this is a parameter file."""
    return _START.match(head) is not None


def read(path: Path) -> list[Linear | Spline]:
    """Return the maps of a parameter file, and before them those that it builds on, in the order points go through.

    Raises:
        InputError: no text, a kind of transform or of combination that is not known here, or missing values.
    """
    return _read(path, ())


def _read(path: Path, above: tuple[Path, ...]) -> list[Linear | Spline]:
    if path in above or len(above) > _LONGEST:
        raise InputError(f"{path} builds on itself; correct its InitialTransformParametersFileName")
    entries = _parse(path)
    name = next((entries[key][0] for key in _INITIAL if entries.get(key)), "NoInitialTransform")
    try:
        own = _map(path, entries)
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        raise InputError(f"{path} lacks values of its transform ({error}); write it again") from error
    if name == "NoInitialTransform":
        return [own]
    before = _read(_beside(path, name), (*above, path))
    return _combined(path, before, own, entries.get("HowToCombineTransforms", ["Compose"])[0])


def _parse(path: Path) -> Entries:
    entries: dict[str, list[str]] = {}
    for line in read_text(path, "transform file").splitlines():
        text = line.strip()
        if not text or text.startswith("//"):
            continue
        found = _ENTRY.fullmatch(text)
        if found is None:
            raise InputError(f"{path} has the line {text[:60]!r}, which is no parameter of elastix; correct it")
        entries[found[1]] = [quoted or plain for quoted, plain in _VALUE.findall(found[2])]
    return entries


def _beside(path: Path, name: str) -> Path:
    """Return the file that a parameter file names, by its name alone: it is where the parameter file is now."""
    return path.parent / PureWindowsPath(name).name


def _combined(path: Path, before: list[Linear | Spline], own: Linear | Spline, how: str) -> list[Linear | Spline]:
    """Return both in a row, T(x) = own(before(x)), or one for their sum, T(x) = before(x) + own(x) − x."""
    if how == "Compose":
        return [*before, own]
    if how == "Add" and len(before) == 1 and isinstance(first := before[0], Linear):
        if isinstance(own, Linear):
            return [Linear(first.matrix + own.matrix - np.eye(len(own.offset)), first.offset + own.offset)]
        moved = np.einsum("ij,...j->...i", np.linalg.inv(first.matrix), own.vectors)  # A x + b = A (x + A⁻¹ b)
        return [Spline(moved, own.origin, own.spacing, own.direction, own.order), first]
    raise InputError(f"{path} combines transforms by '{how}', which cannot be read here; {_ADVICE.format(path.name)}")


def _map(path: Path, entries: Entries) -> Linear | Spline:
    kind, dim = entries["Transform"][0], int(entries["FixedImageDimension"][0])
    if dim not in (2, 3) or entries.get("MovingImageDimension", [str(dim)])[0] != str(dim):
        raise InputError(f"{path} is a transform of {dim}D; give one of 2D or 3D")
    if kind not in _KINDS or "true" in entries.get("UseCyclicTransform", ()):
        raise InputError(f"{path} holds a {kind} of elastix, which cannot be read here; {_ADVICE.format(path.name)}")
    if entries.get("UseDirectionCosines", ["true"])[0] == "false" and not _plain(entries, dim):
        raise InputError(f"{path} leaves out the direction of its images; register again with UseDirectionCosines")
    parameters = _numbers(entries, "TransformParameters", int(entries["NumberOfParameters"][0]))
    return _KINDS[kind](entries, parameters, dim)


def _plain(entries: Entries, dim: int) -> bool:
    return "Direction" not in entries or np.array_equal(_matrix(entries, "Direction", dim), np.eye(dim))


def _numbers(entries: Entries, name: str, count: int) -> Numbers:
    """Return ``count`` finite numbers."""
    values = np.array(entries[name], dtype=np.float64)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(name)
    return values


def _matrix(entries: Entries, name: str, dim: int) -> Numbers:
    """Return a matrix of directions, which elastix writes column by column."""
    return _numbers(entries, name, dim * dim).reshape(dim, dim).T


def _centre(entries: Entries, dim: int) -> Numbers:
    """Return the centre of rotation in mm; old files have it as an index."""
    if "CenterOfRotationPoint" in entries:
        return _numbers(entries, "CenterOfRotationPoint", dim)
    index, spacing, origin = (_numbers(entries, name, dim) for name in ("CenterOfRotation", "Spacing", "Origin"))
    return origin + (np.eye(dim) if _plain(entries, dim) else _matrix(entries, "Direction", dim)) @ (spacing * index)


def _euler(entries: Entries, p: Numbers, dim: int) -> Linear:
    if dim == 2:
        return _about(entries, _turn(p[0]), p[1:])
    x, y, z = (_rotation(axis, angle) for axis, angle in enumerate(p[:3]))
    return _about(entries, z @ y @ x if "true" in entries.get("ComputeZYX", ()) else z @ x @ y, p[3:])


def _similarity(entries: Entries, p: Numbers, dim: int) -> Linear:
    if dim == 2:
        return _about(entries, p[0] * _turn(p[1]), p[2:])
    return _about(entries, p[6] * _versor(p[:3]), p[3:6])


def _affine(entries: Entries, p: Numbers, dim: int) -> Linear:
    return _about(entries, p[: dim * dim].reshape(dim, dim), p[dim * dim :])


def _affine_log(entries: Entries, p: Numbers, dim: int) -> Linear:
    from scipy.linalg import expm

    return _about(entries, np.asarray(expm(p[: dim * dim].reshape(dim, dim)), np.float64), p[dim * dim :])


def _about(entries: Entries, matrix: Numbers, shift: Numbers) -> Linear:
    if shift.shape != (len(matrix),):
        raise ValueError("TransformParameters")
    return Linear.about(_centre(entries, len(matrix)), matrix, shift)


def _translation(_: Entries, p: Numbers, dim: int) -> Linear:
    return Linear(np.eye(dim), p[:dim])


def _spline(entries: Entries, p: Numbers, dim: int) -> Spline:
    size, index = ([int(float(n)) for n in _numbers(entries, name, dim)] for name in ("GridSize", "GridIndex"))
    spacing, origin = (_numbers(entries, name, dim) for name in ("GridSpacing", "GridOrigin"))
    direction = _matrix(entries, "GridDirection", dim) if "GridDirection" in entries else np.eye(dim)
    order = int(entries.get("BSplineTransformSplineOrder", ["3"])[0])
    if min(size) < 1 or math.prod(size) * dim != len(p) or order not in (1, 2, 3):
        raise ValueError("GridSize")
    vectors = np.moveaxis(p.reshape(dim, *size[::-1]), 0, -1)
    return Spline(vectors, origin + direction @ (spacing * index), spacing, direction, order)


_KINDS: dict[str, Callable[[Entries, Numbers, int], Linear | Spline]] = {
    "EulerTransform": _euler,
    "SimilarityTransform": _similarity,
    "AffineTransform": _affine,
    "AffineLogTransform": _affine_log,
    "TranslationTransform": _translation,
    "BSplineTransform": _spline,
    "RecursiveBSplineTransform": _spline,
}


def _turn(angle: float) -> Numbers:
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def _rotation(axis: int, angle: float) -> Numbers:
    """Return the rotation about an axis of the world."""
    one, two = sorted(((axis + 1) % 3, (axis + 2) % 3))
    matrix, turn = np.eye(3), _turn(angle if axis != 1 else -angle)
    matrix[np.ix_((one, two), (one, two))] = turn
    return matrix


def _versor(v: Numbers) -> Numbers:
    """Return the rotation of a unit quaternion by its vector part."""
    x, y, z = v
    w = math.sqrt(max(0.0, 1 - float(v @ v)))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
