"""The run of a cohort: every pair once, finished pairs skipped, every outcome written to disk at once."""

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from torchdeform.cohort.executors.local import Answer, Engine
from torchdeform.cohort.journal import JOURNAL, Journal, Record, append, open_lines
from torchdeform.cohort.plan import SUBMISSION, Failure, Job
from torchdeform.cohort.settings import EngineSettings
from torchdeform.cohort.summary import Summary, log_of, summarise
from torchdeform.cohort.task import DONE, FAILED, PairReport, Task
from torchdeform.core.memory import readable
from torchdeform.core.worker import EngineError
from torchdeform.errors import ComputationError, InputError, MachineError, explain, of_machine
from torchdeform.io.files import disk_failure, remove_leftovers, size_of_files
from torchdeform.pipeline.register import is_result

EVENTS = "events.jsonl"
BEGIN, SKIPPED, END = "begin", "skipped", "end"

_CHANGED = "its files changed while it was registered; run the same command again when they stay as they are"


@dataclass(frozen=True)
class Event:
    """One event of a run.

    Attributes:
        kind: ``begin``, ``skipped`` (done before, or failed before and not retried), ``done``, ``failed`` or ``end``.
        name: of the pair, if it is about one.
        sentence: why it failed.
        seconds: time of the pair.
        done: number of pairs done so far, in this run or before.
        failed: number of pairs that failed so far, in this run or before, or cannot run.
        total: number of pairs of the cohort.
        skipped: number of pairs that need not run.
        elapsed: seconds since the start of the run.
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
        """Seconds until the end, estimated from the pairs of this run so far; None before the first."""
        ran = self.done + self.failed - self.skipped
        return self.elapsed / ran * (self.total - self.done - self.failed) if ran > 0 else None


def run(
    jobs: Sequence[Job],
    out: Path,
    engine: EngineSettings,
    *,
    problems: Iterable[Failure] = (),
    resume: bool = True,
    retry_failed: bool = False,
    report: Callable[[Event], None] | None = None,
) -> Summary:
    """Register all pairs of a cohort that are not done yet, and write its summary.

    Args:
        jobs: the pairs, each with its own name.
        out: folder of the cohort for the journal, events, logs and summary; `Job.files` has the folders of the pairs.
        engine: where the pairs run.
        problems: pairs that cannot run, for the summary.
        resume: skip pairs that an earlier run finished with the same files (by content), settings and version.
        retry_failed: also run pairs that failed then.
        report: is called with every event, in the thread of the caller.

    Returns:
        The outcome of the cohort. A pair that fails, hangs or kills its process is part of it, no error.

    Raises:
        InputError: two pairs with one name, the folder cannot be written, or another run is working there.
        MachineError: a disk is full, broken or gone. Nothing is settled for pairs that are not done.
        ComputationError: no pair can run at all, or the cluster is lost. Finished pairs are kept and the summary is
            written, as after Ctrl-C.

    Notes:
        If this process is killed, only the pairs that are running are lost.
    """
    problems = tuple(problems)
    _require_names([*jobs, *problems])
    total = len(jobs) + len(problems)
    with Journal(out) as journal, _EventLog(out, total, len(problems), report) as log:
        state = _State(out, journal, log)
        _say_skipped(journal, out)
        try:
            log.write(BEGIN)
            try:
                todo = [job for job in jobs if not (resume and state.is_finished(job, retry_failed))]
                _remove_leftovers(todo, out)
                if todo:
                    with _open(engine, todo, out) as where:
                        _register_all(todo, where, state)
                state.require_results(jobs)
            finally:
                journal.require_there()
                _remove_leftovers(jobs, out)
                summary = summarise(jobs, out, state.reports, problems)
            log.write(END)
        except Exception as error:
            if (failure := of_machine(error)) is not None:
                raise state.stopped_by(failure, jobs) from error
            raise
    return summary


def review(jobs: Sequence[Job], out: Path, problems: Iterable[Failure] = ()) -> Summary:
    """Write the summary of a cohort from its journal, without running any pair."""
    with Journal(out) as journal:
        known = {name: record.report for name, record in journal.records.items()}
        return summarise(jobs, out, known, problems)


def _say_skipped(journal: Journal, out: Path) -> None:
    if journal.skipped:
        text = (
            f"{journal.skipped} lines of {out / JOURNAL} make no sense and are skipped; pairs without a line run again"
        )
        sys.stderr.write(f"warning: {text}\n")


def _require_names(pairs: Sequence[Job | Failure]) -> None:
    names = Counter(pair.name.casefold() for pair in pairs)
    name, count = next(iter(names.most_common(1)), ("", 0))
    if count > 1:
        raise InputError(f"{count} pairs are called {name}; give each its own name")


class _EventLog:
    """Counts the events of a run, writes them to a file, and passes them on."""

    def __init__(self, out: Path, total: int, failed: int, report: Callable[[Event], None] | None) -> None:
        self._total, self._report = total, report
        self._counts = Counter({FAILED: failed, SKIPPED: failed})
        self._start = time.monotonic()
        self._file = open_lines(out / EVENTS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def write(self, kind: str, name: str = "", about: PairReport | None = None) -> None:
        """Write an event, with the report of the pair if it is about a pair."""
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
        append(self._file, {"time": time.time(), **asdict(event)})
        if self._report is not None:
            self._report(event)


class _State:
    """The reports of the pairs in this run, with the journal and the log where they are written."""

    def __init__(self, out: Path, journal: Journal, log: _EventLog) -> None:
        self.out, self.journal, self.reports = out, journal, dict[str, PairReport]()
        self._log = log

    def is_finished(self, job: Job, retry_failed: bool) -> bool:
        """Return whether a pair need not run; if so, take its report from the journal."""
        record = self.journal.records.get(job.name)
        if record is None or (record.report.status == FAILED and retry_failed):
            return False
        if record.key != self.journal.fingerprint(job) or not _results_exist(job, record.report):
            return False
        self.reports[job.name] = record.report
        self._log.write(SKIPPED, job.name, record.report)
        return True

    def record(self, job: Job, key: str, report: PairReport) -> None:
        """Write the outcome of a pair; it fails, and runs again, if its inputs are not those of its key any more."""
        if report.status == DONE and self.journal.fingerprint(job) != key:
            _remove_results(job, report)
            report = PairReport(FAILED, _CHANGED, report.seconds)
        earlier = self.journal.records.get(job.name)
        if report.status == FAILED and earlier is not None:
            _remove_results(job, earlier.report)
        self.journal.record(Record(job.name, key, report))
        self.reports[job.name] = report
        self._log.write(report.status, job.name, report)

    def require_results(self, jobs: Sequence[Job]) -> None:
        """Raise `MachineError` if results of pairs that are done are not there any more."""
        lost = [
            job.name for job in jobs if job.name in self.reports and not _results_exist(job, self.reports[job.name])
        ]
        for name in lost:
            del self.reports[name]
        if lost:
            raise MachineError(
                f"results of pairs that were done, such as {lost[0]}, were removed from {self.out} while the run was "
                "working; run the same command again"
            )

    def stopped_by(self, failure: OSError | MachineError, jobs: Sequence[Job]) -> MachineError:
        """Return the error of a run that a failure of the machine stops, with what is left and how much that takes."""
        done = [job for job in jobs if job.name in self.reports and self.reports[job.name].status == DONE]
        left = len(jobs) - len(self.reports)
        sizes = [size_of_files(_results(job, self.reports[job.name])) for job in done]
        needed = f", which take about {readable(left * sum(sizes) // len(sizes))}" if left and sizes else ""
        sentence = str(disk_failure(failure, self.out) if isinstance(failure, OSError) else failure)
        pairs = "pair" if left == 1 else f"{left} pairs"
        return MachineError(f"{sentence} for the {pairs} left{needed}" if left else sentence)


def _register_all(jobs: Sequence[Job], engine: Engine, state: _State) -> None:
    """Keep the engine busy until every job has a report."""
    waiting, running = iter(jobs), dict[Future[Answer], tuple[Job, str]]()
    try:
        while _fill(running, waiting, engine, state):
            finished = wait(running, return_when=FIRST_COMPLETED).done
            for future in [future for future in running if future in finished]:  # in the order of submission
                job, key = running[future]
                state.record(job, key, _report(future))
                del running[future]
    finally:  # Ctrl-C may come between the end of a pair and its line in the journal
        for future, (job, key) in running.items():
            if future.done() and not future.cancelled() and future.exception() is None:
                with suppress(Exception):  # an error about the process says nothing about the pair
                    state.record(job, key, _answer(future))


def _fill(
    running: dict[Future[Answer], tuple[Job, str]], waiting: Iterator[Job], engine: Engine, state: _State
) -> bool:
    """Submit jobs until the engine has enough; return whether any are running."""
    while len(running) < engine.window and (job := next(waiting, None)) is not None:
        key = state.journal.fingerprint(job)
        running[engine.submit(Task(job, log_of(state.out, job.name)))] = (job, key)
    return bool(running)


def _answer(future: Future[Answer]) -> PairReport:
    """Return the report of a task, or raise its error."""
    answer = future.result()
    if isinstance(answer, Exception):
        raise answer
    return answer


def _report(future: Future[Answer]) -> PairReport:
    """Return the report of a task; a lost process gives a report, too."""
    try:
        return _answer(future)
    except (EngineError, MachineError):
        raise
    except CancelledError as error:
        raise ComputationError(
            "the connection to the cluster was lost; run the same command again to continue"
        ) from error
    except Exception as error:  # noqa: BLE001 - whatever ended the task affects this pair only
        return PairReport(FAILED, explain(error)[0])


def _open(engine: EngineSettings, jobs: Sequence[Job], out: Path) -> AbstractContextManager[Engine]:
    if engine.kind == "dask":
        from torchdeform.cohort.executors.dask import open_dask

        return open_dask(engine, jobs, log_of(out, "").parent / "workers")
    from torchdeform.cohort.executors.local import open_local

    return open_local(engine, jobs)


def _results_exist(job: Job, report: PairReport) -> bool:
    """Return whether all results of a finished pair still exist."""
    return report.status != DONE or all(path.is_file() for path in _results(job, report))


def _results(job: Job, report: PairReport) -> list[Path]:
    named = [job.files.out / name for name in filter(is_result, report.files)]
    return named if job.submission is None else [*named, job.submission, *job.also]


def _remove_results(job: Job, report: PairReport) -> None:
    """Remove the results of an earlier run of a pair that has failed now, so that nobody uses them."""
    for path in _results(job, report):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # the folder has other files
        job.files.out.rmdir()


def _remove_leftovers(jobs: Iterable[Job], out: Path) -> None:
    """Remove the unfinished files of killed processes."""
    own = {job.files.out for job in jobs} | {out, out / SUBMISSION}
    above = {folder for place in own for folder in place.parents if folder.is_relative_to(out)}
    for folder in own | above:
        remove_leftovers(folder)
