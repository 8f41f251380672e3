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
from torchdeform.cohort.schema import cohort_schema, read_cohort
from torchdeform.io import write_image
from torchdeform.pipeline.config import load_settings

COHORT = """\
out: out
pairs: {{list: [{pairs}]}}
preset: fast
settings: {{align: none, similarity: ssd, metric: {{length_scale: 8}}, optimiser: {{steps: [2]}}}}
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
    assert "already done (skipped)" in errors
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


def test_schema_goes_to_standard_output(capsys):
    assert torchdeform(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == cohort_schema()


_PATTERN = "pairs: {pattern: {files: 'sub-{subject}_ses-{session}.png', pairing: consecutive, within: [subject]}}\n"


_IMAGES = [f"sub-{subject}_ses-{session}.png" for subject in ("a", "b") for session in (1, 2)]


def _file(tmp_path, text):
    (tmp_path / "cohort.yaml").write_text(f"out: results\n{text}", encoding="utf-8")
    return str(tmp_path / "cohort.yaml")


def test_dry_run_shows_pairs_problems_and_costs_and_writes_nothing(make_image, tmp_path, capsys):
    for name in ("a", "b"):
        write_image(make_image((32, 32)), tmp_path / f"{name}.nii.gz")
    pairs = "{fixed: a.nii.gz, moving: b.nii.gz}, {name: lost, fixed: a.nii.gz, moving: no.nii.gz}"
    before = set(tmp_path.iterdir()) | {tmp_path / "cohort.yaml"}
    assert torchdeform(["batch", _file(tmp_path, f"pairs: {{list: [{pairs}]}}\n"), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert f"from-b_to-a: {tmp_path / 'b.nii.gz'} -> {tmp_path / 'a.nii.gz'}" in shown
    assert f"cannot run: lost: moving {tmp_path / 'no.nii.gz'} does not exist" in shown
    assert "1 to register, 1 cannot run" in shown
    assert "memory" in shown
    assert set(tmp_path.iterdir()) == before


def test_print_config_is_a_file_that_can_be_read(tmp_path, capsys):
    path = _file(tmp_path, "pairs: {list: [{fixed: a.png, moving: b.png}]}\n")
    assert torchdeform(["batch", path, "--print-config"]) == 0
    (tmp_path / "printed.yaml").write_text(capsys.readouterr().out, encoding="utf-8")
    printed = read_cohort(tmp_path / "printed.yaml")
    assert printed.pairs == read_cohort(Path(path)).pairs
    assert printed.resolve() == load_settings()


def test_only_and_mistakes_at_the_shell(tmp_path, capsys):
    for name in _IMAGES:
        (tmp_path / name).touch()
    path = _file(tmp_path, _PATTERN)
    assert torchdeform(["batch", path, "--dry-run", "--only", "sub-a"]) == 0
    assert "1 to register" in capsys.readouterr().out
    assert torchdeform(["batch", path, "--dry-run", "--only", "sub-x"]) == 2
    assert "no pair is called 'sub-x'" in capsys.readouterr().err
    assert torchdeform(["batch", _file(tmp_path, "otu: x\n")]) == 2
    assert "cohort.yaml line 2: there is no key 'otu'; did you mean 'out'?" in capsys.readouterr().err
