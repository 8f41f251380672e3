"""What a run of a cohort says on the way: a line a pair, failures always, and how long it will take."""

import pytest

from torchdeform.cli.progress import CohortProgress
from torchdeform.cohort.run import Event

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


def test_a_terminal_gets_a_bar_with_counts_and_rate(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # makes rich believe in a terminal
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    with CohortProgress() as progress:
        for event in EVENTS[:4]:
            progress.show(event)
        progress._progress.refresh()
    err = capsys.readouterr().err
    assert "c failed" in err
    assert "3/4, 1 failed, 40.0 per min" in err
