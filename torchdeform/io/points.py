"""Landmarks on disk: csv, tsv, elastix txt, 3D Slicer's fcsv and mrk.json. In memory they are world points, LPS mm."""

import csv
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io.files import atomic_file, suffix
from torchdeform.io.gate import read_text
from torchdeform.io.point_tables import READERS, Table, read_table

_WORLD = ("x", "y", "z")

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


def read_points(path: _Path, image: Image | None = None, *, dim: int | None = None, side: str | None = None) -> Points:
    """Read landmarks.

    Args:
        path: a table (``.csv``, ``.tsv``, ``.txt``; between commas, semicolons, tabs or blanks) with columns x, y[, z]
            (world LPS mm, which are pixels for a picture with spacing 1), l, p, s or r, a, s (the same, directions as
            named), i, j[, k] (voxel index of ``image`` along its x, y, z axes, from 0), i1, j1[, k1] (from 1), or
            axis-0, axis-1[, axis-2] of napari (voxels, z first). Titles may name a unit (``x_mm``, ``X (µm)``,
            ``x_px``), in upper or lower case; a column of names is called name, label, landmark, id, index, or
            nothing. Also: ``.csv`` with 2 or 3 numbers per line without titles (x, y[, z]), ANTs' x, y, z, t, BigWarp's
            pairs; ``.txt`` of elastix (``point`` or ``index``, count, rows) and what transformix writes (its
            OutputPoint); ``.fcsv`` and ``.mrk.json`` of 3D Slicer, in RAS or LPS as the header says.
        image: the image that voxel indices refer to; it also says whether points are 2D or 3D.
        dim: 2 or 3; by default that of the image, without an image that of the file.
        side: ``fixed`` or ``moving``: of which image the points are, for files that hold those of both.

    Returns:
        The points in the world. If 2D points are needed, a third coordinate that is always 0 is dropped.

    Raises:
        InputError: the file is missing, of another kind, without points, with values that are no finite numbers, with
            rows whose order and unit nothing says, with indices but without an image, with points of two images but
            without ``side``, or with points of another dimension.

    Notes:
        Texts may be UTF-8, UTF-16 with its mark, or Windows-1252; numbers may have decimal commas if no number of the
        file has a point.
    """
    file = Path(path)
    if suffix(file) not in READERS:
        raise InputError(f"{path} is no file of points; use one of {', '.join(READERS)}")
    text = read_text(file, "file of points", legacy=True)
    table = read_table(text, str(path), suffix(file), side)
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
        places = [{name: k for k, name in enumerate(points.names)} for points in (fixed, moving)]
        names = tuple(name for name in fixed.names if name in places[1])
        if not names:
            raise InputError("the fixed and the moving points have no name in common; give the same names to both")
        rows = [[place[name] for name in names] for place in places]
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
    with atomic_file(file) as new:
        new.write_text(text, encoding="utf-8")


def require_points_file(path: Path) -> None:
    """Raise `InputError` unless points can be written to files of this ending."""
    if suffix(path) not in _WRITERS:
        raise InputError(f"{path} has no ending that points are written with; use one of {', '.join(_WRITERS)}")


def _place(table: Table, name: str, image: Image | None, dim: int | None) -> Points:
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
            f"{name} counts in voxels; give the image that the points belong to (--reference), or points in world mm"
        )
    if image.grid.dim != index.shape[1]:
        raise InputError(f"{name} holds {index.shape[1]}D points, but {image.name} is {image.grid.dim}D; give others")
    spacing = torch.tensor(image.grid.spacing, dtype=torch.float64)
    return image.to_world((index.flip(1) * spacing).T.unsqueeze(0))[0].T


def _numbers(count: int) -> tuple[str, ...]:
    return tuple(str(k + 1) for k in range(count))


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
