"""The header of MetaImage (.mha, .mhd), checked before ITK reads the file."""

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

# Bytes of a number, by the type without MET_ and _ARRAY.
_TYPES = {
    "CHAR": 1, "UCHAR": 1, "SHORT": 2, "USHORT": 2, "INT": 4, "UINT": 4, "LONG": 4, "ULONG": 4, "LONG_LONG": 8,
    "ULONG_LONG": 8, "FLOAT": 4, "DOUBLE": 8,
}  # fmt: skip
_LAST = "elementdatafile"  # the pixels, or the names of their files, follow its line


def metaimage_header(path: Path) -> Header:
    """Return the header of a MetaImage.

    Raises:
        InputError: it makes no sense.
    """
    fields, rest, end = _fields(path)
    if "dimsize" not in fields or _LAST not in fields:
        raise InputError(f"{path} {CUT_OFF}")
    require_numbers(path, "spacing", _first(fields, "elementspacing", "elementsize"), zero=False)
    require_numbers(path, "origin", _first(fields, "offset", "position", "origin"))
    require_matrix(path, _first(fields, "transformmatrix", "rotation", "orientation"))
    kind = fields.get("elementtype", "").removeprefix("MET_").removesuffix("_ARRAY")
    if kind not in _TYPES:
        raise InputError(f"{path} has pixels of the type '{kind[:80]}', which is unknown; correct the header")
    packed, binary = _is_true(fields, "compresseddata", "f"), _is_true(fields, "binarydata", "t")
    skipped = count(path, "HeaderSize", fields.get("headersize", "0"), -1)
    size = sizes(path, fields["dimsize"], fields.get("ndims", ""))
    return Header(
        path,
        size,
        count(path, "ElementNumberOfChannels", fields.get("elementnumberofchannels", "1"), 1),
        _TYPES[kind],
        _files(path, fields[_LAST], rest, size),
        "gzip" if packed else "raw" if binary else "text",
        skipped if skipped > 0 else end if fields[_LAST].upper() == "LOCAL" and not skipped else 0,
        unit_of(fields.get("distanceunits", "")),
    )


def _fields(path: Path) -> tuple[dict[str, str], list[str], int]:
    """Return the fields by their names in small letters, the lines after the last field, and where that field ends."""
    head, found, end = read_head(path, LONGEST), {}, 0
    for line in head.splitlines(keepends=True):
        end += len(line)
        key, *value = re.split(r"\s*[=:]\s*", os.fsdecode(line).strip(), maxsplit=1)
        found[key.lower()] = "".join(value)
        if key.lower() == _LAST:
            break
    local = found.get(_LAST, "").upper() == "LOCAL"
    return found, [] if local else os.fsdecode(head[end:]).splitlines(keepends=True), end


def _first(fields: dict[str, str], *keys: str) -> str:
    return next((fields[key] for key in keys if key in fields), "")


def _is_true(fields: dict[str, str], key: str, default: str) -> bool:
    return fields.get(key, default)[:1].lower() in ("t", "1")


def _files(path: Path, data: str, rest: list[str], size: tuple[int, ...]) -> tuple[Path, ...]:
    """Return the files of pixels. ITK reads a list, whose last line must end, or a pattern, slice by slice."""
    if data.upper() == "LOCAL":
        return ()
    if data.startswith("LIST"):
        found = listed_files(path, [line.strip() for line in rest if line.strip() and line.endswith("\n")])
    elif "%" in data:
        found = numbered_files(path, data)
    else:
        return listed_files(path, [data] if data else [])
    if len(found) not in (math.prod(size[k:]) for k in range(1, len(size) + 1)):
        raise InputError(
            f"{path} names {len(found)} files of pixels for {size[-1]} slices; correct the header, whose last line "
            "must end"
        )
    return found
