"""How much memory pairs need, from the headers of their images."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from torchdeform.batch.job import Job
from torchdeform.grid import Grid
from torchdeform.io.sizes import image_size
from torchdeform.memory import estimate


def measure(jobs: Sequence[Job]) -> list[int]:
    """Return about how many bytes each pair takes at most, 0 where its image does not say.

    Notes:
        Loads ITK, so it is called in a process that is not short of memory.
    """
    look = cache(size_of)
    return [_need(job, look(job.files.fixed)) for job in jobs]


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
    maps = 2 if job.settings.symmetric else 1
    how = {"channels": channels, "similarity": job.settings.similarity, "start": job.settings.start}
    need = maps * estimate(Grid(shape), **how)
    return need if job.memory is None else min(need, job.memory)
