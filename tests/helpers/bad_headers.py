"""Headers that take their reader with them; a module that loads at once in another process."""

import os
import signal
import time
from pathlib import Path


def size_or_death(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the size of an image, crash or hang, as its name says."""
    if path.name == "crash.png":
        os.kill(os.getpid(), signal.SIGSEGV)
    if path.name == "hang.png":
        time.sleep(60)
    return (16, 16), 1
