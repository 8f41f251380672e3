"""What a run of a cohort says on the way: a line a pair, failures always, and how long it will take."""

import time

import pytest
import torch

from torchdeform.cli.progress import CohortProgress, StepProgress
from torchdeform.cohort.run import Event
from torchdeform.core.stages import begin
from torchdeform.registration.result import Progress as Step

START = Event("begin", "", "", 0.0, 0, 0, 4, 1, 0.0)
EVENTS = [
    START,
    Event("skipped", "a", "", 0.0, 1, 0, 4, 1, 0.1),
    Event("done", "b", "", 1.5, 2, 0, 4, 1, 2.0),
    Event("failed", "c", "c.png is [broken]", 0.5, 2, 1, 4, 1, 3.0),
    Event("end", "", "", 0.0, 3, 1, 4, 1, 4.0),
]


@pytest.mark.parametrize("quiet", [False, True])
def test_every_pair_has_a_line_and_failures_are_always_told(capsys, quiet):
    with CohortProgress(quiet, "round") as progress:
        for event in EVENTS:
            progress.show(event)
    out, err = capsys.readouterr()
    assert out == ""
    assert "round 3/4: c failed: c.png is [broken]" in err
    assert ("round 2/4: b done in 1.5 s, 0:00:04 left" in err) == (not quiet)
    assert len(err.splitlines()) == (1 if quiet else 3)


@pytest.fixture
def terminal(monkeypatch):
    """Make rich believe in a terminal."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")


def test_a_terminal_gets_a_bar_with_counts_and_rate(terminal, capsys):
    with CohortProgress() as progress:
        for event in EVENTS[:4]:
            progress.show(event)
        progress._progress.refresh()
    err = capsys.readouterr().err
    assert "c failed" in err
    assert "3/4, 1 failed, 40.0 per min" in err


def test_every_stage_of_a_registration_has_its_name_and_the_bar_grows(terminal, capsys):
    steps = [Step(level, 3, step, 2, torch.tensor([0.5]), (30, 40)) for level in range(3) for step in (1, 2)]
    with StepProgress() as bar:
        seen = [_seen(bar)]
        for stage in ("reading", "aligning", *steps, "inverting", "judging", "writing", "drawing"):
            begin(stage) if isinstance(stage, str) else bar.show(stage)
            seen.append(_seen(bar))
            bar._progress.refresh()
    titles, shares = zip(*seen, strict=True)
    assert list(dict.fromkeys(titles)) == [
        "reading", "aligning", *(f"level {k}/3 30×40" for k in (1, 2, 3)), "inverting", "judging", "writing", "drawing"
    ]  # fmt: skip
    assert list(shares) == sorted(shares)
    assert shares[-1] < 1  # there is something to do until the end
    assert "level 2/3 30×40" in capsys.readouterr().err


def test_the_clock_runs_while_one_stage_computes(terminal, capsys):
    with StepProgress() as bar:
        begin("aligning")
        end = time.monotonic() + 1.5
        while time.monotonic() < end:  # computes, and never calls the bar
            torch.ones(300, 300) @ torch.ones(300, 300)
        assert bar._progress.tasks[0].elapsed > 1
    assert "0:00:01" in capsys.readouterr().err


def _seen(bar):
    task = bar._progress.tasks[0]
    return task.description, task.completed
