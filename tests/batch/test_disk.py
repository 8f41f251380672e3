"""A full disk stops a run, settles nothing, and the same command goes on when there is space."""

import errno
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cohort_runs import done, faults, finish, journal, summary, write_cohort

from torchdeform.cli.main import main, torchdeform

NAMES = "abcdef"


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of four megabytes, where the tests may mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", place], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no file systems can be mounted here")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


def fill(place: Path, leave: int) -> Path:
    """Fill a file system but for some bytes; return the file that does."""
    filler = place / "filler"
    filler.write_bytes(b"")
    filler.write_bytes(bytes(os.statvfs(place).f_bavail * os.statvfs(place).f_frsize - leave))
    return filler


def test_a_cohort_stops_settles_nothing_and_goes_on(small_disk):
    cohort = write_cohort(small_disk, NAMES, size=48)
    filler = fill(small_disk, 1_500_000)
    code, _, said = finish(cohort)
    assert (code, said.count("No space left on device")) == (1, 1), said
    assert "Traceback" not in said
    assert "are free, which is not enough; make room and run the same command again for the" in said
    before = done(cohort)
    assert 0 < len(before) < len(NAMES)
    assert not list(small_disk.rglob(".torchdeform-*"))
    filler.unlink()
    code, _, said = finish(cohort)
    assert code == 0, said
    assert f"{len(before)} already done (skipped)" in said
    assert faults(cohort, NAMES) == []


@pytest.mark.parametrize("free", [0, 8192])
def test_a_disk_without_any_room_stops_it_before_the_first_pair(small_disk, capsys, free):
    cohort = write_cohort(small_disk, NAMES)
    filler = fill(small_disk, free)
    assert torchdeform(["batch", str(cohort)]) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert done(cohort) == []
    filler.unlink()
    assert torchdeform(["batch", str(cohort), "--only", "a"]) == 0
    assert summary(cohort)["a"] == "done"


def test_one_pair_leaves_nothing_on_a_full_disk(small_disk, capsys, monkeypatch):
    write_cohort(small_disk, "a", size=200)
    monkeypatch.chdir(small_disk)
    filler = fill(small_disk, 100_000)
    assert main(["fixed.png", "moving.png", "--preset", "fast", "--out", "out"]) == 1
    said = capsys.readouterr().err
    assert "cannot write to out: No space left on device" in said
    assert "make room and run the same command again" in said
    assert sorted(path.name for path in small_disk.iterdir()) == ["cohort.yaml", "filler", "fixed.png", "moving.png"]
    filler.unlink()
    assert main(["fixed.png", "moving.png", "--preset", "fast", "--out", "out"]) == 0


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE])
@pytest.mark.parametrize("where", ["journal", "events", "summary"])
def test_whatever_cannot_be_written_stops_the_run(tmp_path, feigned, monkeypatch, capsys, number, where):
    cohort, written = write_cohort(tmp_path, "ab"), [0]

    def broken(*_: object, **__: object) -> None:
        written[0] += 1
        if written[0] > (1 if where == "events" else 0):
            raise OSError(number, os.strerror(number))

    place = {"journal": "journal.append", "events": "run._EventLog.write", "summary": "run.summarise"}[where]
    with monkeypatch.context() as patch:
        patch.setattr(f"torchdeform.cohort.{place}", broken)
        assert torchdeform(["batch", str(cohort)]) == 1
    said = capsys.readouterr().err
    assert os.strerror(number) in said
    assert "run the same command again" in said
    assert all(line["status"] == "done" for line in journal(cohort))
    assert torchdeform(["batch", str(cohort)]) == 0
    assert sorted(set(done(cohort))) == ["a", "b"]
