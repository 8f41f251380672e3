"""Readers in C that may take a process with them, or never end: they are called in a process of their own."""

import atexit
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TypeVar

from torchdeform.core.memory import available
from torchdeform.core.worker import TimeLimit, Worker, WorkerLost
from torchdeform.errors import InputError
from torchdeform.io.gate import DAMAGED

T = TypeVar("T")

_SECONDS, _PER_BYTE = 30.0, 1e-6  # that a reader may take, and more for each byte of the file
_LIBRARIES, _UNPACKED = 700_000_000, 1100  # bytes for what it loads and needs, and for each byte of the file
# Every thread would take memory of its own.
_ENVIRONMENT = {"MALLOC_ARENA_MAX": "2", "OMP_NUM_THREADS": "1", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS": "1"}


def isolated(
    function: Callable[..., T], *arguments: object, path: Path, size: int | None = None, seconds: float | None = None
) -> T:
    """Return ``function(*arguments)``, called in a process of its own that may crash or hang.

    Args:
        function: of a module without torch, which would take a second to load there.
        arguments: of the function; they and the answer must allow pickling.
        path: the file that is read, for the sentence.
        size: bytes that are read; by default those of ``path``.
        seconds: that it may take, 30 by default, and 1 more for each megabyte.

    Raises:
        InputError: the process died or took too long.
        Exception: what the function raised.

    Notes:
        The process starts with the first call (0.3 s), is kept for the next, and ends with this one. It gets no more
        memory than is free, and than a file of its size can ask for.
    """
    size = path.stat().st_size if size is None else size
    seconds = (_SECONDS if seconds is None else seconds) + _PER_BYTE * size
    try:
        return _worker(os.getpid()).call(_limited, Path.cwd(), _most(size), function, arguments, timeout=seconds)
    except MemoryError as error:
        if _most(size) == available():
            raise
        raise InputError(f"{path} asks for far more memory than it can fill, so it {DAMAGED}") from error
    except WorkerLost as error:
        raise InputError(f"{path} makes its reader crash, so it {DAMAGED}") from error
    except TimeLimit as error:
        raise InputError(f"{path} keeps its reader busy for more than {seconds:.0f} s, so it {DAMAGED}") from error


@cache
def _worker(_process: int) -> Worker:
    """Return the one worker of this process; a forked process makes its own."""
    worker = Worker(_ENVIRONMENT)
    atexit.register(worker.stop)
    return worker


def _most(size: int) -> int | None:
    """Return how many bytes reading a file of ``size`` bytes may take, None where no limit is known."""
    free = available()
    return None if free is None else min(free, _LIBRARIES + _UNPACKED * size)


def _limited(folder: Path, most: int | None, function: Callable[..., T], arguments: tuple[object, ...]) -> T:
    """Call a function in ``folder`` that may take no more than ``most`` bytes beside what the process has."""
    os.chdir(folder)
    if most is not None:
        try:
            import resource
        except ImportError:  # not on Windows
            return function(*arguments)
        resource.setrlimit(resource.RLIMIT_DATA, (_held() + most, resource.RLIM_INFINITY))
    return function(*arguments)


def _held() -> int:
    """Return the bytes of data that this process has."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, LookupError):
        return 1 << 34
