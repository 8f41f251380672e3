"""Checks for faults that ITK reads over silently: files cut off, NaN that it reads as 0, headers that it guesses."""

import gzip
import math
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.files import read_head, suffix
from torchdeform.io.gate import DAMAGED, require_beside, require_file

NOT_SQUARE = "has axes that are not at right angles; reslice it onto a rectangular grid first"
NOT_FINITE = "has pixels that are NaN or infinite; replace them first, for instance by 0"

_Stream = BinaryIO | gzip.GzipFile
_CHUNK = 1 << 22  # bytes read at once, a multiple of the size of every pixel type
_FLOATS = {16: "f4", 64: "f8"}  # NIfTI's datatype codes
_LONGEST = 1 << 16  # bytes of a header that are read
_NUMBERS = re.compile(r"[^\s,()]+")

# Bytes per number. Types that are missing here are left to ITK.
_META_TYPES = {"CHAR": 1, "UCHAR": 1, "SHORT": 2, "USHORT": 2, "INT": 4, "UINT": 4, "FLOAT": 4, "DOUBLE": 8}

# Position, magic bytes there, and the ending of files that have them.
_KINDS = (
    (0, b"NRRD", ".nrrd"),
    (0, b"ObjectType", ".mha"),
    (0, b"NDims", ".mha"),
    (0, b"\x89PNG", ".png"),
    (0, b"\xff\xd8\xff", ".jpg"),
    (0, b"II*\0", ".tif"),
    (0, b"MM\0*", ".tif"),
    (0, b"GIF8", ".gif"),
    (0, b"\x1f\x8b", ".gz"),
    (128, b"DICM", ".dcm"),
    (344, b"n+1\0", ".nii"),
    (0, b"\x89HDF", ".h5"),
)
_ALIKE = {".mhd": ".mha", ".nhdr": ".nrrd", ".tiff": ".tif", ".jpeg": ".jpg"}


@dataclass(frozen=True)
class _Layout:
    """Where a NIfTI header has dim, datatype, bitpix, pixdim and vox_offset, as (format, position)."""

    dim: tuple[str, int]
    datatype: tuple[str, int]
    bitpix: tuple[str, int]
    pixdim: tuple[str, int]
    offset: tuple[str, int]


# By the number that the header starts with, which is its length.
_NIFTI = {
    348: _Layout(("8h", 40), ("h", 70), ("h", 72), ("8f", 76), ("f", 108)),
    540: _Layout(("8q", 16), ("h", 12), ("h", 14), ("8d", 104), ("q", 168)),
}


def require_sound(path: Path) -> None:
    """Raise `InputError` unless ``path`` is a file that can be opened and has no visible fault."""
    require_file(path, "image file")
    if fault := _CHECKS.get(suffix(path), lambda _: None)(path):
        raise InputError(f"{path} {fault}")


def other_kind(path: Path) -> str:
    """Return the ending that fits the content of the file; empty if unknown, or if the file has that ending."""
    head = read_head(path, 512)
    kind = next((ending for start, magic, ending in _KINDS if head[start:].startswith(magic)), "")
    return "" if suffix(path).endswith(kind) or kind == _ALIKE.get(suffix(path)) else kind


def _check_jpeg(path: Path) -> str | None:
    """The end of the image (FF D9) must follow the last scan (FF DA). Neither occurs inside coded pixels."""
    content = path.read_bytes()
    return None if content.rfind(b"\xff\xd9") > content.rfind(b"\xff\xda") else DAMAGED


def _check_bmp(path: Path) -> str | None:
    """The header holds the size of the file."""
    return None if int.from_bytes(read_head(path, 6)[2:], "little") <= path.stat().st_size else DAMAGED


def _check_nifti(path: Path) -> str | None:
    try:
        with path.open("rb") if suffix(path) == ".nii" else gzip.open(path) as file:
            return _check_voxels(file)
    except gzip.BadGzipFile:
        known = other_kind(path)
        return f"is not compressed but a {known} file; rename it" if known else DAMAGED
    except (EOFError, zlib.error):
        return DAMAGED


def _check_voxels(file: _Stream) -> str | None:
    """Read a NIfTI stream from header to end. What is no NIfTI is no fault here."""
    head = file.read(540)
    if len(head) < 348:
        return DAMAGED
    for order in "<>":
        layout = _NIFTI.get(struct.unpack_from(order + "i", head)[0])
        if layout is not None and len(head) >= layout.offset[1] + 8:
            return _check_header(head, order, layout) or _check_body(file, head, order, layout)
    return None


def _check_header(head: bytes, order: str, layout: _Layout) -> str | None:
    """Sizes, spacings and the position of the voxels must make sense: NIfTI's library would change them silently."""
    rank, *sizes = _field(head, order, layout.dim)
    if not 1 <= rank <= 7 or min(sizes[:rank]) < 1:
        return f"has the size {sizes[: min(max(rank, 0), 7)]} in its header; correct the header"
    spacing = [h for h, n in zip(_field(head, order, layout.pixdim)[1:4], sizes[: min(rank, 3)], strict=False) if n > 1]
    if not all(math.isfinite(h) and h != 0 for h in spacing):
        return f"has the spacing {spacing} in its header; correct the header"
    offset = _field(head, order, layout.offset)[0]
    return None if math.isfinite(offset) and offset >= 0 else DAMAGED


def _check_body(file: _Stream, head: bytes, order: str, layout: _Layout) -> str | None:
    rank, *sizes = _field(head, order, layout.dim)
    missing = math.prod(sizes[:rank]) * _field(head, order, layout.bitpix)[0] // 8
    kind = _FLOATS.get(_field(head, order, layout.datatype)[0])
    file.seek(int(_field(head, order, layout.offset)[0]))
    finite = True
    while chunk := file.read(min(_CHUNK, missing)):
        missing -= len(chunk)
        if kind and len(chunk) % int(kind[1]) == 0:
            finite = finite and bool(np.isfinite(np.frombuffer(chunk, order + kind)).all())
    while file.read(_CHUNK):  # a compressed file has its checksum at the end
        pass
    return DAMAGED if missing else None if finite else NOT_FINITE


def _field(head: bytes, order: str, field: tuple[str, int]) -> tuple[int, ...]:
    return struct.unpack_from(order + field[0], head, field[1])


def _check_metaimage(path: Path) -> str | None:
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
        or _check_data(path, fields["elementdatafile"])
        or _check_length(path, head, fields)
    )


def _check_nrrd(path: Path) -> str | None:
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
        or _check_data(path, fields.get("data file", fields.get("datafile", "LOCAL")))
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
    if not values or rank**2 != len(values):
        return None
    matrix = np.reshape(values, (rank, rank))  # with the spacing in it in NRRD, so only what is left of it counts
    if not abs(np.linalg.det(matrix)) > 1e-6 * np.linalg.norm(matrix, axis=1).prod():
        return "has a direction matrix that is singular; correct the header"
    return None


def _parse(text: str) -> list[float] | None:
    try:
        return [float(number) for number in _NUMBERS.findall(text)]
    except ValueError:
        return None


def _check_data(path: Path, name: str) -> str | None:
    """A separate file of pixels must exist. Lists and patterns of files are left to ITK."""
    if name.upper() == "LOCAL" or name.startswith("LIST") or "%" in name:
        return None
    if not (path.parent / name).exists():
        return f"keeps its pixels in {name}, which does not exist; put it beside the header"
    require_beside(path.parent / name, path)
    return None


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
    return None if length >= needed else DAMAGED


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


_CHECKS: dict[str, Callable[[Path], str | None]] = {
    ".jpg": _check_jpeg,
    ".jpeg": _check_jpeg,
    ".bmp": _check_bmp,
    ".mha": _check_metaimage,
    ".mhd": _check_metaimage,
    ".nrrd": _check_nrrd,
    ".nhdr": _check_nrrd,
    ".nii": _check_nifti,
    ".nii.gz": _check_nifti,
}
