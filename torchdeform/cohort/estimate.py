"""What a cohort takes: time and memory, estimated from the headers of its images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from torchdeform.cohort.plan import Job
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import pyramid_grids
from torchdeform.errors import InputError
from torchdeform.io.images import image_size
from torchdeform.pipeline.memory import choices, fitting_grid, footprint
from torchdeform.registration.optimise import steps_on

# Seconds of one core of an x86 server: of a pair, whatever its size; and per node, step and channel with
# LNCC, by dimension; `Measure.time` has the others beside it.
_PAIR = 1.5
_PER_NODE_STEP = {2: 2e-7, 3: 3e-7}


@dataclass(frozen=True)
class Costs:
    """What pairs take.

    Attributes:
        seconds: of all pairs, one after another, on one core.
        memory: bytes of the largest.
        unknown: number of pairs whose size the files do not say, or for which the limit of memory is too small; they
            do not count.
    """

    seconds: float
    memory: int
    unknown: int

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
    size = cache(size_of)
    seconds = [_seconds(job, size(job.files.fixed)) for job in jobs]
    known = [value for value in seconds if value is not None]
    return Costs(sum(known), max(measure(jobs), default=0), len(seconds) - len(known))


def _seconds(job: Job, size: tuple[tuple[int, ...], int] | None) -> float | None:
    if size is None:
        return None
    (shape, channels), settings = size, job.settings
    grid, (measures, _, symmetric) = Grid(shape), choices(settings)
    if job.memory is not None:
        try:
            grid = fitting_grid(grid, job.memory, channels, settings)
        except InputError:  # the pair itself will say so
            return None
    steps = settings.optimiser.steps
    levels = pyramid_grids(grid, len(steps))
    steps = steps[len(steps) - len(levels) :]
    node_steps = sum(math.prod(g.shape) * steps_on(g, n, settings) for g, n in zip(levels, steps, strict=True))
    fields = (2 if symmetric else 1) * channels * sum(measure.time for measure in measures.values())
    return _PAIR + fields * _PER_NODE_STEP[grid.dim] * node_steps


def measure(jobs: Sequence[Job]) -> list[int]:
    """Return about how many bytes each pair takes at most, 0 where its image does not say.

    Notes:
        Loads ITK, so it is called in a process that is not short of memory.
    """
    size = cache(size_of)
    return [_need(job, size(job.files.fixed)) for job in jobs]


def size_of(path: Path) -> tuple[tuple[int, ...], int] | None:
    """Return the shape and channels of an image from its header, None where it does not say."""
    try:
        return image_size(path)
    except OSError:  # the pair itself will say so
        return None


def _need(job: Job, size: tuple[tuple[int, ...], int] | None) -> int:
    if size is None:
        return job.memory or 0
    shape, channels = size
    need = footprint(Grid(shape), channels, job.settings)
    return need if job.memory is None else min(need, job.memory)
