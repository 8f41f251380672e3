"""The command: killed or stopped at any moment, it goes on where it was; its exit code tells how it went."""

import csv
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchdeform.cli.main import torchdeform
from torchdeform.io import write_image

COHORT = """\
out: out
pairs: {{list: [{pairs}]}}
preset: fast
settings: {{align: none, similarity: ssd, length: 8, steps: [2]}}
device: cpu
engine: {{workers: 2, threads: 1}}
"""


@pytest.fixture
def cohort(tmp_path, make_image) -> Path:
    """A cohort file with six pairs of small images, each with the same two."""
    for name, shift in (("fixed", 0.0), ("moving", 3.0)):
        write_image(make_image((16, 16), origin=(shift, 0.0), pixel_type="uint8"), tmp_path / f"{name}.png")
    return write(tmp_path, "abcdef")


def write(folder: Path, names: str, moving: str = "moving.png") -> Path:
    path = folder / "cohort.yaml"
    pairs = ", ".join(f"{{name: {name}, fixed: fixed.png, moving: {moving}}}" for name in names)
    path.write_text(COHORT.format(pairs=pairs), encoding="utf-8")
    return path


def start(cohort: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "torchdeform.cli.main", "batch", str(cohort)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def done(cohort: Path) -> list[str]:
    """Names in the journal, as often as they are there."""
    journal = cohort.parent / "out" / "journal.jsonl"
    lines = journal.read_text(encoding="utf-8").splitlines() if journal.exists() else []
    found = []
    for line in lines:
        try:
            found.append(json.loads(line).get("pair"))
        except ValueError:
            continue
    return [name for name in found if name]


def wait_for(cohort: Path, count: int, process: subprocess.Popen[str]) -> None:
    while len(done(cohort)) < count and process.poll() is None:
        time.sleep(0.02)


def summary(cohort: Path) -> dict[str, str]:
    with (cohort.parent / "out" / "summary.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["name"] for row in rows}) == len(rows)
    return {row["name"]: row["status"] for row in rows}


@pytest.mark.slow
def test_killed_twice_then_resumed(cohort):
    for count in (1, 3):
        process = start(cohort)
        wait_for(cohort, count, process)
        process.kill()
        process.communicate()
    before = done(cohort)
    process = start(cohort)
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "left as an earlier run settled them" in errors
    assert sorted(done(cohort)) == list("abcdef")
    assert set(before) <= set("abcdef")
    assert summary(cohort) == dict.fromkeys("abcdef", "done")
    out = cohort.parent / "out"
    assert not list(out.rglob(".torchdeform-*"))
    warped = {(out / name / "displacement.nii.gz").read_bytes() for name in "abcdef"}
    assert len(warped) == 1


@pytest.mark.parametrize("which", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_stopped_cleanly(cohort, which):
    process = start(cohort)
    wait_for(cohort, 1, process)
    process.send_signal(which)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    assert "run the same command again" in errors
    assert "Traceback" not in errors
    found = summary(cohort)
    assert found.keys() == set("abcdef")
    assert set(done(cohort)) == {name for name, status in found.items() if status == "done"}
    assert not list((cohort.parent / "out").rglob(".torchdeform-*"))


def test_exit_codes_and_only(cohort, capsys):
    write(cohort.parent, "abc", "text.png")
    (cohort.parent / "text.png").write_text("no image", encoding="ascii")
    assert torchdeform(["batch", str(cohort), "--only", "b"]) == 1
    assert summary(cohort) == {"a": "waiting", "b": "failed", "c": "waiting"}
    said = capsys.readouterr()
    assert "b failed: " in said.err
    assert "text.png" in said.err
    assert "failures.csv" in said.out
    write(cohort.parent, "abc")
    assert torchdeform(["batch", str(cohort), "--only", "a", "--quiet"]) == 0
    assert summary(cohort) == {"a": "done", "b": "failed", "c": "waiting"}
    assert capsys.readouterr().out == ""
    assert (cohort.parent / "out" / "dataset_description.json").is_file()
