"""What files of points hold: rows of numbers in the dialects of spreadsheets and of programs for landmarks."""

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchdeform.errors import InputError, shown
from torchdeform.io.texts import csv_rows, parse_json

FIXED, MOVING = "fixed", "moving"

_NAMES = ("name", "label", "landmark", "id", "index", "")

# Titles of coordinates, in the order in which they are looked for; what to multiply by for LPS; how many there must be
# at least; and the index of the first voxel, None for a position in the world.
_SYSTEMS_OF_AXES: tuple[tuple[tuple[str, ...], tuple[int, ...], int, int | None], ...] = (
    (("x", "y", "z"), (1, 1, 1), 2, None),
    (("l", "p", "s"), (1, 1, 1), 3, None),
    (("r", "a", "s"), (-1, -1, 1), 3, None),
    (("i", "j", "k"), (1, 1, 1), 2, 0),
    (("i1", "j1", "k1"), (1, 1, 1), 2, 1),
)
_MILLIMETRES = {"": 1.0, "mm": 1.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "micron": 1e-3, "microns": 1e-3, "cm": 10.0}
_VOXELS = ("px", "pixel", "pixels", "vox", "voxel", "voxels")
_WORDS = r"(?:pos|position|point|coord|coordinate|centroid|center|centre)?[ _.-]*"
_TITLE = re.compile(rf"{_WORDS}([xyzijklpras]|[ijk]1)[ _./(\[-]*({'|'.join((*_MILLIMETRES, *_VOXELS))})[)\]]?")
_NAPARI = re.compile(r"axis-(\d)")

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.ASCII | re.IGNORECASE)
_COMMA = re.compile(r"[-+]?\d+,\d+(?:e[-+]?\d+)?", re.ASCII | re.IGNORECASE)
_FARTHEST = 1e9  # mm or voxels

# How versions of Slicer write their coordinate systems. RAS is meant where nothing is written.
_SYSTEMS = {"lps": "lps", "1": "lps", "ras": "ras", "0": "ras", "": "ras"}
_FCSV_COLUMNS = ["label", "x", "y", "z", "sel", "vis"]  # of versions that name no columns

_MARKUPS = "file of markups from 3D Slicer"

_OUTPUT = re.compile(r"^Point\s+(\d+)\s*;.*?OutputPoint = \[([^\]]*)\]", re.MULTILINE)
_BIGWARP = re.compile(r'^"[^"]*","(?:true|false)"(?:,"[^"]*"){4}(?:(?:,"[^"]*"){2})?$')


@dataclass(frozen=True)
class Table:
    """The content of a file.

    Attributes:
        names: of the points; empty texts if there are none.
        rows: of 2 or 3 numbers, world LPS mm or voxel indices from 0.
        voxels: whether they are indices.
        flat: whether a third column of zeros means 2D points.
    """

    names: list[str] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)
    voxels: bool = False
    flat: bool = False


def read_table(text: str, name: str, ending: str, side: str | None) -> Table:
    """Return the points in a text.

    Args:
        text: content of the file.
        name: of the file, for sentences.
        ending: of the file, one of `READERS`.
        side: ``fixed`` or ``moving``, of which image the points are; None if that is not known.

    Raises:
        InputError: another kind of text, values that are no coordinates, or points of two images without ``side``.
    """
    return READERS[ending](text, name, side)


def _read_sheet(text: str, name: str, side: str | None) -> Table:
    """Rows with or without titles, between commas, semicolons, tabs or blanks."""
    if _BIGWARP.match(text.partition("\n")[0].strip()):
        return _read_bigwarp(text, name, side)
    rows = _cells(text, name)
    for k, row in enumerate(rows):
        body = rows[k + 1 :]
        titles = row[1:] if row[0] == "#" and body and len(body[0]) < len(row) else row  # as NumPy writes them
        if (columns := _columns(titles, name)) is not None:
            return _from_columns(body, titles, columns, name)
        if not row[0].lstrip().startswith("#"):
            break
    plain = [row for row in rows if not row[0].lstrip().startswith("#")]
    if plain and (len(plain[0]) not in (2, 3) or any(c.isalpha() for c in "".join(plain[0]))):
        raise InputError(f"{name} has no columns x, y[, z] (world LPS mm) or i, j[, k] (voxels); add titles")
    numbers = _comma_free([_whole(row, len(plain[0]), name) for row in plain])
    return Table([""] * len(plain), [floats(row, name) for row in numbers])


def _cells(text: str, name: str) -> list[list[str]]:
    """Return the cells of all rows but empty ones; the first line tells what stands between them."""
    first, _, rest = text.partition("\n")
    if first.lower().startswith("sep=") and len(first.strip()) == len("sep=;"):
        separator, text = first[len("sep=")], rest
    else:
        line = re.sub(r'"[^"]*"', "", next((line for line in text.splitlines() if _tells(line)), ""))
        separator = next((mark for mark in "\t;," if mark in line), " ")
    if separator == " ":
        text = re.sub("[ ]+", " ", "\n".join(map(str.strip, text.splitlines())))
    return [row for _, row in csv_rows(text, name, separator)]


def _tells(line: str) -> bool:
    """Return whether a line shows what stands between cells: those with a # may be prose."""
    return bool(line.strip()) and not line.lstrip().startswith("#")


@dataclass(frozen=True)
class _Columns:
    """Where the coordinates stand, in the order x, y, z, and what turns them into LPS mm or voxels from 0."""

    places: list[int]
    factors: list[float]
    voxels: bool = False
    first: int = 0  # index of the first voxel


def _columns(titles: Sequence[str], name: str) -> _Columns | None:
    """Return the two or three columns of coordinates, None if these are no titles.

    Notes:
        napari writes its array axes, so the last of them is x, and counts in voxels.
    """
    plain = [_plain(title) for title in titles]
    places = {match[1]: k for k, title in enumerate(plain) if (match := _NAPARI.fullmatch(title))}
    if places:
        order = [places[axis] for axis in sorted(places, reverse=True)]
        return _Columns(order, [1.0] * len(order), voxels=True)
    matches = [(k, match) for k, title in enumerate(plain) if (match := _TITLE.fullmatch(title))]
    found = {match[1]: (k, match[2]) for k, match in reversed(matches)}  # of two with one title the first
    for axes, signs, least, first in _SYSTEMS_OF_AXES:
        if set(axes[:least]) <= found.keys():
            used = [axis for axis in axes if axis in found]
            units = {found[axis][1] for axis in used}
            if len(units) > 1:
                raise InputError(f"{name} has columns in different units; write all in mm")
            unit = units.pop()
            voxels = first is not None or unit in _VOXELS
            scale = 1.0 if voxels else _MILLIMETRES[unit]
            factors = [sign * scale for sign in signs[: len(used)]]
            return _Columns([found[axis][0] for axis in used], factors, voxels, first or 0)
    return None


def _plain(title: str) -> str:
    return title.strip().lstrip("#").strip().lower()


def _from_columns(rows: list[list[str]], titles: Sequence[str], columns: _Columns, name: str) -> Table:
    plain = [_plain(title) for title in titles]
    label = next((plain.index(title) for title in _NAMES if title in plain), None)
    cells = [_whole(row, len(titles), name) for row in rows]
    names = ["" if label is None else row[label].strip() for row in cells]
    numbers = _comma_free([[row[k] for k in columns.places] for row in cells])
    values = [
        [factor * (value - columns.first) for factor, value in zip(columns.factors, floats(row, name), strict=True)]
        for row in numbers
    ]
    return Table(names, values, voxels=columns.voxels, flat="t" in plain)


def _whole(row: list[str], count: int, name: str) -> list[str]:
    """Return a row of as many cells as the first; empty ones at its end are left out."""
    if len(row) < count or any(cell.strip() for cell in row[count:]):
        text = shown(",".join(row))
        raise InputError(f"{name}: the row {text} has {len(row)} of {count} columns; complete or delete it")
    return row[:count]


def _comma_free(rows: list[list[str]]) -> list[list[str]]:
    """Return numbers with decimal points, where a spreadsheet of another language wrote commas."""
    if any("." in cell for row in rows for cell in row):
        return rows
    return [[cell.replace(",", ".") if _COMMA.fullmatch(cell.strip()) else cell for cell in row] for row in rows]


def floats(cells: Iterable[object], name: str) -> list[float]:
    """Return cells as finite numbers.

    Raises:
        InputError: one is none, or farther from the origin than any image is.
    """
    cells = list(cells)
    values = [_number(cell) for cell in cells]
    if not all(abs(value) < _FARTHEST for value in values):
        row = shown(", ".join(str(cell).strip() for cell in cells))
        raise InputError(f"{name}: {row} are no coordinates; write finite numbers with a decimal point")
    return values


def _number(cell: object) -> float:
    if isinstance(cell, str):
        return float(text) if _NUMBER.fullmatch(text := cell.strip()) else math.nan
    return float(cell) if isinstance(cell, int | float) and not isinstance(cell, bool) else math.nan


def _read_bigwarp(text: str, name: str, side: str | None) -> Table:
    """Pairs of points: name, whether it counts, the moving and the fixed point."""
    if side is None:
        raise InputError(
            f"{name} holds points of two images, as BigWarp writes them; say of which: side='{FIXED}' or '{MOVING}'"
        )
    rows = [row for _, row in csv_rows(text, name, ",")]
    width = len(rows[0])
    dim = (width - 2) // 2
    first = 2 if side == MOVING else 2 + dim
    used = [row for row in (_whole(row, width, name) for row in rows) if row[1] == "true"]
    return Table([row[0] for row in used], [floats(row[first : first + dim], name) for row in used])


def _read_text(text: str, name: str, side: str | None) -> Table:
    """Points of elastix, what transformix writes, or rows with titles."""
    if _OUTPUT.search(text):
        found = [(match[1], floats(match[2].split(), name)) for match in _OUTPUT.finditer(text)]
        return _same_width(Table([number for number, _ in found], [row for _, row in found]), name)
    kind, _, rest = text.strip().partition("\n")
    if kind.strip().lower() in ("point", "index"):
        return _read_elastix(kind.strip().lower() == "index", rest, name)
    rows = _cells(text, name)
    if rows and all(_NUMBER.fullmatch(cell.strip()) for cell in rows[0]):
        raise InputError(
            f"{name} has numbers without titles, so their order and unit are unknown; write a line above them: "
            "x y z for world mm (LPS), i j k for voxels from 0, or i1 j1 k1 for voxels from 1, as DIR-Lab counts"
        )
    if not any(_columns(row, name) for row in rows):
        raise InputError(
            f"{name} is no file of points: line 1 must be point or index, as in elastix, or titles such as x y z"
        )
    return _read_sheet(text, name, side)


def _read_elastix(voxels: bool, text: str, name: str) -> Table:
    count, _, body = text.strip().partition("\n")
    if not (count.strip().isascii() and count.strip().isdigit() and len(count) < 10):
        raise InputError(f"{name} is no elastix file of points: line 1 must be point or index, line 2 the count")
    rows = [floats(line.split(), name) for line in body.splitlines() if line.strip()]
    if len(rows) != int(count):
        raise InputError(f"{name} announces {count.strip()} points, but {len(rows)} rows follow; correct the count")
    return _same_width(Table([""] * len(rows), rows, voxels=voxels), name)


def _same_width(table: Table, name: str) -> Table:
    """Return a table whose rows all have 2 numbers, or all 3."""
    if {len(row) for row in table.rows} not in ({2}, {3}, set()):
        raise InputError(f"{name} has rows of other than 2 or 3 numbers; correct them")
    return table


def _read_fcsv(text: str, name: str, side: str | None) -> Table:
    lines = [line for line in text.splitlines() if line.strip()]
    header = dict(_setting(line) for line in lines if line.startswith("#"))
    titles = [t.strip().lower() for t in header.get("columns", "").split(",") if t.strip()] or _FCSV_COLUMNS
    system = header.get("coordinatesystem", "")
    rows = [row for _, row in csv_rows("\n".join(line for line in lines if not line.startswith("#")), name, ",")]
    if not {"x", "y", "z"} <= set(titles):
        raise InputError(f"{name} names no columns x, y, z; export the points from 3D Slicer again")
    label = titles.index("label") if "label" in titles else 0
    columns = [titles.index(axis) for axis in "xyz"]
    shortest = max(*columns, label) + 1
    if any(len(row) < shortest for row in rows):
        short = next(row for row in rows if len(row) < shortest)
        raise InputError(
            f"{name}: the row {shown(','.join(short))} has {len(short)} of {shortest} columns; complete it"
        )
    values = [_to_lps(floats([row[k] for k in columns], name), system, name) for row in rows]
    return Table([row[label].strip() for row in rows], values)


def _setting(line: str) -> tuple[str, str]:
    key, _, value = line.lstrip("# ").partition("=")
    return key.strip().lower(), value.strip()


def _to_lps(row: list[float], system: str, name: str) -> list[float]:
    if system.lower() not in _SYSTEMS:
        raise InputError(f"{name} has coordinate system {shown(system)}; save the points as LPS or RAS")
    return row if _SYSTEMS[system.lower()] == "lps" else [-row[0], -row[1], *row[2:]]


def _read_markups(text: str, name: str, side: str | None) -> Table:
    table = Table()
    try:
        for markup in parse_json(text, name, _MARKUPS)["markups"]:
            _require_mm(markup, name)
            for point in markup.get("controlPoints", []):
                if point.get("positionStatus", "defined") != "defined":
                    continue
                position = floats(point["position"], name)
                if len(position) != 3:
                    raise InputError(f"{name} has a position without 3 coordinates; export the points again")
                table.names.append(str(point.get("label", "")))
                table.rows.append(_to_lps(position, str(markup.get("coordinateSystem", "LPS")), name))
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{name} is no {_MARKUPS}; export the points again") from error
    return table


def _require_mm(markup: dict[str, Any], name: str) -> None:
    units = markup.get("coordinateUnits", "mm")
    if units not in ("mm", ["mm", "UCUM", "length"]):
        raise InputError(f"{name} has its points in {shown(units)}; save them in mm")


READERS: dict[str, Callable[[str, str, str | None], Table]] = {
    ".csv": _read_sheet,
    ".tsv": _read_sheet,
    ".txt": _read_text,
    ".fcsv": _read_fcsv,
    ".json": _read_markups,
}
