"""One damaged file in a process of its own: what becomes of it, and the memory that it takes."""

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from fuzz_files import Numbers

from torchdeform.errors import TorchdeformError

_LARGEST, _LIMIT = 10**9, 4 * 10**9  # bytes: what counts as too much, and what a process gets at most
_LONGEST = 1000  # characters of a sentence

_LIBRARIES = (
    "nibabel", "pydicom", "SimpleITK", "skimage.io", "tifffile", "yaml", "torchdeform.cli.cite",
    "torchdeform.cohort.plan",
)  # fmt: skip

_SELF = Path("/proc/self")


@dataclass(frozen=True)
class Trial:
    """What became of one file: an outcome, the sentence or error, and the bytes of memory that it took."""

    outcome: str
    detail: str = ""
    memory: int = 0


def prepare() -> None:
    """Import what readers use, so that none of it counts as the file's time or memory."""
    for name in _LIBRARIES:
        import_module(name)
    _limit_memory()


def attempt(read: Callable[[Path], Numbers], path: Path) -> Trial:
    """Read a file in this process.

    Args:
        read: yields the numbers in a file.
        path: the file.
    """
    before = _held("VmRSS")
    _reset_peaks()
    outcome, detail = _judge(read, path)
    grown = max(0, _held("VmHWM") - before)
    return Trial(">1 GB" if grown > _LARGEST else outcome, detail, grown)


def _judge(read: Callable[[Path], Numbers], path: Path) -> tuple[str, str]:
    try:
        numbers = list(read(path))
    except TorchdeformError as error:
        one = "\n" not in str(error) and len(str(error)) < _LONGEST
        return ("typed" if one else "untyped"), str(error)
    except MemoryError:
        return ">1 GB", "MemoryError"
    except Exception as error:  # noqa: BLE001 - this is what is looked for
        return "untyped", f"{type(error).__name__}: {error}"
    return ("ok" if all(map(math.isfinite, numbers)) else "NaN"), ""


def _limit_memory() -> None:
    """Keep this process to what it has now and 4 GB."""
    import resource

    addresses = int((_SELF / "statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (addresses + _LIMIT, resource.RLIM_INFINITY))


def _family() -> Iterator[Path]:
    """Yield the folders of this process and of its children in the kernel's list."""
    yield _SELF
    for task in (_SELF / "task").iterdir():
        with suppress(OSError):  # a thread that has ended
            yield from (Path("/proc") / child for child in (task / "children").read_text(encoding="ascii").split())


def _reset_peaks() -> None:
    """Let the peaks of memory start again from what is held now."""
    for process in _family():
        with suppress(OSError):
            (process / "clear_refs").write_text("5", encoding="ascii")


def _held(name: str) -> int:
    """Return the bytes that this process and its children hold (``VmRSS``) or held at most (``VmHWM``)."""
    total = 0
    for process in _family():
        with suppress(OSError):
            lines = (process / "status").read_text(encoding="utf-8").splitlines()
            total += sum(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))
    return total
