"""Files: results that appear complete or not at all, and C libraries that print nothing."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchdeform.errors import InputError

_STDERR = threading.Lock()
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two with offsets of 64 bits (BigTIFF)


def suffix(path: Path) -> str:
    """Return the lower-case ending of a file name that tells its format; ``.nii.gz`` counts as one ending."""
    endings = [s.lower() for s in path.suffixes]
    return "".join(endings[-2:]) if endings[-1:] == [".gz"] else "".join(endings[-1:])


def stem(path: Path) -> str:
    """Return a file name without the ending that `suffix` returns."""
    return path.name[: len(path.name) - len(suffix(path))] or path.name


def read_head(path: Path, count: int) -> bytes:
    """Return the first bytes of a file."""
    with path.open("rb") as file:
        return file.read(count)


def is_tiff(path: Path) -> bool:
    """Return whether the content of a file starts like a TIFF, whatever its name: most slides are TIFF too."""
    return read_head(path, 4) in _TIFF


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder whose files move into ``folder`` at the end, or are deleted after an error.

    Args:
        folder: where the files go; created if missing. Files of the same names are replaced, others stay.

    Raises:
        InputError: nothing can be written there.

    Notes:
        The files are renamed once all are complete. Both folders are on one file system, so a rename is atomic and
        nobody sees a half-written file.
    """
    with _temporary_folder(folder) as temporary:
        yield Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for file in sorted(Path(temporary).iterdir()):
            file.replace(folder / file.name)


def require_writable(folder: Path) -> None:
    """Raise `InputError` unless files can be written into ``folder``, which may be missing; leaves nothing behind."""
    _temporary_folder(folder).cleanup()


def _temporary_folder(folder: Path) -> "tempfile.TemporaryDirectory[str]":
    """Return a new temporary folder on the file system of ``folder``."""
    try:
        return tempfile.TemporaryDirectory(prefix=".torchdeform-", dir=_nearest_folder(folder))
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another folder") from error


def _nearest_folder(folder: Path) -> Path:
    """Return the folder itself if it exists, else its nearest parent that exists."""
    for candidate in (folder, *folder.absolute().parents):
        if candidate.is_dir():
            return candidate
        if candidate.exists() or candidate.is_symlink():
            raise InputError(f"cannot write to {folder}: {candidate} is not a folder; choose another name")
    raise InputError(f"cannot write to {folder}: there is no such place; choose another folder")


@contextmanager
def native_stderr(*, stdout: bool = False) -> Iterator[list[str]]:
    """Collect what C and C++ libraries print on stderr; the list is filled when the block ends.

    Args:
        stdout: collect what they print there, too; libjpeg inside of ITK does.

    Notes:
        It redirects the file descriptors of the whole process, so only one thread at a time can be in such a block.
    """
    lines: list[str] = []
    descriptors = (1, 2) if stdout else (2,)
    with _STDERR, tempfile.TemporaryFile() as sink:
        sys.stdout.flush()
        sys.stderr.flush()
        saved = [os.dup(descriptor) for descriptor in descriptors]
        for descriptor in descriptors:
            os.dup2(sink.fileno(), descriptor)
        try:
            yield lines
        finally:
            for descriptor, before in zip(descriptors, saved, strict=True):
                os.dup2(before, descriptor)
                os.close(before)
            sink.seek(0)
            lines.extend(sink.read().decode(errors="replace").splitlines())
