"""One pair in a worker process: registered, logged, and reported in a few numbers."""

import faulthandler
import os
import platform
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, strftime
from typing import Any

from torchdeform.cohort.plan import Job, register_job
from torchdeform.core.memory import peak
from torchdeform.errors import InputError, MachineError, explain, of_machine

DONE, FAILED = "done", "failed"

# Figures of a pair in the summary, most of them with their names in the pair's record.
FIGURES = (
    "verdict",
    "headline",
    "similarity_before",
    "similarity_after",
    "dice_before",
    "dice_after",
    "landmark_error_before",
    "landmark_error_after",
    "folds",
    "determinant_min",
    "determinant_max",
    "inverse_error_mean",
    "inverse_error_max",
    "unit",
)
# The names in the record of the figures that are measured before and after.
_MEASURED = {"dice": "dice_mean", "landmark_error": "landmark_error_mean"}


@dataclass(frozen=True)
class Task:
    """A job and its log file."""

    job: Job
    log: Path


@dataclass(frozen=True)
class PairReport:
    """The outcome of a pair, small enough to be sent between processes.

    Attributes:
        status: ``done`` or ``failed``.
        sentence: why it failed, and what to do.
        seconds: wall time of the registration, with reading and writing files.
        peak_memory: peak memory of the process in bytes, 0 if unknown.
        gpu_memory: peak memory on the GPU in bytes.
        figures: entries of the summary by column, without those that were not measured.
        files: names of the results in the pair's folder.
    """

    status: str
    sentence: str = ""
    seconds: float = 0.0
    peak_memory: int = 0
    gpu_memory: int = 0
    figures: Mapping[str, float | str] = field(default_factory=dict)
    files: tuple[str, ...] = ()


def perform(task: Task) -> PairReport:
    """Register a pair and report. Every error but the end of the process becomes a report, too.

    Raises:
        MachineError: a disk is full or gone, which says nothing about the pair.

    Notes:
        Everything that the process prints in that time goes to the log, even the traceback of a crash.
    """
    try:
        return _attempt(task)
    except Exception as error:
        if of_machine(error) is not None:
            raise MachineError(explain(error)[0]) from None
        raise


def _attempt(task: Task) -> PairReport:
    start = perf_counter()
    with _logged(task.log):
        _log_job(task.job)
        _reset_peaks()
        try:
            report = _register(task.job, start)
        except Exception as error:
            sentence = _sentence(error)
            if of_machine(error) is not None:
                raise
            report = PairReport(FAILED, sentence, perf_counter() - start, *_peaks())
        sys.stderr.write(f"{strftime('%FT%T')} {report.status} {report.sentence}\n")
        return report


def _register(job: Job, start: float) -> PairReport:
    outcome = register_job(job)
    for warning in outcome.record["warnings"]:
        sys.stderr.write(f"warning: {warning}\n")
    return PairReport(DONE, "", perf_counter() - start, *_peaks(), _figures(outcome.record), outcome.record["files"])


def _sentence(error: Exception) -> str:
    """Return the sentence about an error; the traceback goes to the log unless the input is wrong."""
    if not isinstance(error, InputError):
        traceback.print_exception(error)
    return explain(error)[0]


def _figures(record: dict[str, Any]) -> dict[str, float | str]:
    verdict = {"verdict": record["verdict"]["kind"], "headline": record["verdict"]["headline"]}
    measured = {
        f"{column}_{stage}": record["evaluation"].get(stage, {}).get(key)
        for column, key in _MEASURED.items()
        for stage in ("before", "after")
    }
    return {name: value for name in FIGURES if (value := (record | measured | verdict)[name]) is not None}


def _log_job(job: Job) -> None:
    """Write the job, the machine and the process into the log."""
    lines = [f"{strftime('%FT%T')} {job.name} on {platform.node()}, process {os.getpid()}"]
    lines += [f"  {name}: {path}" for name, path in job.files.given().items()]
    sys.stderr.write("\n".join([*lines, f"  {job.settings}"]) + "\n")


@contextmanager
def _logged(log: Path) -> Iterator[None]:
    """Append everything that this process prints, also from C libraries, to a file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    saved = [os.dup(descriptor) for descriptor in (1, 2)]
    with log.open("a", encoding="utf-8") as file:
        _redirect([file.fileno()] * 2)
        faulthandler.enable(file)
        try:
            yield
        finally:
            faulthandler.disable()
            _redirect(saved)
            for descriptor in saved:
                os.close(descriptor)


def _redirect(targets: list[int]) -> None:
    for stream, descriptor, target in zip((sys.stdout, sys.stderr), (1, 2), targets, strict=True):
        with suppress(OSError, ValueError):
            stream.flush()
        os.dup2(target, descriptor)


def _reset_peaks() -> None:
    """Start the peak memory of this process anew; Linux only, elsewhere it is the peak over all its pairs."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    if (cuda := _cuda()) is not None:
        cuda.reset_peak_memory_stats()


def _peaks() -> tuple[int, int]:
    """Return the peak memory of this process and on its GPU, in bytes."""
    cuda = _cuda()
    return peak() or 0, 0 if cuda is None else cuda.max_memory_allocated()


def _cuda() -> Any:
    """Return ``torch.cuda`` if it is in use, else None."""
    import torch

    return torch.cuda if torch.cuda.is_initialized() else None
