"""The command: what it writes, what it says, and how it fails. The engine is a stand-in, but for one test."""

import io
import json
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.cli.main import main, torchdeform
from torchdeform.cli.register import verdict_text
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample
from torchdeform.errors import ComputationError
from torchdeform.io import read_displacement, read_image, write_image
from torchdeform.registration.tissue import TissueFit, TissueOutcome

RESULTS = ["displacement.nii.gz", "inverse.h5", "overview.png", "report.html", "result.json", "transform.h5"]


@pytest.fixture
def engine(monkeypatch, make_result):
    """Put the known result in the place of the real registration; ``engine.register`` can be replaced."""
    module = ModuleType("torchdeform.registration.deformable")
    module.register = make_result  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module


@pytest.fixture
def folder(tmp_path, monkeypatch, make_image):
    """A working folder with a pair of pictures and a pair of volumes."""
    monkeypatch.chdir(tmp_path)
    for name, channels in (("fixed", 1), ("moving", 3)):
        write_image(make_image((24, 30), channels=channels, pixel_type="uint8"), f"{name}.png")
        write_image(make_image((12, 14, 16), (2.0, 1.0, 1.5), tilted=True), f"{name}.nii.gz")
    return tmp_path


def _names(folder):
    return sorted(p.name for p in folder.iterdir())


def _fails(capsys, code, *arguments):
    """Run, and return the one sentence on stderr."""
    assert main(arguments) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("register: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    return err


def test_pictures_end_to_end(folder, engine, capsys):
    assert main(["fixed.png", "moving.png", "--out", "results/one"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert 3 <= len(out.splitlines()) <= 7
    assert out.startswith("✓ The images fit")
    for word in ("similarity", "folds", "determinant", "inverse consistency", "seconds", "results/one"):
        assert word in out
    assert _names(folder / "results" / "one") == sorted([*RESULTS, "warped.png"])
    warped = read_image("results/one/warped.png")
    assert (warped.pixel_type, tuple(warped.data.shape)) == ("uint8", (1, 3, 24, 30))


def test_strict_ends_with_3_only_if_the_verdict_is_bad(folder, engine, capsys, make_result, fine_evidence):
    pair = ["fixed.png", "moving.png", "--out", "one", "--overwrite"]
    assert main([*pair, "--strict"]) == 0
    bad = replace(fine_evidence, information=0.1, information_before=0.1, structure_before=0.1)
    engine.register = lambda *images, **more: replace(make_result(*images, **more), evidence=(bad,))
    capsys.readouterr()
    assert main([*pair, "--strict"]) == 3
    assert capsys.readouterr().out.startswith("✗ Do not use this: the images do not fit.\n  The images do not fit (")
    assert main(pair) == 0
    verdict = json.loads((folder / "one" / "result.json").read_text(encoding="utf-8"))["verdict"]
    assert (verdict["kind"], verdict["findings"][0]["kind"]) == ("bad", "bad")
    assert verdict["findings"][1]["figures"] == {"information": 0.1}
    assert "Do not use this: the images do not fit." in (folder / "one" / "report.html").read_text(encoding="utf-8")


def test_the_sign_of_the_verdict_suits_the_terminal(monkeypatch):
    verdict = {"kind": "good", "headline": "Fine.", "findings": []}
    for encoding, sign in (("utf-8", "✓"), ("ascii", "OK"), ("cp1252", "OK")):
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
        assert f"{sign} Fine." in verdict_text(verdict)


def test_warnings_are_not_said_twice():
    findings = [{"kind": "look", "text": text} for text in ("Warning: a.png is odd.", "The map is odd (3).")]
    shown = verdict_text({"kind": "look", "headline": "Look.", "findings": findings})
    assert shown.splitlines()[1:] == ["  The map is odd (3)."]


def test_volumes_end_to_end(folder, engine):
    """SimpleITK brings the moving file onto the fixed one with our files and gets our warped file."""
    assert main(["fixed.nii.gz", "moving.nii.gz", "--quiet"]) == 0
    assert _names(folder / "moving") == sorted([*RESULTS, "warped.nii.gz"])
    fixed, moving = (sitk.ReadImage(f"{name}.nii.gz") for name in ("fixed", "moving"))
    theirs = sitk.Resample(moving, fixed, sitk.ReadTransform("moving/transform.h5"), sitk.sitkLinear, 0.0)
    ours = sitk.ReadImage("moving/warped.nii.gz")
    np.testing.assert_allclose(sitk.GetArrayFromImage(ours), sitk.GetArrayFromImage(theirs), atol=1e-3 * 200)
    np.testing.assert_allclose(ours.GetDirection(), fixed.GetDirection(), atol=1e-6)
    assert read_displacement("moving/displacement.nii.gz").grid.shape == (12, 14, 16)


def test_record_says_what_ran(folder, engine):
    (folder / "my.yaml").write_text("optimiser: {steps: [4, 2]}\n", encoding="utf-8")
    assert (
        torchdeform(
            ["register", "fixed.png", "moving.png", "--config", "my.yaml", "--set", "similarity.window=7", "--quiet"]
        )
        == 0
    )
    record = json.loads((folder / "moving" / "result.json").read_text(encoding="utf-8"))
    assert (record["settings"]["optimiser"]["steps"], record["settings"]["similarity"]["window"]) == ([4, 2], 7)
    assert set(record["seconds"]) == {"read", "optimise", "write", "draw"}
    assert sorted(record["files"]) == _names(folder / "moving")
    assert record["moving"]["path"] == "moving.png"
    assert record["device"].startswith("cuda" if torch.cuda.is_available() else "cpu")


def test_quiet_is_quiet(folder, engine, capfd):
    assert main(["fixed.png", "moving.png", "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")


def test_a_second_run_replaces_its_own_files_only(folder, engine):
    assert main(["fixed.png", "moving.png", "--out", "out", "--quiet"]) == 0
    (folder / "out" / "notes.txt").write_text("mine", encoding="utf-8")
    write_image(read_image("moving.png"), "moving.tif")
    assert main(["fixed.png", "moving.tif", "--out", "out", "--overwrite", "--quiet"]) == 0
    assert _names(folder / "out") == sorted([*RESULTS, "warped.tif", "notes.txt"])
    assert (folder / "out" / "notes.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    "other", [("moving.png", "fixed.png"), ("fixed.png", "fixed.png"), ("fixed.nii.gz", "moving.nii.gz")]
)
def test_results_of_another_pair_are_kept_unless_told_otherwise(folder, engine, capsys, other):
    assert main(["fixed.png", "moving.png", "--out", "out", "--quiet"]) == 0
    before = {p.name: p.read_bytes() for p in (folder / "out").iterdir()}
    said = _fails(capsys, 2, *other, "--out", "out")
    assert "out has the results of moving.png to fixed.png" in said
    assert "--overwrite" in said
    assert {p.name: p.read_bytes() for p in (folder / "out").iterdir()} == before
    assert main([*other, "--out", "out", "--overwrite", "--quiet"]) == 0


def test_a_pair_is_the_same_from_wherever_it_is_named(folder, engine, monkeypatch):
    assert main(["fixed.png", "moving.png", "--out", "out", "--quiet"]) == 0
    (folder / "below").mkdir()
    monkeypatch.chdir(folder / "below")
    assert main(["../fixed.png", str(folder / "moving.png"), "--out", "../out", "--preset", "fast", "--quiet"]) == 0


@pytest.mark.parametrize("versions", [{}, {"versions": {"torchdeform": "0.1.0"}}, {"versions": [1]}, {"files": None}])
def test_only_what_register_writes_is_ever_removed(folder, engine, versions):
    """Whatever a record in the folder lists, also one that looks like ours."""
    (folder / "out").mkdir()
    mine = ["thesis.docx", "warped.notes.old.txt", "moving.png", "sub", "warped"]
    for name in mine:
        (folder / "out" / name).touch()
    inputs = {side: str(folder / f"{side}.png") for side in ("fixed", "moving")}
    listed = [*mine, "../fixed.png", "/etc/hostname", "..", ".", "a\0b", 3, None, "result.json"]
    (folder / "out" / "result.json").write_text(json.dumps({"inputs": inputs, "files": listed} | versions))
    assert main(["fixed.png", "moving.png", "--out", "out", "--quiet"]) == 0
    assert all((folder / "out" / name).exists() for name in mine)
    assert (folder / "fixed.png").is_file()


def test_results_of_another_command_are_kept(folder, engine, capsys):
    assert torchdeform(["grid", "fixed.png", "--out", "out", "--quiet"]) == 0
    assert "out has the results of another command" in _fails(capsys, 2, "fixed.png", "moving.png", "--out", "out")


@pytest.mark.parametrize("suffix", ["png", "nii.gz"])
def test_reports_are_full_light_or_none(folder, engine, suffix, capsys):
    pair, drawn, sizes = [f"fixed.{suffix}", f"moving.{suffix}", "--out", "out"], {"overview.png", "report.html"}, {}
    for report, more in (("full", drawn), ("light", drawn | {"thumb.jpg"}), ("none", set())):
        assert main([*pair, "--report", report]) == 0
        assert ("report.html" in capsys.readouterr().out) == (report != "none")
        found = {path.name: path.stat().st_size for path in (folder / "out").iterdir()}
        assert set(found) == {*RESULTS, f"warped.{suffix}"} - drawn | more
        assert sorted(json.loads((folder / "out" / "result.json").read_text())["files"]) == sorted(found)
        sizes[report] = found.get("report.html", 0)
    assert sizes["light"] <= sizes["full"]
    assert "report must be one of none, light, full" in _fails(capsys, 2, *pair, "--report", "some")


def test_a_failure_keeps_the_earlier_results(folder, engine, capsys, monkeypatch):
    assert main(["fixed.png", "moving.png", "--out", "out", "--quiet"]) == 0
    before = {p.name: p.read_bytes() for p in (folder / "out").iterdir()}

    def broken(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchdeform.pipeline.register.write_overview", broken)
    assert "No space left on device" in _fails(capsys, 1, "fixed.png", "moving.png", "--out", "out")
    assert {p.name: p.read_bytes() for p in (folder / "out").iterdir()} == before


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ComputationError("the velocity could not be found"), 1, "the velocity could not be found"),
        (MemoryError(), 1, "not enough memory"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 1 bytes"),
            1,
            "not enough memory",
        ),
        (ZeroDivisionError("division\nby zero"), 1, "unexpected ZeroDivisionError: division by zero"),
    ],
)
def test_failures_are_one_sentence_and_leave_nothing(folder, engine, capsys, error, code, message):
    def fail(*_: object, **__: object) -> None:
        raise error

    engine.register = fail
    before = _names(folder)
    assert message in _fails(capsys, code, "fixed.png", "moving.png", "--out", "new/out")
    assert _names(folder) == before


def test_diverged_results_are_not_written(folder, engine, capsys, make_result):
    def diverge(*arguments, **options):
        result = make_result(*arguments, **options)
        return replace(result, inverse=result.inverse * float("nan"))

    engine.register = diverge
    assert "diverged" in _fails(capsys, 1, "fixed.png", "moving.png")
    assert not (folder / "moving").exists()


def _write(name, values, **how):
    write_image(Image(values, Grid(tuple(values.shape[2:])), **how), name)


def _constant():
    _write("bad.png", torch.full((1, 3, 9, 9), 7.0), pixel_type="uint8")


def _nan():
    values = torch.rand(1, 1, 9, 9)
    values[0, 0, 3, 3] = float("nan")
    _write("bad.nii.gz", values)


def _elsewhere():
    _write("bad.mha", torch.rand(1, 1, 9, 9), origin=(1000.0, 0.0))


def _channels():
    _write("bad.mha", torch.rand(1, 5, 9, 9))


def _tissue(*labels):
    def write():
        values = torch.zeros(1, 1, 24, 30)
        for k, label in enumerate(labels):
            values[..., 6 * k : 6 * k + 5, 2:9] = label
        _write("tissue.png", values, pixel_type="uint8")

    return write


PAIR = ["fixed.png", "moving.png"]
WITH_TISSUE = [*PAIR, "--tissue", "tissue.png"]


def test_tissue_goes_to_the_engine_and_into_summary_and_command(folder, engine, make_result, capsys):
    seen, nodes = [], torch.tensor([35])
    kept = TissueFit(*torch.tensor([[0.0213], [0.0081], [1.0002]])), TissueFit(*torch.tensor([[0.3], [0.04], [0.98]]))
    known = (
        TissueOutcome(1, "rigid", False, nodes, kept[1], kept[0]),
        TissueOutcome(3, "incompressible", True, nodes, kept[1], kept[0]),
        TissueOutcome(5, "stiff", False, nodes, *[kept[0]] * 2),
        TissueOutcome(7, "free", True, nodes, *[kept[0]] * 2),
    )

    def register(*images, annotations, **more):
        seen.append(annotations.tissue.data.unique().tolist())
        return replace(make_result(*images, annotations=annotations, **more), tissue=known)

    engine.register = register
    _tissue(1, 3)()
    how = ["--set", "tissues.1=rigid", "--set", "tissues.3={div: 50, strain: 5}", "--set", "sliding=3", "--out", "out"]
    assert main([*WITH_TISSUE, *how]) == 0
    out = capsys.readouterr().out
    for line in (
        "tissue 1 (rigid)                    0.3 -> 0.0213 voxel off a rigid motion",
        "tissue 3 (incompressible, sliding)  determinant within 4 % -> 0.81 %, volume -2 % -> +0.02 %",
        "tissue 5 (stiff)                    0.0213 voxel off a rigid motion, volume +0.02 %",
        "tissue 7 (free, sliding)            volume +0.02 %",
    ):
        assert line in out
    first = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    assert first["inputs"]["tissue"] == "tissue.png"
    assert first["settings"]["tissues"] == {"1": "rigid", "3": {"div": 50.0, "strain": 5.0}}
    assert first["settings"]["sliding"] == [3]
    assert torchdeform([*shlex.split(first["command"]), "--quiet"]) == 0
    again = json.loads((folder / "out" / "result.json").read_text(encoding="utf-8"))
    assert (again["settings"], again["inputs"]) == (first["settings"], first["inputs"])
    assert seen == [[0, 1, 3]] * 2


@pytest.mark.parametrize(
    ("prepare", "arguments", "message"),
    [
        (None, [*PAIR, "--set", "tissues.1=rigid"], "tissues and sliding name labels (1), but there is no --tissue"),
        (_tissue(2, 5), WITH_TISSUE, "tissue.png has the labels 2, 5, and settings must say what they are: add --set"),
        (_tissue(2), [*WITH_TISSUE, "--set", "sliding=[3]"], "tissue.png has no label 3, which sliding names; it has"),
        (_tissue(2), [*WITH_TISSUE, "--set", "sliding=2", "--symmetric"], "symmetric: tissue is known of the fixed"),
        (_tissue(2), [*WITH_TISSUE, "--set", "tissues.2=rigd"], "did you mean 'rigid'?"),
        (_tissue(2), [*WITH_TISSUE, "--set", "tissue.2=rigid"], "did you mean 'tissues'?"),
        (None, [*WITH_TISSUE, "--set", "tissues.1=rigid"], "tissue.png does not exist"),
        (None, [*PAIR, "--tissue", "fixed.nii.gz", "--set", "tissues.1=rigid"], "tissue: fixed.nii.gz must be 2D with"),
        (None, [*PAIR, "--tissue", "moving.png", "--set", "tissues.1=rigid"], "tissue: moving.png must be 2D with one"),
        (None, ["fixed.png", "movin.png"], "movin.png does not exist; check the name; did you mean 'moving.png'?"),
        (None, ["fixed.png", "."], ". is a folder"),
        (None, ["fixed.png", "moving.nii.gz"], "fixed.png is 2D but moving.nii.gz is 3D"),
        (_constant, ["fixed.png", "bad.png"], "bad.png is constant"),
        (_nan, ["bad.nii.gz", "moving.png"], "bad.nii.gz has pixels that are NaN"),
        (_elsewhere, ["fixed.png", "bad.mha", "--align", "none"], "overlap"),
        (_channels, ["fixed.png", "bad.mha"], "bad.mha 5, which do not correspond"),
        (None, ["fixed.png", "moving.png", "--set", "windw=5"], "did you mean 'similarity.window'?"),
        (None, ["fixed.png", "moving.png", "--set", "window"], "--set needs key=value"),
        (None, ["fixed.png", "moving.png", "--preset", "fst"], "did you mean 'fast'?"),
        (None, ["fixed.png", "moving.png", "--config", "no.yaml"], "no.yaml does not exist"),
        (None, ["fixed.png", "moving.png", "--device", "gpu"], "device must be one of auto, cpu, cuda"),
        (None, ["fixed.png", "moving.png", "--out", "fixed.png"], "fixed.png is not a folder"),
        (None, ["fixed.png"], "MOVING"),
        (None, ["fixed.png", "moving.png", "--ot", "x"], "--ot"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_sentence(folder, engine, capsys, prepare, arguments, message):
    if prepare:
        prepare()
    engine.register = None  # found out before any long work
    before = _names(folder)
    assert message in _fails(capsys, 2, *arguments)
    assert _names(folder) == before


def test_cuda_asked_for_in_vain(folder, engine, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "there is no CUDA device here" in _fails(capsys, 2, "fixed.png", "moving.png", "--device", "cuda")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission_is_named(folder, engine, capsys):
    (folder / "locked").mkdir(mode=0o500)
    assert "cannot write to locked" in _fails(capsys, 2, "fixed.png", "moving.png", "--out", "locked/out")


def test_help_names_every_option(capsys):
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    for word in (
        "FIXED",
        "MOVING",
        "--align",
        "--fixed-mask",
        "--moving-points",
        "--memory",
        "--out",
        "--preset",
        "--config",
        "--set",
        "--device",
        "--quiet",
        "--version",
    ):
        assert word in out
    assert len(out.splitlines()) < 60


def test_progress_is_shown_on_a_terminal_only(folder, engine, capsys, monkeypatch):
    for name, value in {
        "FORCE_COLOR": "1",
        "TERM": "xterm",
        "COLUMNS": "100",
    }.items():  # what rich takes for a terminal
        monkeypatch.setenv(name, value)
    assert main(["fixed.png", "moving.png"]) == 0
    shown = capsys.readouterr().err
    assert all(stage in shown for stage in ("reading", "writing", "drawing"))


def test_script_runs_without_installation(folder, root):
    command = [sys.executable, str(root / "scripts" / "register.py"), "fixed.png", "no.png"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("register: no.png does not exist")


def test_the_real_engine(folder, make_image, make_displacement):
    """Register a deformed copy for real, with few steps: no folds, nearer than before, and ITK agrees on the image."""
    fixed = make_image((60, 72), pixel_type="uint8")
    deformed = resample(fixed, fixed, make_displacement(fixed.grid, 0.1), outside=None)
    write_image(fixed, "one.nrrd")
    write_image(replace(fixed, data=deformed), "two.nrrd")
    assert (
        main(
            [
                "one.nrrd",
                "two.nrrd",
                "--set",
                "optimiser.steps=[20, 10]",
                "--align",
                "none",
                "--device",
                "cpu",
                "--quiet",
            ]
        )
        == 0
    )
    record = json.loads((folder / "two" / "result.json").read_text(encoding="utf-8"))
    assert record["folds"] == 0
    assert record["similarity_after"] > record["similarity_before"]
    warped = read_image("two/warped.nrrd").data
    assert (warped - fixed.data).square().mean() < 0.2 * (deformed - fixed.data).square().mean()
    one, two = (sitk.ReadImage(f"{name}.nrrd") for name in ("one", "two"))
    theirs = sitk.Resample(two, one, sitk.ReadTransform("two/transform.h5"), sitk.sitkLinear, 0.0)
    assert np.abs(sitk.GetArrayFromImage(theirs) - warped[0, 0].numpy()).max() < 1e-3 * 200


def test_a_folder_with_the_name_of_a_result_is_found_before_the_work(folder, engine, capsys):
    (folder / "results" / "warped.png").mkdir(parents=True)
    (folder / "results" / "warped.png" / "mine").write_text("mine", encoding="ascii")
    assert "warped.png is a folder where a file is to be written" in _fails(
        capsys, 2, "fixed.png", "moving.png", "--out", "results"
    )
    assert (folder / "results" / "warped.png" / "mine").is_file()
