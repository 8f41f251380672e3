"""The outcome of a cohort: a table of all pairs, a table of those that failed, and a page with both."""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchdeform import __version__
from torchdeform.cohort.plan import Failure, Job
from torchdeform.cohort.task import DONE, FAILED, FIGURES, PairReport
from torchdeform.io.files import atomic_folder

SUMMARY, FAILURES, PAGE = "summary.csv", "failures.csv", "index.html"
WAITING = "waiting"

COLUMNS = ("name", "status", *FIGURES, "seconds", "peak_memory_mb", "gpu_memory_mb", "folder")
FAILURE_COLUMNS = ("name", "sentence", "log")

_LOGS = "logs"
_TEMPLATES = Path(__file__).parent / "templates"
_SHOWN = ("report.html", "overview.png")  # the first that exists is linked from the name of a pair

Row = Mapping[str, str | float]


@dataclass(frozen=True)
class Summary:
    """The outcome of a cohort.

    Attributes:
        out: folder of its results.
        done: number of pairs that are done.
        waiting: number of pairs that have not run.
        failures: pairs that failed.
    """

    out: Path
    done: int
    waiting: int
    failures: tuple[Failure, ...]

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
    write_page(out / PAGE, rows, failed)
    counts = [row["status"] for row in rows]
    return Summary(out, counts.count(DONE), counts.count(WAITING), failures)


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
    with atomic_folder(path.parent) as folder, (folder / path.name).open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def write_page(path: Path, rows: Sequence[Row], failures: Iterable[Row]) -> None:
    """Write the page of a cohort; all text is escaped.

    Args:
        path: the file; links are relative to its folder.
        rows: of the summary, all with the same columns.
        failures: rows of the table of failures.
    """
    from jinja2 import Environment, FileSystemLoader

    loader = FileSystemLoader(_TEMPLATES)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    why = {failure["name"]: failure for failure in failures}
    statuses = [str(row["status"]) for row in rows]
    text = environment.get_template(path.name).stream(
        columns=[column for column in _columns(rows) if column not in ("name", "status", "folder")],
        rows=(
            {"cells": row, "link": _link(path.parent, row), **_trouble(path.parent, why.get(row["name"], {}))}
            for row in rows
        ),
        counts={status: statuses.count(status) for status in (DONE, FAILED, WAITING)},
        title=path.absolute().parent.name,
        version=__version__,
    )
    with atomic_folder(path.parent) as folder, (folder / path.name).open("w", encoding="utf-8") as file:
        file.writelines(text)


def _columns(rows: Sequence[Row]) -> list[str]:
    """Return the columns that are not empty for all pairs."""
    return [column for column in (rows[0] if rows else ()) if any(row[column] != "" for row in rows)]


def _link(folder: Path, row: Row) -> str:
    """Return the file that a pair's name links to, relative to the page; empty if there is none."""
    if not row["folder"]:
        return ""
    return next((f"{row['folder']}/{name}" for name in _SHOWN if (folder / str(row["folder"]) / name).is_file()), "")


def _trouble(folder: Path, failure: Row) -> Row:
    """Return why a pair failed and its log, if there is one; both are empty for other pairs."""
    log = failure.get("log", "")
    return {"sentence": failure.get("sentence", ""), "log": log if (folder / str(log)).is_file() else ""}
