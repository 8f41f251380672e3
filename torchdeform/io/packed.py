"""Files packed with gzip: no more is unpacked than a machine holds, however little they take packed."""

import gzip
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from torchdeform.core.memory import available, readable
from torchdeform.errors import InputError
from torchdeform.io.files import read_head
from torchdeform.io.gate import DAMAGED

Stream = BinaryIO | gzip.GzipFile

MAGIC = b"\x1f\x8b"
_CHUNK, _LONGEST_TAIL = 1 << 22, 64_000_000  # bytes read at once, and behind pixels
_FULL, _LONGEST = 1 / 4, 2e9  # share of what is free on a disk, or of memory, and bytes that a file may take unpacked


def is_packed(path: Path) -> bool:
    """Return whether a file is compressed with gzip."""
    return read_head(path, len(MAGIC)) == MAGIC


@contextmanager
def opened(path: Path, named: Path | None = None) -> Iterator[Stream]:
    """Open a file, packed or not; what breaks off inside the block is said of the file ``named``."""
    try:
        with gzip.open(path) if is_packed(path) else path.open("rb") as file:
            yield file
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{named or path} {DAMAGED}") from error


def read_tail(file: Stream) -> None:
    """Read what is behind the pixels, if it is not long: the checksum of a packed file is at its end."""
    length = 0
    while length < _LONGEST_TAIL and (part := file.read(_CHUNK)):
        length += len(part)


def unpack(path: Path, target: Path) -> None:
    """Write what a packed file holds.

    Raises:
        InputError: damaged, or too long for the disk and the memory here.
    """
    free = filter(None, (available(), shutil.disk_usage(target.parent).free))
    most = min(_LONGEST, *(_FULL * room for room in free))
    with opened(path) as source, target.open("wb") as sink:
        length = 0
        while part := source.read(_CHUNK):
            length += len(part)
            if length > most:
                raise InputError(
                    f"{path} is longer than {readable(int(most))} unpacked; unpack it and give what it holds"
                )
            sink.write(part)
