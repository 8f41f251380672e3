"""The outcome of a cohort: a table of all pairs, a table of those that failed, and a page with both."""

import csv
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torchdeform.cohort.page import WAITING, Row, badge_of, means, write_page
from torchdeform.cohort.plan import Failure, Job
from torchdeform.cohort.task import DONE, FAILED, FIGURES, PairReport
from torchdeform.io.files import atomic_file

SUMMARY, FAILURES, PAGE = "summary.csv", "failures.csv", "index.html"
COLUMNS = ("name", "status", *FIGURES, "seconds", "peak_memory_mb", "gpu_memory_mb", "folder")
FAILURE_COLUMNS = ("name", "sentence", "log")

_LOGS = "logs"


@dataclass(frozen=True)
class Summary:
    """The outcome of a cohort.

    Attributes:
        out: folder of its results.
        done: number of pairs that are done.
        waiting: number of pairs that have not run.
        failures: pairs that failed.
        badges: numbers of pairs by `badge_of`.
        means: of every measure over the pairs that are done, as text by title.
    """

    out: Path
    done: int
    waiting: int
    failures: tuple[Failure, ...]
    badges: Mapping[str, int] = field(default_factory=dict)
    means: Mapping[str, str] = field(default_factory=dict)

    @property
    def failed(self) -> int:
        """Number of pairs that failed."""
        return len(self.failures)


def log_of(out: Path, name: str) -> Path:
    """Return the log file of a pair."""
    return out / _LOGS / f"{name}.log"


def summarise(
    jobs: Sequence[Job], out: Path, known: Mapping[str, PairReport], problems: Iterable[Failure] = ()
) -> Summary:
    """Write ``summary.csv``, ``failures.csv`` and ``index.html``, and return their totals.

    Args:
        jobs: all pairs that can run; those without a report are waiting.
        out: folder of the cohort's results.
        known: reports by name.
        problems: pairs that cannot run.
    """
    problems = tuple(problems)
    lost = [job.name for job in jobs if job.name in known and known[job.name].status == FAILED]
    failures = (*problems, *(Failure(name, known[name].sentence, log_of(out, name)) for name in lost))
    rows = [_row(job, out, known.get(job.name, PairReport(WAITING))) for job in jobs]
    rows += [dict.fromkeys(COLUMNS, "") | {"name": problem.name, "status": FAILED} for problem in problems]
    _write_table(out / SUMMARY, COLUMNS, rows)
    failed = [_failure_row(failure, out) for failure in failures]
    _write_table(out / FAILURES, FAILURE_COLUMNS, failed)
    write_page(out / PAGE, rows, {str(failure["name"]): failure for failure in failed})
    counts = [row["status"] for row in rows]
    return Summary(out, counts.count(DONE), counts.count(WAITING), failures, Counter(map(badge_of, rows)), means(rows))


def _row(job: Job, out: Path, report: PairReport) -> Row:
    folder = os.path.relpath(job.files.out, out) if report.status == DONE else ""
    figures = {name: report.figures.get(name, "") for name in FIGURES}
    costs = {
        "seconds": round(report.seconds, 3) or "",
        "peak_memory_mb": round(report.peak_memory / 1e6) or "",
        "gpu_memory_mb": round(report.gpu_memory / 1e6) or "",
    }
    return {"name": job.name, "status": report.status, **figures, **costs, "folder": folder}


def _failure_row(failure: Failure, out: Path) -> Row:
    log = "" if failure.log is None else os.path.relpath(failure.log, out)
    return {"name": failure.name, "sentence": failure.sentence, "log": log}


def _write_table(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write a table that appears complete or not at all."""
    with atomic_file(path) as new, new.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
