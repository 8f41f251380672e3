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
        memory than is free.
    """
    seconds = (seconds or _SECONDS) + _PER_BYTE * (path.stat().st_size if size is None else size)
    try:
        return _worker(os.getpid()).call(_limited, Path.cwd(), available(), function, arguments, timeout=seconds)
    except WorkerLost as error:
        raise InputError(f"{path} makes its reader crash, so it {DAMAGED}") from error
    except TimeLimit as error:
        raise InputError(f"{path} keeps its reader busy for more than {seconds:.0f} s, so it {DAMAGED}") from error


@cache
def _worker(_process: int) -> Worker:
    """Return the one worker of this process; a forked process makes its own."""
    worker = Worker()
    atexit.register(worker.stop)
    return worker


def _limited(folder: Path, most: int | None, function: Callable[..., T], arguments: tuple[object, ...]) -> T:
    """Call a function in ``folder`` that may take no more than ``most`` bytes beside what the process has."""
    os.chdir(folder)
    if most is not None:
        try:
            import resource
        except ImportError:  # not on Windows
            return function(*arguments)
        resource.setrlimit(resource.RLIMIT_AS, (_held() + most, resource.RLIM_INFINITY))
    return function(*arguments)


def _held() -> int:
    """Return the bytes of addresses that this process has."""
    try:
        return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return 1 << 34
