"""Standard streams and signals of the programs: nobody who stops reading stops the work, and a stop is in order."""

import io
import os
import select
import signal
import stat
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

STOPPED = 130  # exit code of a command that Ctrl-C or another signal ended, as shells have it


class _Stream(io.FileIO):
    """A standard stream. Once it cannot be written, what is written to it goes nowhere.

    Attributes:
        lost: why something was lost that was to be kept in a file; empty if nothing was.
    """

    lost = ""

    def write(self, data: Any) -> int:
        """Write bytes; return how many are settled."""
        try:
            while (count := super().write(data)) is None:  # the other end wants no waiting, and is not ready
                select.select([], [self], [])
        except OSError as error:
            if stat.S_ISREG(os.fstat(self.fileno()).st_mode):
                self.lost = error.strerror or str(error)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            return len(data)
        return count


def steady() -> None:
    """Open those of descriptors 0 to 2 that are closed on nothing, and make the standard streams bear every reader.

    Notes:
        Streams that somebody has put in their place are left alone.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free, which is this
    if sys.stdin is None:
        sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - as long as the process
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is getattr(sys, f"__{name}__"):
            setattr(sys, name, _steady(getattr(sys, name), descriptor))


def _steady(stream: Any, descriptor: int) -> io.TextIOWrapper:
    """Return a stream that writes as this one does, None for one that was closed."""
    how = {"encoding": "utf-8", "errors": "backslashreplace", "line_buffering": True}
    if stream is not None:
        stream.flush()
        how = {key: getattr(stream, key) for key in how}
    return io.TextIOWrapper(io.BufferedWriter(_Stream(descriptor, "w", closefd=False)), **how)


def lost_output() -> str:
    """Return why the file that standard output goes to lacks something, empty if it is whole."""
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return (raw.lost or "") if isinstance(raw, _Stream) else ""


@contextmanager
def interruptible() -> Iterator[None]:
    """Treat SIGTERM, by which queues end their jobs, and SIGHUP, of a closed terminal, like Ctrl-C inside the block.

    Notes:
        The second one is ignored, so that it does not stop the tidying up. Signals that are ignored stay so (nohup).
    """
    known = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    mine = [one for one in known if signal.getsignal(one) is not signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread():
        mine = []

    def stop(*_: object) -> None:
        for one in mine:
            signal.signal(one, signal.SIG_IGN)
        raise KeyboardInterrupt

    earlier = {one: signal.signal(one, stop) for one in mine}
    try:
        yield
    finally:
        for one, handler in earlier.items():
            signal.signal(one, handler)
