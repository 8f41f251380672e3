"""Landmarks on disk: csv, tsv, elastix txt, 3D Slicer's fcsv and mrk.json. In memory they are world points, LPS mm."""

import csv
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io.files import atomic_folder, suffix
from torchdeform.io.gate import require_file

_WORLD, _VOXEL = ("x", "y", "z"), ("i", "j", "k")
_NAMES = ("name", "label", "landmark", "id", "index", "")

# How versions of Slicer write their coordinate systems. RAS is meant where nothing is written.
_SYSTEMS = {"lps": "lps", "1": "lps", "ras": "ras", "0": "ras", "": "ras"}
_FCSV_COLUMNS = ["label", "x", "y", "z", "sel", "vis"]  # of versions that name no columns

_Path = str | os.PathLike[str]


@dataclass(frozen=True)
class Points:
    """Points in the world with names.

    Args:
        positions: ``(N, D)``, (x, y, z) in LPS mm, float64.
        names: one for each point.
        named: False if a file has no names, or the same name twice. The names are then 1, 2, 3, ...
    """

    positions: Tensor
    names: tuple[str, ...]
    named: bool = True


@dataclass(frozen=True)
class _Table:
    """The content of a file: names (empty if there are none) and rows of numbers, world LPS mm or voxel indices."""

    names: list[str]
    rows: list[list[float]]
    voxels: bool = False
    flat: bool = False  # a third column of zeros means 2D points


def read_points(path: _Path, image: Image | None = None, *, dim: int | None = None) -> Points:
    """Read landmarks.

    Args:
        path: ``.csv`` or ``.tsv`` with columns x, y[, z] (world LPS mm, which are pixels for a picture with spacing 1)
            or i, j[, k] (voxel index of ``image`` along its x, y, z axes, from 0), in upper or lower case, with or
            without a column of names (name, label, landmark, id, index, or no title); or 2 or 3 numbers per line
            without titles; or ANTs' x, y, z, t. ``.txt`` of elastix (``point`` or ``index``, count, rows). ``.fcsv``
            and ``.mrk.json`` of 3D Slicer, in RAS or LPS as the header says.
        image: the image that voxel indices refer to; it also says whether points are 2D or 3D.
        dim: 2 or 3; by default that of the image, without an image that of the file.

    Returns:
        The points in the world. If 2D points are needed, a third coordinate that is always 0 is dropped.

    Raises:
        InputError: the file is missing, of another kind, without points, with values that are no finite numbers, with
            indices but without an image, or with points of another dimension.
    """
    file = Path(path)
    require_file(file)
    if suffix(file) not in _READERS:
        raise InputError(f"{path} is no file of points; use one of {', '.join(_READERS)}")
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text; give points as {', '.join(_READERS)}") from error
    table = _READERS[suffix(file)](text, str(path))
    if not table.rows:
        raise InputError(f"{path} holds no points; check that it is the right file")
    return _place(table, str(path), image, dim or (image.grid.dim if image is not None else None))


def matched(fixed: Points, moving: Points) -> tuple[Tensor, Tensor, tuple[str, ...]]:
    """Return the points that two files share, matched by name, or by order if a file has no names.

    Returns:
        Positions ``(N, D)`` in both images, and the names. A row is the same landmark in both.

    Raises:
        InputError: no name in common, or no names and different counts.
    """
    if fixed.named and moving.named:
        names = tuple(name for name in fixed.names if name in set(moving.names))
        if not names:
            raise InputError("the fixed and the moving points have no name in common; give the same names to both")
        rows = [[points.names.index(name) for name in names] for points in (fixed, moving)]
        return fixed.positions[rows[0]], moving.positions[rows[1]], names
    counts = len(fixed.names), len(moving.names)
    if counts[0] != counts[1]:
        raise InputError(f"there are {counts[0]} fixed but {counts[1]} moving points without names; pair them by names")
    return fixed.positions, moving.positions, fixed.names


def write_points(points: Points, path: _Path) -> None:
    """Write landmarks, world LPS mm, in the format of the file's ending; see `read_points`.

    Args:
        points: names and positions.
        path: the file; an existing one is replaced.

    Raises:
        InputError: an unknown ending, or a folder that cannot be written.
    """
    file = Path(path)
    require_points_file(file)
    text = _WRITERS[suffix(file)](points)
    with atomic_folder(file.parent) as folder:
        (folder / file.name).write_text(text, encoding="utf-8")


def require_points_file(path: Path) -> None:
    """Raise `InputError` unless points can be written to files of this ending."""
    if suffix(path) not in _WRITERS:
        raise InputError(f"{path} has no ending that points are written with; use one of {', '.join(_WRITERS)}")


def _place(table: _Table, name: str, image: Image | None, dim: int | None) -> Points:
    """Return the points of a table in the world."""
    wide = len(table.rows[0])
    zeros = wide == 3 and all(row[2] == 0 for row in table.rows)
    needed = dim or (2 if zeros and table.flat else wide)
    if needed != wide and not (needed == 2 and zeros):
        raise InputError(f"{name} holds {wide}D points, but {needed}D is needed here; give points of that dimension")
    positions = torch.tensor([row[:needed] for row in table.rows], dtype=torch.float64)
    if table.voxels:
        positions = _from_voxels(positions, name, image)
    named = all(table.names) and len(set(table.names)) == len(table.rows)
    return Points(positions, tuple(table.names) if named else _numbers(len(table.rows)), named)


def _from_voxels(index: Tensor, name: str, image: Image | None) -> Tensor:
    if image is None:
        raise InputError(
            f"{name} counts in voxels; give the image that the points belong to, or points in world mm (x, y, z)"
        )
    if image.grid.dim != index.shape[1]:
        raise InputError(f"{name} holds {index.shape[1]}D points, but {image.name} is {image.grid.dim}D; give others")
    spacing = torch.tensor(image.grid.spacing, dtype=torch.float64)
    return image.to_world((index.flip(1) * spacing).T.unsqueeze(0))[0].T


def _numbers(count: int) -> tuple[str, ...]:
    return tuple(str(k + 1) for k in range(count))


def _floats(cells: Sequence[object], name: str) -> list[float]:
    """Return cells as finite numbers, `InputError` if one is none."""
    try:
        values = [float(cell) for cell in cells]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        row = ", ".join(str(cell).strip() for cell in cells)
        raise InputError(f"{name}: '{row}' are no coordinates; write finite numbers with a decimal point")
    return values


def _read_csv(text: str, name: str) -> _Table:
    return _read_columns(text, name, ";" if ";" in text.split("\n")[0] else ",")


def _read_columns(text: str, name: str, separator: str) -> _Table:
    rows = [row for row in csv.reader(text.splitlines(), delimiter=separator) if any(cell.strip() for cell in row)]
    for k, row in enumerate(rows):
        titles = [cell.strip().lstrip("#").strip().lower() for cell in row]
        if axes := _axes(titles):
            return _from_columns(rows[k + 1 :], titles, axes, name)
        if not row[0].lstrip().startswith("#"):
            break
    plain = [row for row in rows if not row[0].lstrip().startswith("#")]
    if plain and (len(plain[0]) not in (2, 3) or any(c.isalpha() for c in "".join(plain[0]))):
        raise InputError(f"{name} has no columns x, y[, z] (world LPS mm) or i, j[, k] (voxels); add titles")
    return _Table([""] * len(plain), [_floats(_same_length(row, len(plain[0]), name), name) for row in plain])


def _axes(titles: list[str]) -> list[str]:
    """Return the two or three titles of the coordinates, an empty list without them."""
    for axes in (_WORLD, _VOXEL):
        if set(axes[:2]) <= set(titles):
            return [axis for axis in axes if axis in titles]
    return []


def _from_columns(rows: list[list[str]], titles: list[str], axes: list[str], name: str) -> _Table:
    columns = [titles.index(axis) for axis in axes]
    label = next((titles.index(title) for title in _NAMES if title in titles), None)
    cells = [_same_length(row, len(titles), name) for row in rows]
    names = ["" if label is None else row[label].strip() for row in cells]
    values = [_floats([row[k] for k in columns], name) for row in cells]
    return _Table(names, values, voxels=axes[0] == "i", flat="t" in titles)


def _same_length(row: list[str], count: int, name: str) -> list[str]:
    if len(row) < count:
        raise InputError(f"{name}: the row '{','.join(row)}' has {len(row)} of {count} columns; complete or delete it")
    return row


def _read_elastix(text: str, name: str) -> _Table:
    kind, _, rest = text.strip().partition("\n")
    count, _, body = rest.strip().partition("\n")
    if kind.strip().lower() not in ("point", "index") or not count.strip().isdigit():
        raise InputError(f"{name} is no elastix file of points: line 1 must be point or index, line 2 the count")
    rows = [_floats(line.split(), name) for line in body.splitlines() if line.strip()]
    if len(rows) != int(count) or {len(row) for row in rows} not in ({2}, {3}, set()):
        raise InputError(
            f"{name} announces {count.strip()} points of 2 or 3 numbers, but other rows follow; correct the count"
        )
    return _Table([""] * len(rows), rows, voxels=kind.strip().lower() == "index")


def _read_fcsv(text: str, name: str) -> _Table:
    lines = [line for line in text.splitlines() if line.strip()]
    header = dict(_setting(line) for line in lines if line.startswith("#"))
    titles = [t.strip().lower() for t in header.get("columns", "").split(",") if t.strip()] or _FCSV_COLUMNS
    system = header.get("coordinatesystem", "")
    rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    if not set(_WORLD) <= set(titles):
        raise InputError(f"{name} names no columns x, y, z; export the points from 3D Slicer again")
    label = titles.index("label") if "label" in titles else 0
    columns = [titles.index(axis) for axis in _WORLD]
    shortest = max(*columns, label) + 1
    cells = [_same_length(row, shortest, name) for row in rows]
    values = [_to_lps(_floats([row[k] for k in columns], name), system, name) for row in cells]
    return _Table([row[label].strip() for row in cells], values)


def _setting(line: str) -> tuple[str, str]:
    key, _, value = line.lstrip("# ").partition("=")
    return key.strip().lower(), value.strip()


def _to_lps(row: list[float], system: str, name: str) -> list[float]:
    if system.lower() not in _SYSTEMS:
        raise InputError(f"{name} has coordinate system {system!r}; save the points as LPS or RAS")
    return row if _SYSTEMS[system.lower()] == "lps" else [-row[0], -row[1], *row[2:]]


def _read_markups(text: str, name: str) -> _Table:
    table = _Table([], [])
    try:
        for markup in json.loads(text)["markups"]:
            _require_mm(markup, name)
            for point in markup.get("controlPoints", []):
                if point.get("positionStatus", "defined") != "defined":
                    continue
                table.names.append(str(point.get("label", "")))
                position = _floats(point["position"], name)
                table.rows.append(_to_lps(position, str(markup.get("coordinateSystem", "LPS")), name))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{name} is no file of markups from 3D Slicer; export the points again") from error
    if any(len(row) != 3 for row in table.rows):
        raise InputError(f"{name} has a position without 3 coordinates; export the points again")
    return table


def _require_mm(markup: dict[str, Any], name: str) -> None:
    units = markup.get("coordinateUnits", "mm")
    if units not in ("mm", ["mm", "UCUM", "length"]):
        raise InputError(f"{name} has its points in {units}; save them in mm")


_READERS: dict[str, Callable[[str, str], _Table]] = {
    ".csv": _read_csv,
    ".tsv": lambda text, name: _read_columns(text, name, "\t"),
    ".txt": _read_elastix,
    ".fcsv": _read_fcsv,
    ".json": _read_markups,
}


def _write_columns(points: Points, separator: str) -> str:
    from io import StringIO

    sheet = StringIO()
    writer = csv.writer(sheet, delimiter=separator, lineterminator="\n")
    writer.writerow(["name", *_WORLD[: points.positions.shape[1]]])
    writer.writerows([name, *row] for name, row in zip(points.names, points.positions.tolist(), strict=True))
    return sheet.getvalue()


def _write_elastix(points: Points) -> str:
    rows = [" ".join(map(repr, row)) for row in points.positions.tolist()]
    return "\n".join(["point", str(len(rows)), *rows, ""])


def _write_fcsv(points: Points) -> str:
    header = [
        "# Markups fiducial file version = 4.11",
        "# CoordinateSystem = LPS",
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID",
    ]
    rows = [
        f"{k + 1},{','.join(map(repr, row))},0,0,0,1,1,1,0,{_quoted(name)},,"
        for k, (name, row) in enumerate(zip(points.names, _in_space(points), strict=True))
    ]
    return "\n".join([*header, *rows, ""])


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"') else name


def _write_markups(points: Points) -> str:
    control = [
        {"id": str(k + 1), "label": name, "position": row, "positionStatus": "defined"}
        for k, (name, row) in enumerate(zip(points.names, _in_space(points), strict=True))
    ]
    schema = (
        "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
        "markups-schema-v1.0.3.json#"
    )
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": control}
    return json.dumps({"@schema": schema, "markups": [markup]}, indent=1)


def _in_space(points: Points) -> list[list[float]]:
    """Return rows of three coordinates, the only ones that Slicer knows."""
    return [[*row, 0.0][:3] for row in points.positions.tolist()]


_WRITERS: dict[str, Callable[[Points], str]] = {
    ".csv": lambda points: _write_columns(points, ","),
    ".tsv": lambda points: _write_columns(points, "\t"),
    ".txt": _write_elastix,
    ".fcsv": _write_fcsv,
    ".json": _write_markups,
}
