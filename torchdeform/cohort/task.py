"""One pair in a worker process: registered, logged, and told about in a few numbers."""

import faulthandler
import os
import platform
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from time import perf_counter, strftime
from typing import Any

from torchdeform.cohort.plan import Job, register_job
from torchdeform.errors import InputError, explain
from torchdeform.pipeline.memory import peak

DONE, FAILED = "done", "failed"

# Figures of a pair's record that go into the summary as they are.
_FIGURES = (
    "similarity_before",
    "similarity_after",
    "folds",
    "determinant_min",
    "determinant_max",
    "inverse_error_mean",
    "inverse_error_max",
)
# What was measured before and after, by its name in the summary.
_MEASURED = {"dice": "dice_mean", "landmark_error": "landmark_error_mean"}


@dataclass(frozen=True)
class Task:
    """A job, and the file for what it says while it runs."""

    job: Job
    log: Path


@dataclass(frozen=True)
class Report:
    """What became of a pair, small enough to travel.

    Attributes:
        status: ``done`` or ``failed``.
        sentence: why it failed, and what to do.
        seconds: wall time of the registration, files read and written among it.
        peak_memory: bytes that the process held at most, 0 if unknown.
        gpu_memory: bytes that it held on the GPU at most.
        figures: the summary's numbers by column; what was not measured is missing.
        files: names of the results in the pair's folder.
    """

    status: str
    sentence: str = ""
    seconds: float = 0.0
    peak_memory: int = 0
    gpu_memory: int = 0
    figures: Mapping[str, float] = field(default_factory=dict)
    files: tuple[str, ...] = ()


def perform(task: Task) -> Report:
    """Register a pair and report; whatever goes wrong short of the end of the process is a report as well.

    Notes:
        All that the process prints meanwhile goes to the log, a crash's traceback among it.
    """
    start = perf_counter()
    with _logged(task.log):
        _say(task.job)
        _forget_peak()
        try:
            report = _register(task.job, start)
        except Exception as error:  # noqa: BLE001 - one pair's failure is its own
            report = Report(FAILED, _sentence(error), perf_counter() - start, *_peaks())
        sys.stderr.write(f"{strftime('%FT%T')} {report.status} {report.sentence}\n")
        return report


def _register(job: Job, start: float) -> Report:
    outcome = register_job(job)
    for warning in outcome.record["warnings"]:
        sys.stderr.write(f"warning: {warning}\n")
    return Report(DONE, "", perf_counter() - start, *_peaks(), _figures(outcome.record), outcome.record["files"])


def _sentence(error: Exception) -> str:
    """Return what to tell about an error; the traceback of one that nobody foresaw goes to the log."""
    if not isinstance(error, InputError):
        traceback.print_exception(error)
    return explain(error)[0]


def _figures(record: dict[str, Any]) -> dict[str, float]:
    found = {name: record[name] for name in _FIGURES}
    for column, key in _MEASURED.items():
        for stage in ("before", "after"):
            value = record["evaluation"].get(stage, {}).get(key)
            if value is not None:
                found[f"{column}_{stage}"] = value
    return found


def _say(job: Job) -> None:
    """Write into the log what runs, and where."""
    lines = [f"{strftime('%FT%T')} {job.name} on {platform.node()}, process {os.getpid()}"]
    given = ((f.name, getattr(job.files, f.name)) for f in fields(job.files))
    lines += [f"  {name}: {path}" for name, path in given if path is not None]
    sys.stderr.write("\n".join([*lines, f"  {job.settings}"]) + "\n")


@contextmanager
def _logged(log: Path) -> Iterator[None]:
    """Send what this process prints, its C libraries included, to the end of a file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    kept = [os.dup(descriptor) for descriptor in (1, 2)]
    with log.open("a", encoding="utf-8") as file:
        _turn([file.fileno()] * 2)
        faulthandler.enable(file)
        try:
            yield
        finally:
            faulthandler.disable()
            _turn(kept)
            for descriptor in kept:
                os.close(descriptor)


def _turn(targets: list[int]) -> None:
    for stream, descriptor, target in zip((sys.stdout, sys.stderr), (1, 2), targets, strict=True):
        with suppress(OSError, ValueError):
            stream.flush()
        os.dup2(target, descriptor)


def _forget_peak() -> None:
    """Let the peak of this process count from now, where Linux can (elsewhere it is the peak of all its pairs)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    if (cuda := _cuda()) is not None:
        cuda.reset_peak_memory_stats()


def _peaks() -> tuple[int, int]:
    """Return the peaks of this process's memory and of its GPU's, in bytes."""
    cuda = _cuda()
    return peak() or 0, 0 if cuda is None else cuda.max_memory_allocated()


def _cuda() -> Any:
    """Return torch's CUDA if it is in use, else None."""
    import torch

    return torch.cuda if torch.cuda.is_initialized() else None
