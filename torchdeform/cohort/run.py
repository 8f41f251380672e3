"""The run of a cohort: every pair once, what is done left alone, what becomes of each written down at once."""

import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from torchdeform.cohort.executors.local import Engine
from torchdeform.cohort.executors.worker import EngineError
from torchdeform.cohort.journal import Journal, Record
from torchdeform.cohort.plan import Job, Problem
from torchdeform.cohort.settings import EngineSettings
from torchdeform.cohort.summary import Summary, log_of, summarise
from torchdeform.cohort.task import DONE, FAILED, Report, Task
from torchdeform.errors import ComputationError, InputError, explain

EVENTS = "events.jsonl"
BEGIN, SKIPPED, END = "begin", "skipped", "end"

_TEMPORARY_FOLDERS = ".torchdeform-*"  # folders that `io.files.atomic_folder` would have removed


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        kind: ``begin``, ``skipped`` (done before, or failed before and not retried), ``done``, ``failed`` or ``end``.
        name: of the pair, if it is about one.
        sentence: why it failed.
        seconds: that the pair took.
        done: pairs done so far, in this run or before.
        failed: pairs that failed so far, in this run or before, or cannot run.
        total: pairs of the cohort.
        skipped: pairs that need not run.
        elapsed: seconds since the run began.
    """

    kind: str
    name: str
    sentence: str
    seconds: float
    done: int
    failed: int
    total: int
    skipped: int
    elapsed: float

    @property
    def left(self) -> float | None:
        """Seconds until the end, judged by the pairs of this run so far; None before the first."""
        ran = self.done + self.failed - self.skipped
        return self.elapsed / ran * (self.total - self.done - self.failed) if ran > 0 else None


def run(
    jobs: Sequence[Job],
    out: Path,
    engine: EngineSettings,
    *,
    problems: Iterable[Problem] = (),
    resume: bool = True,
    retry_failed: bool = False,
    report: Callable[[Event], None] | None = None,
) -> Summary:
    """Register all pairs of a cohort that are not done yet, and write its summary.

    Args:
        jobs: the pairs, each with a name of its own.
        out: folder of the cohort, for the journal, events, logs and summary; the pairs have theirs in `Job.files`.
        engine: where they run.
        problems: pairs that cannot run, for the summary.
        resume: leave alone what an earlier run settled with the same files (by content), settings and version.
        retry_failed: run again what failed then.
        report: is told of every event, in the thread of the caller.

    Returns:
        What became of the cohort. A pair that fails, hangs or takes its process down is part of it, not an error.

    Raises:
        InputError: two pairs of one name, the folder cannot be written, or another run is at work there.
        ComputationError: no pair can run at all, or the cluster is lost. What is done is kept, and the summary
            written; so it is after Ctrl-C.

    Notes:
        Not more than the pairs that run at the moment are lost when this process is killed.
    """
    lacking = tuple(problems)
    _require_names([*jobs, *lacking])
    with Journal(out) as journal, _events(out, len(jobs) + len(lacking), len(lacking), report) as log:
        state = _State(out, journal, log)
        try:
            todo = [job for job in jobs if not (resume and state.settled(job, retry_failed))]
            _clean(todo, out)
            if todo:
                with _open(engine, todo, out) as where:
                    _register_all(todo, where, state)
        finally:
            _clean(jobs, out)
            summary = summarise(jobs, out, state.known, lacking)
        log.say(END)
    return summary


def review(jobs: Sequence[Job], out: Path, problems: Iterable[Problem] = ()) -> Summary:
    """Write the summary of a cohort from its journal, as the last run of each pair left it; nothing is run."""
    with Journal(out) as journal:
        known = {name: record.report for name, record in journal.records.items()}
        return summarise(jobs, out, known, problems)


def _require_names(pairs: Sequence[Job | Problem]) -> None:
    names = Counter(pair.name.casefold() for pair in pairs)
    name, count = next(iter(names.most_common(1)), ("", 0))
    if count > 1:
        raise InputError(f"{count} pairs are called {name}; give each its own name")


class _EventLog:
    """Counts what happens, writes it down, and passes it on."""

    def __init__(self, file: IO[str], total: int, failed: int, report: Callable[[Event], None] | None) -> None:
        self._file, self._total, self._report = file, total, report
        self._counts = Counter({FAILED: failed, SKIPPED: failed})
        self._start = time.monotonic()

    def say(self, kind: str, name: str = "", about: Report | None = None) -> None:
        """Tell of an event, and of the pair's report if it is about a pair."""
        if about is not None:
            self._counts[about.status] += 1
            self._counts[SKIPPED] += kind == SKIPPED
        event = Event(
            kind,
            name,
            about.sentence if about else "",
            about.seconds if about else 0.0,
            self._counts[DONE],
            self._counts[FAILED],
            self._total,
            self._counts[SKIPPED],
            time.monotonic() - self._start,
        )
        self._file.write(json.dumps({"time": time.time(), **asdict(event)}) + "\n")
        self._file.flush()
        if self._report is not None:
            self._report(event)


@contextmanager
def _events(out: Path, total: int, failed: int, report: Callable[[Event], None] | None) -> Iterator[_EventLog]:
    with (out / EVENTS).open("a", encoding="utf-8") as file:
        log = _EventLog(file, total, failed, report)
        log.say(BEGIN)
        yield log


class _State:
    """What is known of the pairs in this run."""

    def __init__(self, out: Path, journal: Journal, log: _EventLog) -> None:
        self.out, self.known = out, dict[str, Report]()
        self._journal, self._book = journal, log

    def settled(self, job: Job, retry_failed: bool) -> bool:
        """Return whether a pair need not run, and take its report over if so."""
        record = self._journal.records.get(job.name)
        if record is None or (record.report.status == FAILED and retry_failed):
            return False
        if record.key != self._journal.fingerprint(job) or not _in_place(job, record.report):
            return False
        self.known[job.name] = record.report
        self._book.say(SKIPPED, job.name, record.report)
        return True

    def key(self, job: Job) -> str:
        """Return the print of a job."""
        return self._journal.fingerprint(job)

    def settle(self, job: Job, key: str, report: Report) -> None:
        """Write down what became of a pair."""
        former = self._journal.records.get(job.name)
        if report.status == FAILED and former is not None:
            _remove(job, former.report)
        self._journal.record(Record(job.name, key, report))
        self.known[job.name] = report
        self._book.say(report.status, job.name, report)


def _register_all(jobs: Sequence[Job], engine: Engine, state: _State) -> None:
    """Keep the engine busy until every job has a report."""
    waiting, running = iter(jobs), dict[Future[Report], tuple[Job, str]]()
    try:
        while _fill(running, waiting, engine, state):
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, key = running[future]
                state.settle(job, key, _report(future))
                del running[future]
    finally:  # Ctrl-C may come between the end of a pair and its entry
        for future, (job, key) in running.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                state.settle(job, key, future.result())


def _fill(
    running: dict[Future[Report], tuple[Job, str]], waiting: Iterator[Job], engine: Engine, state: _State
) -> bool:
    """Hand jobs over until the engine has enough; return whether it has any."""
    while len(running) < engine.window and (job := next(waiting, None)) is not None:
        key = state.key(job)
        running[engine.submit(Task(job, log_of(state.out, job.name)))] = (job, key)
    return bool(running)


def _report(future: Future[Report]) -> Report:
    """Return what became of a task, a lost process being a report too."""
    try:
        return future.result()
    except EngineError:
        raise
    except CancelledError as error:
        raise ComputationError("the connection to the cluster was lost; run the same command again to go on") from error
    except Exception as error:  # noqa: BLE001 - whatever ended the task costs this pair only
        return Report(FAILED, explain(error)[0])


def _open(engine: EngineSettings, jobs: Sequence[Job], out: Path) -> AbstractContextManager[Engine]:
    if engine.kind == "dask":
        from torchdeform.cohort.executors.dask import open_dask

        return open_dask(engine, jobs, log_of(out, "").parent / "workers")
    from torchdeform.cohort.executors.local import open_local

    return open_local(engine, jobs)


def _in_place(job: Job, report: Report) -> bool:
    """Return whether all results of a pair that is done are still there."""
    return report.status != DONE or all(path.is_file() for path in _results(job, report))


def _results(job: Job, report: Report) -> list[Path]:
    named = [job.files.out / name for name in report.files if Path(name).name == name]
    return named if job.submission is None else [*named, job.submission]


def _remove(job: Job, report: Report) -> None:
    """Remove the results of an earlier run, so that nobody takes them for those of a pair that failed since."""
    for path in _results(job, report):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # other files are in it
        job.files.out.rmdir()


def _clean(jobs: Iterable[Job], out: Path) -> None:
    """Remove what processes that were killed had begun to write."""
    own = {job.files.out for job in jobs}
    above = {folder for place in own for folder in place.parents if folder.is_relative_to(out)}
    for folder in own | above:
        for rest in folder.glob(_TEMPORARY_FOLDERS):
            shutil.rmtree(rest, ignore_errors=True)
