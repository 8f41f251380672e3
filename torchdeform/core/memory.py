"""Memory of this machine: how much is free, how much was used, and sizes as people write them."""

import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from torchdeform.errors import InputError, shown

if TYPE_CHECKING:
    import torch

_UNITS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9, "t": 1e12, "ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}
_SIZE = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]i?)?b?\s*", re.IGNORECASE)

_PEAK_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes that ru_maxrss counts in

_PROCESS = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")
_MEMINFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")
# Limit and use of a control group, by its version's file names.
_LIMITS = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))


def available(device: "torch.device | str" = "cpu") -> int | None:
    """Return the bytes that this process may still take on ``device``, None if that cannot be known.

    Args:
        device: ``cpu`` (the kernel's figure for memory that is free, or what a control group's limit leaves) or a CUDA
            device.
    """
    if str(device).startswith("cuda"):
        import torch

        return int(torch.cuda.mem_get_info(device)[0])
    known = [room for room in (_kilobytes("MemAvailable", _MEMINFO), *_group_rooms()) if room is not None]
    return max(0, min(known)) if known else None


def peak() -> int | None:
    """Return the most bytes of memory that this process has held so far, None if that cannot be known."""
    if (found := _kilobytes("VmHWM", _STATUS)) is not None:  # getrusage counts the parent's until the process has more
        return found
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _PEAK_UNIT


def _kilobytes(name: str, path: Path) -> int | None:
    """Return the bytes of a line ``name: .. kB`` in a file of the kernel, None if there is none."""
    found = re.search(rf"^{name}:\s*(\d+) kB", _text(path), re.MULTILINE)
    return int(found[1]) * 1024 if found else None


def _group_rooms() -> list[int]:
    """Return what the limits of this process's control groups, and of those above them, leave."""
    rooms = []
    for line in _text(_PROCESS).splitlines():
        controller, _, path = line.partition(":")[2].partition(":")
        top = _GROUPS / controller if controller else _GROUPS
        group = top / path.strip("/")
        for folder in (group, *group.parents):
            if folder == _GROUPS.parent:
                break
            rooms += [room for names in _LIMITS if (room := _room(folder, names)) is not None]
    return rooms


def _room(folder: Path, names: tuple[str, str]) -> int | None:
    limit, used = (_text(folder / name).strip() for name in names)
    return int(limit) - int(used) if limit.isdigit() and used.isdigit() else None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""


def parse_size(text: str) -> int:
    """Return the bytes of ``4GB``, ``512 MiB``, ``1.5g`` or ``1000000``; B may be left out, capitals do not count.

    Raises:
        InputError: no such size, or none at all.
    """
    found = _SIZE.fullmatch(text)
    size = float(found[1]) * _UNITS[(found[2] or "").lower()] if found else 0
    if not 0.5 < size < 2**63:
        raise InputError(f"a size of memory is a number with a unit, such as 4GB or 512MB, got {shown(text)}")
    return round(size)


def readable(size: int, *, spaced: bool = True) -> str:
    """Return a number of bytes with a unit, as ``1.9 GB``; without the space `parse_size` takes it as a setting."""
    exponent = next((e for e in range(4) if size / 1000**e < 999.5), 4)  # 999.5 has three digits no more
    return f"{size / 1000**exponent:.3g}{' ' if spaced else ''}{('B', 'kB', 'MB', 'GB', 'TB')[exponent]}"


def at_least(size: int) -> str:
    """Return a number of bytes as `parse_size` takes it, with three digits and not less than ``size``."""
    text = readable(size, spaced=False)
    return text if parse_size(text) >= size else readable(math.ceil(1.005 * size), spaced=False)
