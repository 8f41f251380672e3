"""The header of NRRD (.nrrd, .nhdr), checked before ITK reads the file."""

import math
import os
import re
from pathlib import Path

from torchdeform.errors import InputError
from torchdeform.io.files import read_head
from torchdeform.io.headers import (
    CUT_OFF,
    LONGEST,
    Header,
    count,
    listed_files,
    numbered_files,
    require_matrix,
    require_numbers,
    sizes,
    unit_of,
)

# Bytes of a number, by the type as `_type` writes it.
_TYPES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4,
    "uint": 4, "int32": 4, "uint32": 4, "longlong": 8, "ulonglong": 8, "int64": 8, "uint64": 8, "float": 4, "double": 8,
}  # fmt: skip
_PACKINGS = {
    "raw": "raw", "txt": "text", "text": "text", "ascii": "text", "hex": "hex", "gz": "gzip", "gzip": "gzip",
    "bz2": "bzip2", "bzip2": "bzip2",
}  # fmt: skip
_SPATIAL = ("domain", "space", "???", "none")  # kinds of axes; those of others hold the numbers of a pixel


def nrrd_header(path: Path) -> Header:
    """Return the header of an NRRD.

    Raises:
        InputError: it makes no sense.
    """
    fields, rest, end = _fields(path)
    if not {"sizes", "type", "encoding"} <= fields.keys():
        raise InputError(f"{path} {CUT_OFF}")
    directions = fields.get("space directions", "").replace("none", "")
    require_numbers(path, "spacing", re.sub("nan", "", fields.get("spacings", ""), flags=re.IGNORECASE), zero=False)
    require_numbers(path, "origin", fields.get("space origin", ""))
    require_matrix(path, directions)
    width, packing = _TYPES.get(_type(fields["type"])), _PACKINGS.get(fields["encoding"].lower())
    if width is None or packing is None:
        what = f"'{fields['type'][:80]}' encoded as '{fields['encoding'][:80]}'"
        raise InputError(f"{path} has pixels of the type {what}, which is unknown; export it again, as raw or gzip")
    all_sizes = sizes(path, fields["sizes"], fields.get("dimension", ""))
    space, channels = _split(all_sizes, fields)
    data = fields.get("data file", fields.get("datafile", ""))
    skipped = count(path, "byte skip", fields.get("byte skip", fields.get("byteskip", "0")), -1)
    lines = count(path, "line skip", fields.get("line skip", fields.get("lineskip", "0")), 0)
    start = (0 if data else end) + (max(0, skipped) + lines if packing == "raw" and skipped >= 0 else 0)
    return Header(path, space, channels, width, _files(path, data, rest), packing, start, _unit(path, fields))


def _fields(path: Path) -> tuple[dict[str, str], list[str], int]:
    """Return the fields by their names in small letters, the lines of a list of files, and where the header ends."""
    head, found, rest, end = read_head(path, LONGEST), {}, [], 0
    for line in head.splitlines(keepends=True):
        end += len(line)
        text = os.fsdecode(line).strip()
        if found.get("data file", found.get("datafile", "")).startswith("LIST"):
            rest.append(text)
        elif not text:
            break
        elif not text.startswith("#") and (parts := re.fullmatch(r"([^:]*): *(?!=)(.*)", text)):
            found[parts[1].strip().lower()] = parts[2].strip()
    return found, rest, end


def _type(name: str) -> str:
    plain = name.lower().replace("unsigned ", "u").replace("signed ", "").replace(" ", "").removesuffix("_t")
    return plain if plain in ("int", "uint") else plain.removesuffix("int")


def _split(every: tuple[int, ...], fields: dict[str, str]) -> tuple[tuple[int, ...], int]:
    """Return the sizes of the axes of space, and the number of channels, which are the other axes."""
    kinds = fields.get("kinds", "").lower().split()
    spatial = [kind in _SPATIAL for kind in kinds] if len(kinds) == len(every) else [True] * len(every)
    space = tuple(size for size, keep in zip(every, spatial, strict=True) if keep)
    return space, math.prod(every) // math.prod(space)


def _unit(path: Path, fields: dict[str, str]) -> tuple[float, str]:
    """Return the one unit of all axes."""
    text = fields.get("space units", fields.get("units", ""))
    found = {unit_of(name) for name in re.findall(r'"([^"]+)"', text) or text.split()}
    if len(found) > 1:
        raise InputError(f"{path} has axes in different units, {text[:80]}; write all lengths in mm")
    return found.pop() if found else unit_of("")


def _files(path: Path, data: str, rest: list[str]) -> tuple[Path, ...]:
    if not data or data.upper() == "LOCAL":
        return ()
    if data.startswith("LIST"):
        if "" in rest:
            raise InputError(f"{path} has an empty line in or behind its list of files; delete that line")
        return listed_files(path, rest)
    return numbered_files(path, data) if "%" in data else listed_files(path, [data])
