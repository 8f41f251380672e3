"""Streams that are closed, full or read by nobody do not stop the work; signals stop every verb in order."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from cohort_runs import write_cohort

from torchdeform.cli.main import main, torchdeform

PROGRAM = "import sys; from torchdeform.cli.start import register; sys.exit(register())"
PAIR = "fixed.png moving.png --preset fast --align none --report none --out out"


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    write_cohort(tmp_path, "ab")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """Run a line of bash in which ``register`` is the program."""
    program = f"register() {{ '{sys.executable}' -c '{PROGRAM}' \"$@\"; }}; set -o pipefail; "
    return subprocess.run(["bash", "-c", program + line], capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.parametrize(
    "how", ["| true", "2>&1 | true", "<&- >&- 2>&-", ">&- 2>&-", "2>/dev/full", "2>&1 | head -c 3", "1</dev/null"]
)
def test_the_work_is_done_whoever_reads(folder, how):
    ran = shell(f"register {PAIR} {how}")
    assert ran.returncode == 0, ran.stderr
    assert "Traceback" not in ran.stderr
    assert (folder / "out" / "result.json").is_file()
    found = {path.name for path in (folder / "out").iterdir()}
    assert {"displacement.nii.gz", "inverse.h5", "transform.h5", "warped.png"} < found
    assert all(path.stat().st_size > 100 for path in (folder / "out").iterdir())


def test_a_file_of_standard_output_that_is_not_whole_is_an_error(folder):
    ran = shell("ulimit -f 0; exec 3>&2; register --help > text")
    assert ran.returncode == 1
    assert "standard output cannot be written: File too large" in ran.stderr


STOPS = [signal.SIGTERM, signal.SIGHUP, signal.SIGINT]


def _stop_in(monkeypatch: pytest.MonkeyPatch, where: str, which: int) -> None:
    monkeypatch.setattr(where, lambda *_, **__: os.kill(os.getpid(), which))


@pytest.mark.parametrize("which", STOPS)
def test_register_is_stopped_in_order(folder, monkeypatch, capsys, which):
    before = {path.name for path in folder.iterdir()}
    _stop_in(monkeypatch, "torchdeform.pipeline.register.write_transform", which)
    assert main(PAIR.split()) == 130
    said = capsys.readouterr().err
    assert said.splitlines() == [said.strip()]
    assert said.startswith("register: stopped; what is finished is kept and nothing is half-written")
    assert {path.name for path in folder.iterdir()} == before


@pytest.mark.parametrize("which", STOPS)
@pytest.mark.parametrize(
    ("line", "where"),
    [
        ("grid fixed.png --out out", "torchdeform.pipeline.deformation.write_displacement"),
        ("apply out/transform.h5 moving.png --reference fixed.png --out w.png", "torchdeform.io.itk.no_warnings"),
        ("check fixed.png moving.png --out check.png", "torchdeform.cli.check.atomic_file"),
    ],
)
def test_every_verb_is_stopped_in_order(folder, monkeypatch, capsys, line, where, which):
    if "transform.h5" in line:
        assert main(PAIR.split()) == 0
    before = {path.name for path in folder.iterdir()}
    _stop_in(monkeypatch, where, which)
    capsys.readouterr()
    assert torchdeform(line.split()) == 130
    assert "stopped; what is finished is kept" in capsys.readouterr().err
    assert {path.name for path in folder.iterdir()} == before


def test_a_signal_that_is_ignored_stays_ignored(folder, monkeypatch):
    """As under nohup."""
    from torchdeform.pipeline import register

    write = register.write_transform

    def hang_up(*arguments: object) -> None:
        os.kill(os.getpid(), signal.SIGHUP)
        write(*arguments)

    monkeypatch.setattr(register, "write_transform", hang_up)
    earlier = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert main(PAIR.split()) == 0
    finally:
        signal.signal(signal.SIGHUP, earlier)


def test_signals_are_as_before_afterwards(folder):
    before = [signal.getsignal(one) for one in STOPS]
    main(["--version"])
    assert [signal.getsignal(one) for one in STOPS] == before
