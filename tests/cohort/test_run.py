"""The run: every pair once, what is done left alone, whatever goes wrong written down; the work itself is feigned."""

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from nested_settings import changed

from torchdeform.cohort.executors.local import Engine
from torchdeform.cohort.journal import Journal
from torchdeform.cohort.plan import Failure, Job
from torchdeform.cohort.run import Event, review, run
from torchdeform.cohort.settings import EngineSettings
from torchdeform.cohort.task import DONE, FAILED, PairReport, Task
from torchdeform.core.worker import EngineError, TimeLimit, WorkerLost
from torchdeform.errors import ComputationError, InputError
from torchdeform.pipeline.register import PairFiles
from torchdeform.registration.settings import RegistrationSettings

Work = Callable[[Task], PairReport]


class Feigned:
    """An engine of one thread that does as it is told, pair by pair, and keeps count."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ran: list[str] = []
        self.special: dict[str, Work] = {}
        monkeypatch.setattr("torchdeform.cohort.run._open", self._open)

    @contextmanager
    def _open(self, settings: EngineSettings, jobs: Sequence[Job], out: Path) -> Iterator[Engine]:
        with ThreadPoolExecutor(1) as pool:
            yield Engine(lambda job: pool, 2, self.work)

    def work(self, task: Task) -> PairReport:
        self.ran.append(task.job.name)
        return self.special.get(task.job.name, succeed)(task)


def succeed(task: Task) -> PairReport:
    task.job.files.out.mkdir(parents=True, exist_ok=True)
    (task.job.files.out / "warped.png").write_text(str(task.job.settings.similarity.window), encoding="ascii")
    return PairReport(DONE, seconds=0.1, figures={"folds": 0}, files=("warped.png",))


def fail(task: Task) -> PairReport:
    return PairReport(FAILED, "no good")


def raising(error: BaseException) -> Work:
    def work(task: Task) -> PairReport:
        raise error

    return work


@pytest.fixture
def engine(monkeypatch) -> Feigned:
    return Feigned(monkeypatch)


@pytest.fixture
def jobs(tmp_path) -> list[Job]:
    """Five pairs of files."""
    found = []
    for name in "abcde":
        paths = [tmp_path / f"{name}{side}.png" for side in "fm"]
        for path in paths:
            path.write_text(path.name, encoding="ascii")
        files = PairFiles(fixed=paths[0], moving=paths[1], out=tmp_path / "out" / "sub" / name)
        found.append(Job(name=name, files=files, settings=RegistrationSettings()))
    return found


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "out"


def statuses(out: Path) -> dict[str, str]:
    with (out / "summary.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["name"] for row in rows}) == len(rows)
    return {row["name"]: row["status"] for row in rows}


def test_all_pairs_are_done_once(engine, jobs, out):
    summary = run(jobs, out, EngineSettings())
    assert (summary.done, summary.failed, summary.waiting) == (5, 0, 0)
    assert engine.ran == list("abcde")
    assert statuses(out) == dict.fromkeys("abcde", "done")


def test_what_is_done_is_left_alone(engine, jobs, out):
    run(jobs, out, EngineSettings())
    engine.ran.clear()
    assert run(jobs, out, EngineSettings()).done == 5
    assert engine.ran == []


def test_what_changed_is_done_again(engine, jobs, out):
    run(jobs, out, EngineSettings())
    engine.ran.clear()
    jobs[1].files.moving.write_text("another", encoding="ascii")
    jobs[2] = replace(jobs[2], settings=changed(jobs[2].settings, window=7))
    (jobs[3].files.out / "warped.png").unlink()
    assert run(jobs, out, EngineSettings()).done == 5
    assert engine.ran == ["b", "c", "d"]
    assert (jobs[2].files.out / "warped.png").read_text(encoding="ascii") == "7"


def test_without_resume_all_is_done_again(engine, jobs, out):
    run(jobs, out, EngineSettings())
    engine.ran.clear()
    run(jobs, out, EngineSettings(), resume=False)
    assert engine.ran == list("abcde")


def test_what_failed_is_retried_only_when_asked_or_changed(engine, jobs, out):
    engine.special = {"b": fail, "c": fail}
    assert [failure.name for failure in run(jobs, out, EngineSettings()).failures] == ["b", "c"]
    engine.special, engine.ran[:] = {}, []
    jobs[2].files.fixed.write_text("mended", encoding="ascii")
    assert [failure.sentence for failure in run(jobs, out, EngineSettings()).failures] == ["no good"]
    assert engine.ran == ["c"]
    assert run(jobs, out, EngineSettings(), retry_failed=True).done == 5
    assert engine.ran == ["c", "b"]


@pytest.mark.parametrize("error", [WorkerLost("it was killed"), TimeLimit("it took too long"), RuntimeError("what")])
def test_a_lost_process_costs_its_pair_only(engine, jobs, out, error):
    engine.special = {"b": raising(error)}
    summary = run(jobs, out, EngineSettings())
    assert (summary.done, [failure.name for failure in summary.failures]) == (4, ["b"])
    assert str(error) in summary.failures[0].sentence


def test_a_pair_that_fails_leaves_no_results_of_before(engine, jobs, out):
    run(jobs, out, EngineSettings())
    (jobs[0].files.out / "notes.txt").touch()
    engine.special = {"a": fail, "b": fail}
    run(jobs, out, EngineSettings(), resume=False)
    assert [path.name for path in jobs[0].files.out.iterdir()] == ["notes.txt"]
    assert not jobs[1].files.out.exists()


def test_pairs_that_cannot_run_are_in_the_summary(engine, jobs, out):
    summary = run(jobs, out, EngineSettings(), problems=[Failure("f", "there is no such file")])
    assert statuses(out)["f"] == "failed"
    assert (summary.done, summary.failed) == (5, 1)


def test_nothing_is_lost_when_it_is_stopped(engine, jobs, out):
    def stop(event: Event) -> None:
        if event.name == "b":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(jobs, out, EngineSettings(), report=stop)
    found = statuses(out)
    assert (found["a"], found["b"], found["e"]) == ("done", "done", "waiting")
    engine.ran.clear()
    assert run(jobs, out, EngineSettings()).done == 5
    assert set(engine.ran) == {name for name, status in found.items() if status == "waiting"}


def test_an_engine_that_does_not_run_stops_the_run(engine, jobs, out):
    engine.special = {"b": raising(EngineError("no process starts"))}
    with pytest.raises(EngineError, match="no process"):
        run(jobs, out, EngineSettings())
    assert statuses(out)["a"] == "done"
    assert statuses(out)["b"] == "waiting"


def test_a_lost_cluster_stops_the_run(monkeypatch, jobs, out):
    class Lost(Executor):
        def submit(self, fn, /, *args, **kwargs):
            future: Future[PairReport] = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    @contextmanager
    def opened(*_):
        yield Engine(lambda job: Lost(), 2)

    monkeypatch.setattr("torchdeform.cohort.run._open", opened)
    with pytest.raises(ComputationError, match="connection to the cluster was lost"):
        run(jobs, out, EngineSettings())
    assert set(statuses(out).values()) == {"waiting"}


def test_events_tell_the_whole_story(engine, jobs, out):
    engine.special = {"c": fail}
    seen: list[Event] = []
    run(jobs, out, EngineSettings(), problems=[Failure("f", "missing")], report=seen.append)
    assert [event.kind for event in seen] == ["begin", "done", "done", "failed", "done", "done", "end"]
    assert (seen[-1].done, seen[-1].failed, seen[-1].total, seen[-1].skipped) == (4, 2, 6, 1)
    assert seen[0].left is None
    assert seen[-1].left == 0
    lines = [json.loads(line) for line in (out / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [line["kind"] for line in lines] == [event.kind for event in seen]
    assert lines[3] | {"time": 0} == lines[3] | {"time": 0, "name": "c", "sentence": "no good"}


def test_skipped_pairs_do_not_count_for_the_rate(engine, jobs, out):
    run(jobs[:3], out, EngineSettings())
    seen: list[Event] = []
    run(jobs, out, EngineSettings(), report=seen.append)
    assert [event.kind for event in seen] == ["begin", "skipped", "skipped", "skipped", "done", "done", "end"]
    assert seen[3].left is None
    assert seen[4].left == pytest.approx(seen[4].elapsed)


def test_rests_of_a_killed_run_are_removed(engine, jobs, out):
    rests = [folder / ".torchdeform-x" for folder in (out, out / "sub", jobs[0].files.out)]
    for rest in rests:
        rest.mkdir(parents=True)
        (rest / "half").touch()
    run(jobs, out, EngineSettings())
    assert not any(rest.exists() for rest in rests)


def test_two_pairs_of_one_name_are_refused(engine, jobs, out):
    with pytest.raises(InputError, match="2 pairs are called a"):
        run([*jobs, replace(jobs[0], name="A")], out, EngineSettings())
    assert not out.exists()


def test_a_review_shows_all_pairs_whatever_ran_last(engine, jobs, out):
    run(jobs[:2], out, EngineSettings())
    run(jobs[3:4], out, EngineSettings())
    assert statuses(out) == {"d": "done"}
    summary = review(jobs, out, [Failure("f", "missing")])
    assert (summary.done, summary.waiting, summary.failed) == (3, 2, 1)
    assert statuses(out) == {"a": "done", "b": "done", "c": "waiting", "d": "done", "e": "waiting", "f": "failed"}


def test_no_pairs_is_no_error(engine, out):
    assert run([], out, EngineSettings()).done == 0


def test_a_pair_is_written_down_before_it_is_told(engine, jobs, out):
    def check(event: Event) -> None:
        if event.kind == "done":
            lines = (out / "journal.jsonl").read_text(encoding="utf-8").splitlines()
            assert any(json.loads(line).get("pair") == event.name for line in lines)

    run(jobs, out, EngineSettings(), report=check)
    with Journal(out) as journal:
        assert journal.records.keys() == set("abcde")
