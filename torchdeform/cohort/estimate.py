"""What a cohort takes: time and memory, estimated from the headers of its images."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torchdeform.cohort.plan import Job
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import pyramid_grids
from torchdeform.core.worker import TimeLimit, Worker, WorkerLost
from torchdeform.errors import InputError, explain
from torchdeform.io.gate import DAMAGED
from torchdeform.io.images import image_size
from torchdeform.metrics.mind import neighbour_pairs
from torchdeform.pipeline.memory import Channels, choices, fitting_grid, footprint
from torchdeform.registration.settings import MIND

# Seconds of one core of an x86 server: of a pair, whatever its size; and per node, step and channel with
# LNCC, by dimension; `Measure.time` has the others beside it.
_PAIR = 1.5
_PER_NODE_STEP = {2: 2e-7, 3: 3e-7}
_KEYPOINTS = {2: 1.5, 3: 10.0}  # seconds to find 2000 of them, in images of any size
_HEADER = 60.0  # seconds that reading a header may take
_FEATURES = 16  # that a program is taken to make, which is not run for an estimate

# Shape and channels of an image; None where its file does not say; a sentence where that cannot be read.
Size = tuple[tuple[int, ...], int] | str | None


@dataclass(frozen=True)
class Costs:
    """What pairs take.

    Attributes:
        seconds: of all pairs, one after another, on one core.
        memory: bytes of the largest.
        unknown: number of pairs whose size the files do not say, or for which the limit of memory is too small; they
            do not count.
        unreadable: of those, the names of pairs whose header cannot be read, and why.
    """

    seconds: float
    memory: int
    unknown: int
    unreadable: Mapping[str, str] = field(default_factory=dict)

    @property
    def readable_time(self) -> str:
        """The time with a unit, ``3.5 h``."""
        units = ((86400, "days"), (3600, "h"), (60, "min"))
        size, unit = next(((size, unit) for size, unit in units if self.seconds >= 1.5 * size), (1, "s"))
        return (
            f"{self.seconds / size:.2g} {unit}" if self.seconds < 99.5 * size else f"{self.seconds / size:.0f} {unit}"
        )


def estimate(jobs: Sequence[Job]) -> Costs:
    """Return what pairs take, to about a factor of two in time; every level is taken to use all its steps."""
    found = _sizes(jobs)
    sizes = [found[job.files.fixed] for job in jobs]
    seconds = [_seconds(job, size) for job, size in zip(jobs, sizes, strict=True)]
    known = [value for value in seconds if value is not None]
    needs = [_need(job, size) for job, size in zip(jobs, sizes, strict=True)]
    unreadable = {job.name: size for job, size in zip(jobs, sizes, strict=True) if isinstance(size, str)}
    return Costs(sum(known), max(needs, default=0), len(seconds) - len(known), unreadable)


def _seconds(job: Job, size: Size) -> float | None:
    if not isinstance(size, tuple):
        return None
    settings, (grid, channels) = job.settings, _channels(job, size)
    measures, start, symmetric = choices(settings)
    if job.memory is not None:
        try:
            grid = fitting_grid(grid, job.memory, channels, settings)
        except InputError:  # the pair itself will say so
            return None
    steps = settings.optimiser.steps
    levels = pyramid_grids(grid, len(steps))
    steps = steps[len(steps) - len(levels) :]
    node_steps = sum(math.prod(g.shape) * n for g, n in zip(levels, steps, strict=True))
    maps = (2 if symmetric else 1) + len(set(settings.sliding))
    compared = channels.features if settings.only_features else channels.features + channels.images
    fields = maps * compared * sum(measure.time for measure in measures.values())
    searched = _KEYPOINTS[grid.dim] if start == "keypoints" else 0.0
    return _PAIR + searched + fields * _PER_NODE_STEP[grid.dim] * node_steps


def measure(jobs: Sequence[Job]) -> list[int]:
    """Return about how many bytes each pair takes at most, 0 where its image does not say."""
    sizes = _sizes(jobs)
    return [_need(job, sizes[job.files.fixed]) for job in jobs]


def _sizes(jobs: Sequence[Job]) -> dict[Path, Size]:
    """Return the sizes of fixed images.

    Notes:
        Headers are read in a process of its own, which ends with this function: it needs memory, and a file may crash
        it or keep it for ever. That costs this file only.
    """
    reader = Worker()
    try:
        return {path: _size(path, reader) for path in {job.files.fixed: None for job in jobs}}
    finally:
        reader.stop()


def _size(path: Path, reader: Worker) -> Size:
    try:
        return reader.call(size_of, path, timeout=_HEADER)
    except WorkerLost:
        return f"{path} makes its reader crash, so it {DAMAGED}"
    except TimeLimit:
        return f"{path} keeps the reader of its header busy for more than {_HEADER:.0f} s, so it {DAMAGED}"


def size_of(path: Path) -> Size:
    """Return shape and channels of an image from its header, None where it does not say, or why it cannot be read."""
    try:
        return image_size(path)
    except OSError:  # the pair itself will say so
        return None
    except Exception as error:  # noqa: BLE001 - nothing about one file may stop the others
        return explain(error)[0]


def _channels(job: Job, size: tuple[tuple[int, ...], int]) -> tuple[Grid, Channels]:
    """Return the grid of a pair, and its channels, as far as they are known beforehand."""
    (shape, images), settings = size, job.settings
    made = images * len(neighbour_pairs(len(shape))) if MIND in settings.sources else 0
    others = len(settings.programs) + (job.files.fixed_features is not None)
    return Grid(shape), Channels(images, made + others * _FEATURES)


def _need(job: Job, size: Size) -> int:
    if not isinstance(size, tuple):
        return job.memory or 0
    need = footprint(*_channels(job, size), job.settings)
    return need if job.memory is None else min(need, job.memory)
