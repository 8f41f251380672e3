"""Checks of the text headers of MetaImage and NRRD, needed because ITK reads what it cannot parse as 0 or 1."""

import math
import re
import zlib
from pathlib import Path

import numpy as np

from torchdeform.io.files import read_head

_LONGEST = 1 << 16  # bytes of a header that are read
_CHUNK = 1 << 20  # bytes of compressed pixels read at once
_NUMBERS = re.compile(r"[^\s,()]+")

# Bytes per number. Types that are missing here are left to ITK.
_META_TYPES = {"CHAR": 1, "UCHAR": 1, "SHORT": 2, "USHORT": 2, "INT": 4, "UINT": 4, "FLOAT": 4, "DOUBLE": 8}


def check_metaimage(path: Path) -> str | None:
    """Return what is wrong with the header of a MetaImage, or None."""
    head = read_head(path, _LONGEST)
    fields = {key.lower(): value for key, value in _pairs(head, r"=", stop="ElementDataFile")}
    if "dimsize" not in fields or "elementdatafile" not in fields:
        return _no_header(head, b"ObjectType", b"NDims")
    matrix = next((fields[key] for key in ("transformmatrix", "rotation", "orientation") if key in fields), "")
    return (
        _check_sizes(fields["dimsize"], fields.get("ndims", ""))
        or _check_numbers("spacing", fields.get("elementspacing", ""), zero=False)
        or _check_numbers("origin", next((fields[k] for k in ("offset", "position", "origin") if k in fields), ""))
        or _check_matrix(matrix)
        or _check_data(path, fields["elementdatafile"], local="LOCAL")
        or _check_length(path, head, fields)
    )


def check_nrrd(path: Path) -> str | None:
    """Return what is wrong with the header of an NRRD, or None."""
    head = read_head(path, _LONGEST)
    fields = dict(_pairs(head, r":=?"))
    if not head.startswith(b"NRRD") or "sizes" not in fields:
        return _no_header(head, b"NRRD")
    directions = fields.get("space directions", "").replace("none", "")
    return (
        _check_sizes(fields["sizes"], fields.get("dimension", ""))
        or _check_numbers("spacing", fields.get("spacings", "").replace("NaN", ""), zero=False)
        or _check_numbers("origin", fields.get("space origin", ""))
        or _check_matrix(directions)
        or _check_data(path, fields.get("data file", fields.get("datafile", "LOCAL")), local="LOCAL")
    )


def _pairs(head: bytes, sign: str, stop: str = "") -> list[tuple[str, str]]:
    """Return keys and values of the header's lines, up to the first empty line or the key ``stop``."""
    found = []
    for line in head.decode("latin-1").splitlines():
        parts = re.split(rf"\s*{sign}\s*", line.strip(), maxsplit=1)
        if not line.strip():
            break
        if len(parts) == 2:
            found.append((parts[0], parts[1]))
        if stop and parts[0] == stop:
            break
    return found


def _no_header(head: bytes, *starts: bytes) -> str | None:
    """Return the fault of a header that is cut off. Content of another kind is no fault here."""
    return "has a header that is cut off; fetch or export it again" if head.lstrip().startswith(starts) else None


def _check_sizes(text: str, rank: str) -> str | None:
    sizes = text.split()
    if not all(size.isdigit() and int(size) > 0 for size in sizes) or (rank.isdigit() and len(sizes) != int(rank)):
        return f"has the size '{text}' in its header, not {rank or 'a few'} positive whole numbers; correct the header"
    return None


def _check_numbers(what: str, text: str, *, zero: bool = True) -> str | None:
    values = _parse(text)
    if values is None or not all(math.isfinite(v) and (zero or v != 0) for v in values):
        return f"has the {what} '{text}' in its header, which is no position in space; correct the header"
    return None


def _check_matrix(text: str) -> str | None:
    values = _parse(text)
    rank = round(math.sqrt(len(values or [])))
    if values is None or not all(map(math.isfinite, values)):
        return f"has the direction '{text}' in its header; correct the header"
    if values and rank**2 == len(values) and abs(np.linalg.det(np.reshape(values, (rank, rank)))) < 1e-12:
        return "has a direction matrix that is singular; correct the header"
    return None


def _parse(text: str) -> list[float] | None:
    try:
        return [float(number) for number in _NUMBERS.findall(text)]
    except ValueError:
        return None


def _check_data(path: Path, name: str, local: str) -> str | None:
    """A separate file of pixels must exist. Lists and patterns of files are left to ITK."""
    if name.upper() == local or name.startswith("LIST") or "%" in name or (path.parent / name).exists():
        return None
    return f"keeps its pixels in {name}, which does not exist; put it beside the header"


def _check_length(path: Path, head: bytes, fields: dict[str, str]) -> str | None:
    """The pixels must be as long as the header says; checked before memory is allocated for them."""
    kind = fields.get("elementtype", "").removeprefix("MET_").removesuffix("_ARRAY")
    local = fields["elementdatafile"].upper() == "LOCAL"
    stored = path if local else path.parent / fields["elementdatafile"]
    if kind not in _META_TYPES or not stored.is_file() or fields.get("binarydata", "True").lower() == "false":
        return None
    numbers = math.prod(map(int, fields["dimsize"].split())) * int(fields.get("elementnumberofchannels", 1))
    needed, length = numbers * _META_TYPES[kind], stored.stat().st_size
    if fields.get("compresseddata", "False").lower() == "true":
        start = head.index(b"\n", head.index(b"ElementDataFile")) + 1 if local else 0
        length = _unpacked_length(stored, start)
    return None if length >= needed else "is damaged or incomplete; fetch or export it again"


def _unpacked_length(path: Path, start: int) -> int:
    """Return how many bytes the compressed stream at ``start`` of a file holds, up to where it is cut off."""
    unpacker, length = zlib.decompressobj(zlib.MAX_WBITS | 32), 0
    with path.open("rb") as file:
        file.seek(start)
        try:
            while chunk := file.read(_CHUNK):
                length += len(unpacker.decompress(chunk))
        except zlib.error:
            pass
    return length
