"""The training example runs as it is shipped, goes on where it stopped, and works on two processes."""

import csv
import os
import subprocess
import sys

import pytest

pytest.importorskip("lightning")

SMALL = ["steps=4", "channels=[4, 8]", "heads=[jacobian_curl]"]


def run(root, out, settings, *, processes: int = 1, changes: list[str]) -> str:
    start = [sys.executable]
    if processes > 1:
        start += ["-m", "torch.distributed.run", "--standalone", f"--nproc_per_node={processes}"]
    script = [str(root / "examples" / "train_registration.py"), str(root / "configs" / settings)]
    done = subprocess.run(
        [*start, *script, "--out", str(out), "--set", *changes],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture
def real_images(data_folder, monkeypatch):
    monkeypatch.setenv("TORCHDEFORM_DATA", str(data_folder))


@pytest.mark.data
@pytest.mark.usefixtures("real_images")
def test_trains_resumes_and_compares(root, tmp_path):
    settings = "training_heart_2d.yaml"
    first = run(root, tmp_path, settings, changes=[*SMALL, "held_back=[SC-HF-I-12]"])
    assert "jacobian_curl: step 4" in first
    assert (tmp_path / "jacobian_curl" / "last.ckpt").is_file()
    assert list((tmp_path / "jacobian_curl" / "pictures").glob("*.png"))
    assert "similarity" in next((tmp_path / "jacobian_curl" / "log").rglob("metrics.csv")).read_text(encoding="utf-8")
    with (tmp_path / "comparison.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["way"] for row in rows} == {"unregistered", "jacobian_curl", "register"}
    assert all(int(row["folds"]) == 0 for row in rows)
    again = run(root, tmp_path, settings, changes=[*SMALL, "steps=6", "held_back=[SC-HF-I-12]"])
    assert "jacobian_curl: step 6" in again


@pytest.mark.data
@pytest.mark.usefixtures("real_images")
def test_two_processes_and_volumes(root, tmp_path):
    few = ["hippocampus_001", "hippocampus_003"]
    changes = [*SMALL, "steps=2", f"held_back={few}".replace("'", "")]
    out = run(root, tmp_path, "training_hippocampus_3d.yaml", processes=2, changes=changes)
    assert "jacobian_curl: step 2" in out
    assert "| register |" in out


def test_unknown_settings_are_refused(root, tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text("colour: blue\n", encoding="utf-8")
    script = root / "examples" / "train_registration.py"
    command = [sys.executable, str(script), str(path), "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "colour" in done.stderr
