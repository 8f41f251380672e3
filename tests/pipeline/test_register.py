"""Labels from file to file: what is written is what was measured, every label and its type is kept."""

import json
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from programs import CONVOLUTIONS, save_script

from torchdeform.cli.main import main, torchdeform
from torchdeform.core.intensities import to_common_scale
from torchdeform.io.images import read_image, read_labels, write_image

SHAPES = {2: (40, 44), 3: (16, 18, 20)}


def ball(shape: tuple[int, ...], shift: float) -> np.ndarray:
    """Return the square of the distance from the middle of a box, shifted along the last axis."""
    nodes = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape), indexing="ij"))
    nodes[-1] -= shift
    return (nodes**2).sum(0)


def regions(shape: tuple[int, ...], shift: float, extra: int) -> np.ndarray:
    """Return a shell 1 around a core 700, and a corner that only this image has."""
    distance, size = ball(shape, shift), min(shape)
    labels = 1.0 * (distance < (0.4 * size) ** 2) + 699.0 * (distance < (0.25 * size) ** 2)
    labels[(slice(1, 5),) * len(shape)] = extra
    return labels


@pytest.fixture(params=[2, 3])
def folder(request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shape = SHAPES[request.param]
    for name, shift, extra in (("fixed", 0.0, 5), ("moving", 1.3, 9)):
        image = 200 * np.exp(-ball(shape, shift) / min(shape) ** 2) + 20 * regions(shape, shift, 0) / 700
        sitk.WriteImage(sitk.GetImageFromArray(image.astype(np.float32)), f"{name}.nrrd")
        sitk.WriteImage(sitk.GetImageFromArray(regions(shape, shift, extra).astype(np.float32)), f"{name}_labels.nrrd")
    return tmp_path


def test_what_is_written_is_what_was_measured(folder):
    options = ["--fixed-labels", "fixed_labels.nrrd", "--moving-labels", "moving_labels.nrrd", "--preset", "fast"]
    assert main(["fixed.nrrd", "moving.nrrd", *options, "--align", "translation", "--out", "out", "--quiet"]) == 0
    record = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    assert record["label_interpolation"] == "label"
    fixed, warped = read_labels("fixed_labels.nrrd").data, read_labels("out/warped_labels.nrrd")
    assert warped.pixel_type == "float32"
    assert set(warped.data.unique().tolist()) == {0, 1, 700, 9}
    found = record["evaluation"]["after"]["dice"]
    assert set(found) == {"1", "700"}
    for label, value in found.items():
        both = [labels == float(label) for labels in (fixed, warped.data)]
        assert value == pytest.approx(2 * float((both[0] & both[1]).sum()) / float(both[0].sum() + both[1].sum()))
        assert value > 0.9


def test_labels_that_pull_overlap_more_and_are_said_to_have_been_in_the_cost(folder, capsys):
    pair = ["fixed.nrrd", "moving.nrrd", "--set", "optimiser.steps=[2, 2, 1]", "--align", "none"]
    labels = ["--fixed-labels", "fixed_labels.nrrd", "--moving-labels", "moving_labels.nrrd"]
    found = []
    for weight in (0, 3):
        assert main([*pair, *labels, "--set", f"labels_weight={weight}", "--out", f"out{weight}"]) == 0
        record = json.loads((folder / f"out{weight}" / "result.json").read_text(encoding="utf-8"))
        assert record["labels_in_cost"] == bool(weight)
        said = [
            capsys.readouterr().out,
            (folder / f"out{weight}" / "report.html").read_text(encoding="utf-8"),
            record["verdict"]["findings"][-1]["text"] + str(record["verdict"]["findings"]),
        ]
        assert [" in the cost" in text for text in said] == [bool(weight)] * 3
        found.append(record["evaluation"]["after"]["dice_mean"])
    assert found[1] > found[0]
    assert main([*pair, "--set", "labels_weight=1", "--out", "none"]) == 2
    assert "give --fixed-labels and --moving-labels" in capsys.readouterr().err
    assert not (folder / "none").exists()


def test_features_of_a_program_and_of_files_are_the_same(folder, capsys):
    """A program that adds 1 to the scaled image and its square, and the files that it would have made."""
    dim = sitk.ReadImage("fixed.nrrd").GetDimension()
    net = CONVOLUTIONS[dim](1, 2, 1).eval()
    save_script(net, folder / "net.ts")
    pair = ["fixed.nrrd", "moving.nrrd", "--preset", "fast", "--align", "none", "--set", "absent=off", "--quiet"]
    assert main([*pair, "--set", "features=net.ts", "--out", "program"]) == 0
    for name in ("fixed", "moving"):
        image = read_image(f"{name}.nrrd")
        scaled, _ = to_common_scale((image.data, image.data), (None, None), jointly=False)
        with torch.no_grad():
            write_image(replace(image, data=net(scaled)), f"{name}_features.nrrd")
    files = ["--fixed-features", "fixed_features.nrrd", "--moving-features", "moving_features.nrrd"]
    assert main([*pair, *files, "--out", "files"]) == 0
    first, second = (
        json.loads((folder / out / "result.json").read_text(encoding="utf-8")) for out in ("program", "files")
    )
    assert first["objective_after"] == pytest.approx(second["objective_after"], rel=1e-3)
    assert first["objective_after"] > first["objective_before"]
    assert [record["settings"]["features"] for record in (first, second)] == ["net.ts", "files"]
    assert "ssd" in first["similarity_choice"]
    assert torchdeform(["check", "fixed.nrrd", "moving.nrrd", *files]) == 0
    assert f"register will choose: {first['similarity_choice']}" in capsys.readouterr().out
    for words, problem in (
        ([*files[:2]], "--fixed-features needs --moving-features too"),
        ([*files, "--set", "features=mind"], "features are given twice, by --fixed-features"),
        ([*files[:3], "fixed.nrrd"], "fixed_features.nrrd has 2 channels and fixed.nrrd has 1 channels"),
        (["--set", "features=missing.ts"], "missing.ts does not exist"),
        (["--set", "features=fixed.nrrd"], "fixed.nrrd holds no program"),
        (["--set", "features=files"], "there are none; give --fixed-features"),
    ):
        assert main([*pair, *words, "--out", "none"]) == 2
        assert problem in capsys.readouterr().err
        assert not (folder / "none").exists()
    assert torchdeform(["check", "fixed.nrrd", "moving.nrrd", *files[:3], "fixed.nrrd"]) == 2
    assert "features of both images must be the same channels" in capsys.readouterr().out
    flat = read_image(folder / "moving_features.nrrd")
    write_image(replace(flat, data=torch.ones_like(flat.data)), folder / "flat.nrrd")
    assert torchdeform(["check", "fixed.nrrd", "moving.nrrd", *files[:3], "flat.nrrd"]) == 2
    assert "flat.nrrd is constant, so there is nothing to compare" in capsys.readouterr().out
    save_script(CONVOLUTIONS[5 - dim](1, 2, 1), folder / "other.ts")
    assert main([*pair, "--set", "features=other.ts", "--out", "none"]) == 2
    assert "other.ts" in capsys.readouterr().err


def test_without_labels_nothing_is_said_of_them(folder):
    assert main(["fixed.nrrd", "moving.nrrd", "--preset", "fast", "--out", "out", "--quiet"]) == 0
    assert json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))["label_interpolation"] is None


def test_a_limit_of_memory_that_is_too_small_is_the_one_that_was_given(folder, capsys):
    limit = ["--memory", "450MB", "--set", "symmetric=true"]
    assert main(["fixed.nrrd", "moving.nrrd", *limit, "--out", "out", "--quiet"]) == 2
    assert "--memory 450MB is too little" in capsys.readouterr().err


def test_a_limit_of_memory_is_kept_to_where_less_is_free(folder, monkeypatch):
    """The check before it refuses nothing that will be made to fit."""
    monkeypatch.setattr("torchdeform.pipeline.preflight.available", lambda device: 10**8)
    assert main(["fixed.nrrd", "moving.nrrd", "--memory", "1GB", "--preset", "fast", "--out", "out", "--quiet"]) == 0


def test_a_rigid_label_is_rigid_in_the_file_too(folder):
    """As SimpleITK reads it, alignment and all, on labels of another type; what the record says is what it finds."""
    labels = sitk.Cast(sitk.ReadImage("fixed_labels.nrrd"), sitk.sitkUInt16)
    sitk.WriteImage(labels, "tissue.nii.gz")
    how = [
        "--tissue",
        "tissue.nii.gz",
        "--set",
        "tissues.700=rigid",
        "--set",
        "optimiser.steps=[2, 2]",
        "--out",
        "out",
        "--report",
        "none",
    ]
    assert main(["fixed.nrrd", "moving.nrrd", *how, "--quiet"]) == 0
    record = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    (told,) = record["tissue"]
    inside = np.argwhere(sitk.GetArrayFromImage(labels) == 700)
    assert (told["label"], told["kind"], told["nodes"]) == (700, "rigid", len(inside))
    assert record["alignment"]["kind"] == "rigid"
    transform = sitk.ReadTransform("out/transform.h5")
    here = np.array([labels.TransformIndexToPhysicalPoint([int(k) for k in node[::-1]]) for node in inside])
    there = np.array([transform.TransformPoint(point) for point in here])
    here, there = here - here.mean(0), there - there.mean(0)
    left, _, right = np.linalg.svd(here.T @ there)
    assert np.abs(here @ left @ right - there).max() < 0.01
    assert told["after"]["residual"] < 0.01
