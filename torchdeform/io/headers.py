"""Text headers before pixels: what they may say, and whether the files of pixels hold what they announce."""

import bz2
import math
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.gate import DAMAGED, nearest_file, require_beside, require_room
from torchdeform.io.packed import MAGIC
from torchdeform.io.volume import SINGULAR, independence

LONGEST = 1 << 20  # bytes of a header that are read
CUT_OFF = "has a header that is cut off; fetch or export it again"

_CHUNK, _PACKED = 1 << 22, 1 << 18  # bytes unpacked and read at once
_ANY_HEADER = zlib.MAX_WBITS | 32  # of gzip or zlib
_MOST_AXES, _MOST_FILES = 5, 100_000
_COUNT = re.compile(r"[0-9]{1,15}")
_SKIP = re.compile(r"-?[0-9]{1,15}")
_WORDS = re.compile(r"[^\s,()]+")
_NUMBERED = re.compile(r"([^%]*%0?[0-9]?d[^%\s]*)\s+([0-9]{1,9})\s+([0-9]{1,9})\s+([0-9]{1,9})(?:\s+[0-9])?")

# Length of a unit in mm, by its first letters, and what is shown. Others, and none, are taken for mm.
_UNITS = {"nm": (1e-6, "µm"), "nano": (1e-6, "µm"), "um": (1e-3, "µm"), "µm": (1e-3, "µm"), "μm": (1e-3, "µm"),
          "micro": (1e-3, "µm"), "cm": (10.0, "mm"), "centi": (10.0, "mm"), "met": (1e3, "mm")}  # fmt: skip
_METRE = (1e3, "mm")


@dataclass(frozen=True)
class Header:
    """What the header of an image says about its pixels.

    Attributes:
        path: the file of the header.
        size: number of pixels along x, y, z, ...
        channels: numbers of a pixel.
        width: bytes of a number.
        files: where the pixels are; none if they follow the header.
        packing: raw, gzip, bzip2, text or hex.
        start: bytes before the pixels in their file.
        unit: mm that its unit of length has, and the unit to show.
    """

    path: Path
    size: tuple[int, ...]
    channels: int
    width: int
    files: tuple[Path, ...]
    packing: str
    start: int
    unit: tuple[float, str] = (1.0, "mm")

    @property
    def stored(self) -> int:
        """Bytes of the files of pixels."""
        return sum(file.stat().st_size for file in self._holders())

    def require_room(self) -> None:
        """Raise `InputError` unless every file of pixels is there and what they announce can be there and fits."""
        for file in self.files:
            if not os.path.lexists(file):
                raise InputError(
                    f"{self.path} keeps its pixels in {file.name[:80]}, which does not exist; put that file beside the "
                    f"header, which names it without a folder{nearest_file(file)}"
                )
            require_beside(file, self.path)
        require_room(self.path, self._needed(), stored=self.stored)

    def require_complete(self) -> None:
        """Raise `InputError` unless, besides, every file of pixels is as long as announced; unpacks what is packed."""
        self.require_room()
        share = self._needed() // len(self._holders())
        if any(self._length(file, share) < share for file in self._holders()):
            raise InputError(f"{self.path} {DAMAGED}")

    def _holders(self) -> tuple[Path, ...]:
        return self.files or (self.path,)

    def _needed(self) -> int:
        return math.prod(self.size) * self.channels * self.width

    def _length(self, file: Path, needed: int) -> int:
        """Return how many bytes of pixels a file can hold."""
        if self.packing in ("gzip", "bzip2"):
            return _unpacked_length(file, self.start, self.packing, needed)
        room = file.stat().st_size - self.start
        return {"raw": room, "hex": room // 2, "text": (room + 1) // 2 * self.width}[self.packing]


def _unpacked_length(path: Path, start: int, packing: str, needed: int) -> int:
    """Return how many bytes a packed file holds up to where it breaks off; counting stops at ``needed``."""
    unpacker, length = bz2.BZ2Decompressor() if packing == "bzip2" else _Inflater(), 0
    with path.open("rb") as file:
        file.seek(start)
        try:
            while length < needed and not unpacker.eof:
                packed = file.read(_PACKED) if unpacker.needs_input else b""
                found = len(unpacker.decompress(packed, _CHUNK))
                if not (packed or found) and unpacker.needs_input:
                    break
                length += found
        except zlib.error:
            pass
        except OSError as error:  # the one of bzip2 has no number
            if error.errno:
                raise
    return length


class _Inflater:
    """What unpacks gzip (also several in a row) and zlib, with the interface of what unpacks bzip2.

    It gives no more at once than it is asked for.
    """

    def __init__(self) -> None:
        self._unpacker = zlib.decompressobj(_ANY_HEADER)

    @property
    def eof(self) -> bool:
        return self._unpacker.eof and not self._unpacker.unused_data.startswith(MAGIC)

    @property
    def needs_input(self) -> bool:
        return not self._held

    def decompress(self, data: bytes, most: int) -> bytes:
        held = self._held + data
        if self._unpacker.eof:
            self._unpacker = zlib.decompressobj(_ANY_HEADER)
        return self._unpacker.decompress(held, most)

    @property
    def _held(self) -> bytes:
        return self._unpacker.unconsumed_tail or self._unpacker.unused_data


def sizes(path: Path, text: str, rank: str) -> tuple[int, ...]:
    """Return the sizes of the axes; `InputError` unless they are as many positive whole numbers as ``rank`` says."""
    if rank and not rank.isdecimal():
        raise InputError(f"{path} has the number of axes '{rank[:80]}' in its header; correct the header")
    found = text.split()
    positive = all(_COUNT.fullmatch(size) and int(size) > 0 for size in found)
    if not positive or not 1 <= len(found) <= _MOST_AXES or (rank and rank != str(len(found))):
        raise InputError(
            f"{path} has the size '{text[:80]}' in its header, not {rank[:9] or '1 to 5'} positive whole numbers; "
            "correct the header"
        )
    return tuple(map(int, found))


def count(path: Path, what: str, text: str, least: int) -> int:
    """Return a whole number that is at least ``least``."""
    if not _SKIP.fullmatch(text) or int(text) < least:
        raise InputError(f"{path} has the {what} '{text[:80]}' in its header; correct the header")
    return int(text)


def require_numbers(path: Path, what: str, text: str, *, zero: bool = True) -> None:
    """Raise `InputError` unless a text holds finite numbers only, none of them 0 where that has no meaning."""
    values = _parse(text)
    if values is None or not all(math.isfinite(v) and (zero or v != 0) for v in values):
        raise InputError(
            f"{path} has the {what} '{text[:80]}' in its header, which is no position in space; correct the header"
        )


def require_matrix(path: Path, text: str) -> None:
    """Raise `InputError` unless a text holds the finite numbers of a matrix that can be inverted, or nothing."""
    values = _parse(text)
    rank = round(math.sqrt(len(values or [])))
    if values is None or not all(map(math.isfinite, values)):
        raise InputError(f"{path} has the direction '{text[:80]}' in its header; correct the header")
    if values and rank**2 == len(values) and independence(np.reshape(values, (rank, rank)).T) < SINGULAR:
        raise InputError(f"{path} has a direction matrix that is singular; correct the header")


def _parse(text: str) -> list[float] | None:
    try:
        return [float(number) for number in _WORDS.findall(text)]
    except ValueError:
        return None


def numbered_files(path: Path, text: str) -> tuple[Path, ...]:
    """Return the files of a pattern: ``slice%03d.raw 1 20 1``, with the first and the last number and their step."""
    found = _NUMBERED.fullmatch(text)
    if found is None:
        raise InputError(f"{path} keeps its pixels in '{text[:80]}', which is no file; correct the header")
    first, last, step = map(int, found.groups()[1:])
    numbers = range(first, last + 1, max(1, step))
    return listed_files(path, [found[1] % number for number in numbers[: _MOST_FILES + 1]])


def listed_files(path: Path, names: list[str]) -> tuple[Path, ...]:
    """Return the files of a list of names, which start at the folder of the header."""
    if not 1 <= len(names) <= _MOST_FILES:
        raise InputError(f"{path} keeps its pixels in {len(names) or 'no'} files; correct the header")
    return tuple(path.parent / name for name in names)


def unit_of(name: str) -> tuple[float, str]:
    """Return mm that a unit of length has, and the unit to show, by the name that a header gives it."""
    plain = name.strip(' "').lower()
    return _METRE if plain == "m" else next((_UNITS[start] for start in _UNITS if plain.startswith(start)), (1.0, "mm"))
