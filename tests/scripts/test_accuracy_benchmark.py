"""The benchmark of settings: what it reads, where it starts, what it keeps and prints."""

import json
import sys
from dataclasses import replace

import accuracy
import numpy as np
import pytest
import reading
import SimpleITK as sitk
import torch
from pairs import Pair

import torchdeform as td


@pytest.fixture
def pairs(tmp_path) -> list[Pair]:
    """Three subjects in turn: discs of different size with their labels."""
    y, x = np.mgrid[:32, :36]
    for k, radius in enumerate((8, 9, 11)):
        labels = (np.hypot(y - 15, x - 17) < radius).astype(np.uint8) + (np.hypot(y - 15, x - 17) < radius / 2)
        noise = 4 * np.random.default_rng(k).normal(size=labels.shape)
        for what, array in (("", (100 * labels + noise).astype(np.float32)), ("_labels", labels)):
            image = sitk.GetImageFromArray(array)
            image.SetSpacing((0.5, 0.8))
            sitk.WriteImage(image, str(tmp_path / f"{k}{what}.mha"))
    files = [[tmp_path / f"{k}{what}.mha" for k in range(3)] for what in ("", "_labels")]
    return [
        Pair(f"{k} <- {k + 1}", *(f[j] for f in files for j in (k, k + 1)), subjects=("ABC"[k], "ABC"[k + 1]))
        for k in (0, 1)
    ]


@pytest.fixture
def options(tmp_path, monkeypatch, pairs):
    monkeypatch.setitem(accuracy.SETS, "synthetic", lambda _: pairs)
    words = ["--sets", "synthetic", "--jitters", "2", "--json", str(tmp_path / "runs.json"), "--beside", "fast"]
    quick = ["none=optimiser.steps=[0]", "some=fast,optimiser.steps=[9]"]
    monkeypatch.setattr(sys, "argv", ["accuracy.py", str(tmp_path), *words, "--settings", *quick])
    return accuracy.parse()


def test_settings_are_read_with_commas_in_brackets():
    found = accuracy.Setting.parse(
        "name=accurate,optimiser.steps=[4,3],similarity={lncc: 1, mi: 0.5},folds.soft_determinant=0.2"
    )
    settings = found.load()
    assert (found.name, found.preset) == ("name", "accurate")
    assert settings.optimiser.steps == (4, 3)
    assert settings.similarity.measure == {"lncc": 1, "mi": 0.5}
    assert accuracy.Setting.parse("fast").load() == td.load_settings("fast")
    same = accuracy.Setting.parse("other=accurate,folds.soft_determinant=0.2,optimiser.steps=[4, 3]")
    assert same.key == replace(found, changes={"optimiser.steps": [4, 3], "folds.soft_determinant": 0.2}).key
    assert same.key != found.key


def test_runs_are_kept_chosen_from_and_not_done_again(options, tmp_path, monkeypatch, capsys):
    accuracy.main()
    first = capsys.readouterr().out
    rows = json.loads((tmp_path / "runs.json").read_text(encoding="utf-8"))
    assert len(rows) == 2 * 2 * 4
    assert all(row["folds"] == 0 for row in rows)
    monkeypatch.setattr(accuracy, "measure", lambda _: pytest.fail("it was run again"))
    accuracy.main()
    assert capsys.readouterr().out == first
    lines = [line.split(" | ") for line in first.splitlines() if line.startswith("| synthetic")]
    by_name = {line[1]: float(line[3]) for line in lines[:4]}
    assert list(by_name) == ["default", "none", "some", "fast"]
    assert by_name["none"] < by_name["some"]
    means = [np.mean([row["dice"] for row in rows if s.key.items() <= row.items()]) for s in options.all_settings]
    assert list(by_name.values()) == pytest.approx(means, abs=6e-5)
    assert "The default stays" in first or "The default would change to some" in first


def test_what_older_code_did_is_compared_and_not_run(options, tmp_path, monkeypatch, capsys):
    file = tmp_path / "runs.json"
    monkeypatch.setattr(sys, "argv", [*sys.argv[: sys.argv.index("--beside")], "--beside", "--settings", "old=@abc"])
    monkeypatch.setattr(accuracy, "_code", lambda: "abc")
    accuracy.main()
    rows = json.loads(file.read_text(encoding="utf-8"))
    better = [row | {"dice": row["dice"] + 0.01, "settings": "of that time"} for row in rows]
    file.write_text(json.dumps(better), encoding="utf-8")
    monkeypatch.setattr(accuracy, "_code", lambda: "def")
    capsys.readouterr()
    accuracy.main()
    told = capsys.readouterr().out
    assert "| synthetic | old | 2 |" in told
    assert "+0.0100 ± 0.0000" in told
    assert len(json.loads(file.read_text(encoding="utf-8"))) == 2 * len(rows)


def test_a_setting_that_fails_on_a_pair_is_named_and_not_chosen(options, monkeypatch, capsys):
    right = accuracy.measure

    def measure(task):
        if task.setting.name == "some" and task.pair.name == "0 <- 1":
            raise td.InputError("it is too round")
        return right(task)

    monkeypatch.setattr(accuracy, "measure", measure)
    accuracy.main()
    told = capsys.readouterr().out
    assert "synthetic, 0 <- 1, some: it is too round" in told
    assert "Left out, as it did not register every pair: some." in told


def test_each_start_is_moved_by_about_a_tenth_of_a_voxel(options, pairs, monkeypatch):
    starts, settings = [], accuracy.Setting.parse("none=align=none,optimiser.steps=[0]")
    register = td.register

    def seen(*images, affine, **rest):
        starts.append(affine.affine.offset)
        return register(*images, affine=affine, **rest)

    monkeypatch.setattr(td, "register", seen)
    key = {"device": "cpu", "shrink": 1}
    rows = accuracy.measure(accuracy.Task(pairs[0], settings, tuple(range(12)), key))
    voxels = torch.stack(starts) / torch.tensor([0.5, 0.8])
    assert len({tuple(start.tolist()) for start in starts}) == 12
    assert voxels.mean(0).abs().max() < 0.12
    assert voxels.std(0) == pytest.approx([0.1, 0.1], rel=0.6)
    # Without alignment and steps the shift is the whole map.
    moving = accuracy.images(pairs[0])[1]
    assert accuracy.shift(pairs[0], moving, 5) == pytest.approx(starts[5].tolist())
    assert [row["jitter"] for row in rows] == list(range(12))


def test_label_maps_are_painted_and_only_whole_brains_shrink(pairs, tmp_path, monkeypatch):
    pytest.importorskip("scipy")
    labels = pairs[0].fixed_labels
    pair = Pair("painted", labels, labels, labels, labels, contrasts=("t1", "t2"))
    t1, t2 = reading.images(pair, 2)
    assert t1.grid == td.read_image(labels).grid
    assert 0 <= t1.data.min() < t1.data.max() <= 1
    assert not torch.allclose(t1.data, t2.data, atol=0.1)
    again = reading.images(pair)
    assert torch.equal(t1.data, again[0].data)
    monkeypatch.setattr(reading, "_WHOLE", 100)
    small = reading.images(pair, 2)[0]
    assert small.grid.extent == t1.grid.extent
    assert small.grid.shape == (26, 19)  # twice the finer spacing along both axes
