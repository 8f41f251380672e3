"""What changes under a run: its folder, its results, its inputs, its journal, another run, and the clock."""

import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cohort_runs import done, faults, finish, journal, start, summary, write_cohort

from torchdeform.cli.main import torchdeform
from torchdeform.cohort.task import Task

Meanwhile = Callable[[str, Callable[[Task], None]], None]


@pytest.fixture
def cohort(tmp_path) -> Path:
    return write_cohort(tmp_path, "abcd")


def run(cohort: Path) -> int:
    return torchdeform(["batch", str(cohort)])


@pytest.mark.parametrize("what", ["out", "pair"])
def test_results_that_vanish_during_the_run_are_an_error(cohort, feigned, capsys, what):
    def vanish(task: Task) -> None:
        out = task.job.files.out.parent
        shutil.rmtree(out if what == "out" else out / "a")

    feigned["c"] = vanish
    assert run(cohort) == 1
    said = capsys.readouterr()
    assert "while the run was working" in said.err
    assert "4 done" not in said.out
    feigned.clear()
    assert run(cohort) == 0
    assert summary(cohort) == dict.fromkeys("abcd", "done")
    assert all((cohort.parent / "out" / name / "result.json").is_file() for name in "abcd")


def test_results_that_vanish_between_two_runs_are_made_again(cohort, feigned, capsys):
    assert run(cohort) == 0
    shutil.rmtree(cohort.parent / "out" / "b")
    assert run(cohort) == 0
    assert "3 already done (skipped)" in capsys.readouterr().err
    assert (cohort.parent / "out" / "b" / "result.json").is_file()


def test_an_input_that_changes_while_its_pair_runs_settles_nothing(cohort, feigned, capsys):
    def change(task: Task) -> None:
        status = task.job.files.moving.stat()
        task.job.files.moving.write_bytes(task.job.files.moving.read_bytes()[::-1])
        os.utime(task.job.files.moving, ns=(status.st_atime_ns, status.st_mtime_ns))

    feigned["d"] = change
    assert run(cohort) == 1
    assert "d failed: its files changed while it was registered; run the same command again" in capsys.readouterr().err
    assert not (cohort.parent / "out" / "d").exists()
    feigned.clear()
    assert run(cohort) == 0  # all have the same moving image, so all are run again
    assert [line["status"] for line in journal(cohort)][-4:] == ["done"] * 4


def test_a_clock_that_goes_back_does_not_matter(cohort, feigned, monkeypatch, capsys):
    """Dates in the future and in the past, of files and of the machine; what counts is content."""
    assert run(cohort) == 0
    now = time.time()
    for offset in (-1e8, 1e8):
        with monkeypatch.context() as patch:
            patch.setattr("time.time", lambda offset=offset: now + offset)
            patch.setattr("torchdeform.cohort.journal.time_ns", lambda offset=offset: int((now + offset) * 1e9))
            capsys.readouterr()
            assert run(cohort) == 0
            assert "4 already done (skipped)" in capsys.readouterr().err
            moving = cohort.parent / "moving.png"
            status = moving.stat()
            moving.write_bytes(moving.read_bytes() + b"x")
            os.utime(moving, ns=(status.st_atime_ns, status.st_mtime_ns))
            assert run(cohort) == 0
            assert "already done" not in capsys.readouterr().err


def test_a_journal_that_somebody_edited_costs_what_was_edited(cohort, feigned, capsys):
    assert run(cohort) == 0
    path = cohort.parent / "out" / "journal.jsonl"
    first, second, third, fourth = map(json.loads, path.read_text(encoding="utf-8").splitlines())
    lines = [
        json.dumps(first | {"status": "perhaps"}),
        json.dumps(second | {"files": ["../../../etc/passwd", "thesis.docx"]}),
        json.dumps(third)[:-5],
        json.dumps(fourth),
        "\0" * 100,
        json.dumps(fourth),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(cohort) == 0
    said = capsys.readouterr().err
    assert said.count("make no sense and are skipped") == 1
    assert "warning: 3 lines of" in said
    assert summary(cohort) == dict.fromkeys("abcd", "done")


def test_only_results_are_removed(cohort, feigned):
    """A journal that names other files deletes none of them."""
    assert run(cohort) == 0
    out = cohort.parent / "out"
    (out / "a" / "thesis.docx").touch()
    text = (
        (out / "journal.jsonl").read_text(encoding="utf-8").replace('["result.json"]', '["result.json", "thesis.docx"]')
    )
    (out / "journal.jsonl").write_text(text, encoding="utf-8")

    def fail(_: Task) -> None:
        raise ValueError("no good")

    feigned["a"] = fail
    assert torchdeform(["batch", str(cohort), "--no-resume"]) == 1
    assert [path.name for path in (out / "a").iterdir()] == ["thesis.docx"]


def test_two_runs_at_once_are_refused_and_the_first_goes_on(cohort, feigned):
    said: list[tuple[int, str, str]] = []
    feigned["b"] = lambda _: said.append(finish(cohort))
    assert run(cohort) == 0
    ((code, _, errors),) = said
    assert code == 2
    assert "another run is working in" in errors
    assert sorted(done(cohort)) == list("abcd")
    assert summary(cohort) == dict.fromkeys("abcd", "done")


def test_nobody_needs_to_read_what_is_said(cohort):
    process = start(cohort)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    process.stderr.close()
    assert process.wait(300) == 0
    assert faults(cohort, "abcd") == []
    assert len(done(cohort)) == 4
