"""Memory: how much a registration takes, how much there is, and which grid fits."""

import math
import re
import sys
from pathlib import Path

import torch

from torchdeform.core.grid import Grid
from torchdeform.core.resampling import MIN_NODES, with_spacing
from torchdeform.errors import InputError
from torchdeform.fem.solver import LARGEST_MATRIX
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.metrics.similarity import Measure, measures_in
from torchdeform.registration.settings import RegistrationSettings

_UNITS = {"": 1, "k": 1e3, "m": 1e6, "g": 1e9, "t": 1e12, "ki": 2**10, "mi": 2**20, "gi": 2**30, "ti": 2**40}
_SIZE = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([kmgt]i?)?b?\s*", re.IGNORECASE)

_PEAK_UNIT = 1 if sys.platform == "darwin" else 1024  # bytes that ru_maxrss counts in

_SHRINK = 0.97  # steps in which the grid that fits is sought, per axis

_PROCESS = Path("/proc/self/cgroup")
_GROUPS = Path("/sys/fs/cgroup")
_MEMINFO = Path("/proc/meminfo")
_STATUS = Path("/proc/self/status")
# Limit and use of a control group, by its version's file names.
_LIMITS = (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes"))

# Measured by ``scripts/benchmarks/memory.py``: bytes of a process that has imported everything; and per node of the
# fixed grid, whatever the similarity, by dimension. To these come those of `Measure.memory` per node and channel.
_PROCESS_BYTES = 4.5e8
_PER_NODE = {2: 100.0, 3: 80.0}
# The same of a discrete start, whatever the similarity: per node, and per node and channel. What holds more counts.
_DISCRETE = {2: (130.0, 75.0), 3: (100.0, 65.0)}
# And of an assembled matrix while it is made: per entry.
_PER_ENTRY = 90
# And of reading, joining, judging and writing on the fixed grid, however coarse the finest level is.
_FILES = {2: (65.0, 48.0), 3: (80.0, 26.0)}


def choices(settings: RegistrationSettings) -> tuple[dict[str, Measure], bool, bool]:
    """Return what the cost of a registration depends on: its measures, a discrete start or not, symmetric or not."""
    return measures_in(settings.similarity.measure), settings.starts_discretely, settings.symmetric


def footprint(grid: Grid, channels: int, settings: RegistrationSettings) -> int:
    """Return about how many bytes a process holds at most that registers images on this grid, from files to files.

    Args:
        grid: of the fixed image, which the finest level has.
        channels: of the images.
        settings: of the registration.

    Notes:
        Affine in the number of nodes; coarser levels are smaller by 2^D and do not count. Measured in float32 on a CPU,
        within 25 % from 64³ to 256³ and from 512² to 4096², and rather more than is taken beyond.
    """
    measures, discrete, symmetric = choices(settings)
    maps = 2 if symmetric else 1
    per_channel = sum(measure.memory[grid.dim - 2] for measure in measures.values())
    rates = [(maps * _PER_NODE[grid.dim], maps * per_channel), *([_DISCRETE[grid.dim]] if discrete else [])]
    return max(_affine(grid, channels, rate) for rate in rates) + _matrix(grid, settings)


def _matrix(grid: Grid, settings: RegistrationSettings) -> int:
    """Return the bytes of the largest matrix that is assembled, 0 where none is."""
    entries = DivCurlSystem(grid, Weights()).matrix_entries
    return _PER_ENTRY * min(entries, LARGEST_MATRIX) if settings.solver.method == "assembled" else 0


def _affine(grid: Grid, channels: int, rate: tuple[float, float]) -> int:
    """Return the bytes of a process that holds so many for a node, and so many for a node and channel."""
    node, channel = rate
    return round(_PROCESS_BYTES + (node + channels * channel) * math.prod(grid.shape))


def available(device: torch.device | str = "cpu") -> int | None:
    """Return the bytes that this process may still take on ``device``, None if that cannot be known.

    Args:
        device: ``cpu`` (the kernel's figure for memory that is free, or what a control group's limit leaves) or a CUDA
            device.
    """
    if torch.device(device).type == "cuda":
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
    size = round(float(found[1]) * _UNITS[(found[2] or "").lower()]) if found else 0
    if size <= 0:
        raise InputError(f"a size of memory is a number with a unit, such as 4GB or 512MB, got '{text}'")
    return size


def readable(size: int, *, spaced: bool = True) -> str:
    """Return a number of bytes with a unit, as ``1.9 GB``; without the space `parse_size` takes it as a setting."""
    exponent = next((e for e in range(4) if size / 1000**e < 999.5), 4)  # 999.5 has three digits no more
    return f"{size / 1000**exponent:.3g}{' ' if spaced else ''}{('B', 'kB', 'MB', 'GB', 'TB')[exponent]}"


def fitting_grid(grid: Grid, limit: int, channels: int, settings: RegistrationSettings) -> Grid:
    """Return the finest grid of the same box on which a registration takes at most ``limit`` bytes.

    Args:
        grid: of the fixed image; returned as it is if it fits.
        limit: bytes, see `parse_size`.
        channels: of the images.
        settings: of the registration.

    Raises:
        InputError: files of this size take more, however coarse the finest level is.

    Notes:
        Voxels become larger until it fits, the small ones of thick slices first, as in `pyramid_grids`.
    """
    least = min(_affine(grid, channels, _FILES[grid.dim]), footprint(grid, channels, settings))
    if limit < least:
        raise InputError(
            f"--memory {readable(limit, spaced=False)} is too little for a fixed image of "
            f"{grid.size_text}: give at least {readable(least, spaced=False)}, or resample it"
        )
    size, coarser = min(grid.spacing), grid
    while footprint(coarser, channels, settings) > limit and max(coarser.shape) > MIN_NODES:
        size /= _SHRINK
        coarser = with_spacing(grid, size)
    return coarser
