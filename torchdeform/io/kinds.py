"""Which volume a file holds, by its content: names lie, and files from downloads and archives often have none."""

import gzip
import re
import struct
import zlib
from pathlib import Path

from torchdeform.io.files import read_head
from torchdeform.io.packed import is_packed

NIFTI, ANALYZE, MGH, META, NRRD, GZIP, UNKNOWN = "nifti", "analyze", "mgh", "meta", "nrrd", "gzip", ""

_HEAD = 4096  # bytes that tell the kind
_UNPACK = "unpack it and give the image that it holds"
# What people download or give instead of an image: start and position of its magic bytes, what it is, what to do.
_NO_IMAGES = (
    (b"PK\3\4", 0, "a ZIP archive", _UNPACK),
    (b"ustar", 257, "a tar archive", _UNPACK),
    (b"7z\xbc\xaf", 0, "a 7z archive", _UNPACK),
    (b"BZh", 0, "packed with bzip2", _UNPACK),
    (b"\xfd7zXZ", 0, "packed with xz", _UNPACK),
    (b"\x28\xb5\x2f\xfd", 0, "packed with zstd", _UNPACK),
    (b"version https://git-lfs", 0, "a pointer of git-lfs, not the file", "fetch it with git lfs pull"),
    (b"/annex/", 0, "a pointer of git-annex, not the file", "fetch it with git annex get"),
    (b"<!doctype html", 0, "a web page, not the file", "download the file itself"),
    (b"<html", 0, "a web page, not the file", "download the file itself"),
    (b"%pdf", 0, "a PDF", "export its picture as PNG or TIFF"),
    (b"\x93numpy", 0, "an array of numpy without a place", "write it as NIfTI or TIFF"),
)

_META = re.compile(rb"^\s*(ObjectType|NDims)\s*[=:]", re.MULTILINE)
_MGH_TYPES = (0, 1, 3, 4)


def kind_of(path: Path) -> str:
    """Return the kind of a file, one of the names above; ``gzip`` for a packed one that must be unpacked first.

    Notes:
        Packed NIfTI and MGH are NIfTI and MGH: their readers unpack.
    """
    if not is_packed(path):
        return _kind(read_head(path, _HEAD))
    inner = _kind(_unpacked_head(path))
    return inner if inner in (NIFTI, MGH) else GZIP


def known_otherwise(path: Path) -> str:
    """Return what a file is, or packs, that is certainly no image, and what to do, as the rest of a sentence."""
    head = (_unpacked_head(path) if is_packed(path) else read_head(path, _HEAD)).lower()
    if len(head) == _HEAD and not any(head):
        return "starts with nothing but zero bytes, as no image does; fetch or export it again"
    for magic, start, name, remedy in _NO_IMAGES:
        if head[start:].startswith(magic.lower()):
            return f"is {name}; {remedy}"
    return ""


def _unpacked_head(path: Path) -> bytes:
    """Return the first bytes inside a file of gzip, fewer where it breaks off."""
    head = b""
    try:
        with gzip.open(path) as file:
            while len(head) < _HEAD and (part := file.read1(_HEAD - len(head))):
                head += part
    except (gzip.BadGzipFile, EOFError, zlib.error):
        pass
    return head


def _kind(head: bytes) -> str:
    if head.startswith(b"NRRD"):
        return NRRD
    return _nifti(head) or _mgh(head) or (META if _META.search(head) else UNKNOWN)


def _nifti(head: bytes) -> str:
    """NIfTI and Analyze start with the length of their header; Analyze has no magic bytes."""
    if head[4:7] in (b"n+2", b"ni2") and 540 in _both_orders(head):
        return NIFTI
    if 348 not in _both_orders(head):
        return UNKNOWN
    return NIFTI if head[344:347] in (b"n+1", b"ni1") else ANALYZE


def _both_orders(head: bytes) -> tuple[int, ...]:
    """Return the number that the file starts with, in both orders of bytes."""
    return tuple(int.from_bytes(head[:4], order) for order in ("little", "big"))


def _mgh(head: bytes) -> str:
    """Version 1, four sizes and a type, all in the order of big computers."""
    if len(head) < 24:
        return UNKNOWN
    version, *sizes, kind = struct.unpack_from(">6i", head)
    return MGH if version == 1 and min(sizes) > 0 and kind in _MGH_TYPES else UNKNOWN
