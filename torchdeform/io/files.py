"""Files, safely: results that appear whole or not at all, C libraries kept quiet."""

import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchdeform.errors import InputError

_STDERR = threading.Lock()


def suffix(path: Path) -> str:
    """Return the lower-case ending of a file's name that tells its format, ``.nii.gz`` counting as one."""
    endings = [s.lower() for s in path.suffixes]
    return "".join(endings[-2:]) if endings[-1:] == [".gz"] else "".join(endings[-1:])


def stem(path: Path) -> str:
    """Return a file's name without the ending that `suffix` gives."""
    return path.name[: len(path.name) - len(suffix(path))] or path.name


def read_head(path: Path, count: int) -> bytes:
    """Return the first bytes of a file."""
    with path.open("rb") as file:
        return file.read(count)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty folder whose files move into ``folder`` at the end, or vanish if anything went wrong.

    Args:
        folder: where the files shall be; made if need be. Files of the same names are replaced, others left alone.

    Raises:
        InputError: nothing can be written there.

    Notes:
        Every file is renamed when all are complete, on the same file system, so none is ever seen half-written.
    """
    try:
        holder = tempfile.TemporaryDirectory(prefix=".torchdeform-", dir=_nearest_folder(folder))
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another folder") from error
    with holder as temporary:
        yield Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for file in sorted(Path(temporary).iterdir()):
            file.replace(folder / file.name)


def _nearest_folder(folder: Path) -> Path:
    """Return the folder itself if it exists, else the nearest of its parents that does."""
    for candidate in (folder, *folder.absolute().parents):
        if candidate.is_dir():
            return candidate
        if candidate.exists() or candidate.is_symlink():
            raise InputError(f"cannot write to {folder}: {candidate} is not a folder; choose another name")
    raise InputError(f"cannot write to {folder}: no such place; choose another folder")


def require_writable(folder: Path) -> None:
    """Raise `InputError` unless files can be written into ``folder``, which need not exist yet; leaves no trace."""
    try:
        with tempfile.TemporaryDirectory(prefix=".torchdeform-", dir=_nearest_folder(folder)):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another folder") from error


@contextmanager
def native_stderr() -> Iterator[list[str]]:
    """Collect what C and C++ libraries print on stderr; the list is filled when the block ends.

    Notes:
        Turns the process's file descriptor 2, so blocks in different threads wait for one another.
    """
    lines: list[str] = []
    with _STDERR, tempfile.TemporaryFile() as sink:
        sys.stderr.flush()
        saved = os.dup(2)
        os.dup2(sink.fileno(), 2)
        try:
            yield lines
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            lines.extend(sink.read().decode(errors="replace").splitlines())
