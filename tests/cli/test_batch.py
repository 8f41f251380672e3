"""The command: stopped at any moment, it goes on where it was; its exit code tells how it went."""

import json
import signal
from pathlib import Path

import pytest
from cohort_runs import done, start, summary, wait_for, write_cohort

from torchdeform.cli.main import torchdeform
from torchdeform.cohort.schema import cohort_schema, read_cohort
from torchdeform.io import write_image
from torchdeform.pipeline.config import load_settings


@pytest.fixture
def cohort(tmp_path) -> Path:
    """A cohort file with six pairs of small images, each with the same two."""
    return write_cohort(tmp_path, "abcdef")


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
    write_cohort(cohort.parent, "abc")
    cohort.write_text(cohort.read_text(encoding="utf-8").replace("moving.png", "text.png"), encoding="utf-8")
    (cohort.parent / "text.png").write_text("no image", encoding="ascii")
    assert torchdeform(["batch", str(cohort), "--only", "b"]) == 1
    assert summary(cohort) == {"a": "waiting", "b": "failed", "c": "waiting"}
    said = capsys.readouterr()
    assert "b failed: " in said.err
    assert "text.png" in said.err
    assert "failures.csv" in said.out
    write_cohort(cohort.parent, "abc")
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
        (tmp_path / name).write_text("something", encoding="utf-8")
    path = _file(tmp_path, _PATTERN)
    assert torchdeform(["batch", path, "--dry-run", "--only", "sub-a"]) == 0
    assert "1 to register" in capsys.readouterr().out
    assert torchdeform(["batch", path, "--dry-run", "--only", "sub-x"]) == 2
    assert "no pair is called 'sub-x'" in capsys.readouterr().err
    assert torchdeform(["batch", _file(tmp_path, "otu: x\n")]) == 2
    assert "cohort.yaml line 2: there is no key 'otu'; did you mean 'out'?" in capsys.readouterr().err
