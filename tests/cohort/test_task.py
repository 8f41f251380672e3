"""One pair in its process: what it says goes to its log, and a failure is a report like any other."""

import errno
import sys
from collections.abc import Callable
from dataclasses import replace

import pytest

from torchdeform.cohort import task as module
from torchdeform.cohort.task import DONE, FAILED, PairReport, Task, perform
from torchdeform.errors import MachineError


@pytest.fixture
def do(monkeypatch, capfd) -> Callable[[Task], PairReport]:
    """`perform` as in a process of its own: streams end in the descriptors 1 and 2; crashes stay with the tests."""

    def perform_here(task: Task) -> PairReport:
        for descriptor, name in ((1, "stdout"), (2, "stderr")):
            stream = open(descriptor, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
            monkeypatch.setattr(sys, name, stream)
        for name in ("enable", "disable"):
            monkeypatch.setattr(module.faulthandler, name, lambda *_: None)
        return perform(task)

    return perform_here


def test_a_pair_that_is_done_has_its_figures(do, jobs, tmp_path, capfd):
    report = do(Task(jobs[0], tmp_path / "logs" / "a.log"))
    assert (report.status, report.sentence) == (DONE, "")
    assert report.figures["folds"] == 0
    assert report.figures["similarity_after"] >= report.figures["similarity_before"]
    assert report.figures["verdict"] in ("good", "look")
    assert report.figures["headline"]
    assert set(report.files) == {path.name for path in jobs[0].files.out.iterdir()}
    assert report.seconds > 0
    assert report.peak_memory > 0
    assert capfd.readouterr() == ("", "")
    log = (tmp_path / "logs" / "a.log").read_text(encoding="utf-8")
    assert str(jobs[0].files.fixed) in log
    assert log.rstrip().endswith(DONE)


def test_a_pair_that_fails_says_why(do, jobs, tmp_path, capfd):
    missing = replace(jobs[0], files=replace(jobs[0].files, moving=tmp_path / "nothing.png"))
    report = do(Task(missing, tmp_path / "a.log"))
    assert report.status == FAILED
    assert "nothing.png does not exist" in report.sentence
    assert report.figures == {}
    assert capfd.readouterr() == ("", "")
    log = (tmp_path / "a.log").read_text(encoding="utf-8")
    assert report.sentence in log
    assert "Traceback" not in log


def test_an_error_that_nobody_foresaw_leaves_its_traceback_in_the_log(do, jobs, tmp_path, monkeypatch):
    def fail(job: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(module, "register_job", fail)
    assert "ZeroDivisionError" in do(Task(jobs[0], tmp_path / "a.log")).sentence
    assert "Traceback" in (tmp_path / "a.log").read_text(encoding="utf-8")


def test_a_failure_of_the_machine_is_no_report_about_the_pair(do, jobs, tmp_path, monkeypatch):
    def fail(job: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/out/a")

    monkeypatch.setattr(module, "register_job", fail)
    with pytest.raises(MachineError, match="/out/a: No space left on device"):
        do(Task(jobs[0], tmp_path / "a.log"))
    monkeypatch.setattr(module, "_log_job", lambda _: fail(None))
    with pytest.raises(MachineError):
        do(Task(jobs[0], tmp_path / "b.log"))
