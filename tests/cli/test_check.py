"""The verb that looks at a pair before it is registered."""

from dataclasses import replace

import pytest
import torch
import typer
from lopsided import lopsided

from torchdeform.cli.check import check
from torchdeform.errors import InputError, explain
from torchdeform.io import read_image, write_image


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run ``check`` in a folder with files; returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    fixed = lopsided(3)
    write_image(fixed, "fixed.nii.gz")
    write_image(replace(fixed, data=fixed.data.flip(2) + 1), "flipped.mha")
    write_image(replace(fixed, origin=(1e4, 0.0, 0.0)), "far.nrrd")
    write_image(lopsided(2), "plane.nii.gz")
    write_image(replace(fixed, data=torch.zeros_like(fixed.data)), "nothing.nii.gz")

    def run_check(*arguments: str) -> tuple[int, str, str]:
        app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        app.command()(check)
        try:
            code = app(args=list(arguments), prog_name="check", standalone_mode=False) or 0
        except InputError as error:
            message, code = explain(error)
            typer.echo(message, err=True)
        return (code, *capsys.readouterr())

    return run_check


def test_the_verb_shows_both_images(run):
    code, out, err = run("fixed.nii.gz", "fixed.nii.gz")
    assert (code, err) == (0, "")
    for line in ("fixed.nii.gz", "30 × 26 × 22", "1.5 × 1 × 2", "0, 0, 0", "LPS", "float32", "nothing looks wrong"):
        assert line in out
    assert len(out.splitlines()) == 10
    assert "register will choose: similarity lncc: the images have one contrast" in out


def test_the_verb_looks_at_landmarks_and_labels(run, tmp_path):
    (tmp_path / "inside.csv").write_text("x,y,z\n1,2,3\n", encoding="utf-8")
    (tmp_path / "outside.csv").write_text("x,y,z\n900,2,3\n", encoding="utf-8")
    labels = ["--fixed-labels", "far.nrrd", "--moving-labels", "fixed.nii.gz"]
    code, out, _ = run("fixed.nii.gz", "fixed.nii.gz", "--fixed-points", "inside.csv", "--moving-points", "outside.csv")
    assert code == 2
    assert "error: 1 of 1 points of outside.csv lie outside of fixed.nii.gz, the farthest by" in out
    code, out, _ = run("fixed.nii.gz", "fixed.nii.gz", *labels)
    assert code == 2
    assert "error: far.nrrd lies beside fixed.nii.gz" in out


def test_the_verb_warns_and_draws(run, tmp_path):
    code, out, _ = run("fixed.nii.gz", "flipped.mha", "--out", "new/overlay.png")
    assert code == 0
    assert "warning: flipped.mha looks mirrored along z" in out
    assert "picture: new/overlay.png" in out
    picture = read_image(tmp_path / "new" / "overlay.png")
    assert min(picture.grid.shape) > 400
    assert picture.data[0, :3].std() > 20


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["fixed.nii.gz", "far.nrrd"], 0, "warning: fixed.nii.gz and far.nrrd do not overlap"),
        (["fixed.nii.gz", "far.nrrd", "--align", "none"], 2, "error: fixed.nii.gz and far.nrrd do not overlap"),
        (["fixed.nii.gz", "plane.nii.gz", "--out", "a.png"], 2, "error: fixed.nii.gz is 3D but plane.nii.gz is 2D"),
        (["fixed.nii.gz", "fixed.nii.gz", "--moving-mask", "nothing.nii.gz"], 2, "error: nothing.nii.gz is empty"),
        (["fixed.nii.gz", "far.nrrd", "--tissue", "nothing.nii.gz"], 2, "error: nothing.nii.gz has no label above 0"),
        (["fixed.nii.gz", "nothing.nii.gz"], 2, "error: nothing.nii.gz is constant"),
        (["fixed.nii.gz", "absent.nii.gz"], 2, "absent.nii.gz does not exist"),
        (["fixed.nii.gz", "far.nrrd", "--fixed-mask", "absent.nii.gz"], 2, "absent.nii.gz does not exist"),
        (["fixed.nii.gz", "far.nrrd", "--out", "picture.jpg"], 2, "give a name that ends in .png"),
        (["fixed.nii.gz", "far.nrrd", "--align", "afine"], 2, "did you mean 'affine'?"),
    ],
)
def test_the_verb_says_what_is_wrong(run, tmp_path, arguments, code, message):
    before = sorted(tmp_path.iterdir())
    got, out, err = run(*arguments)
    assert got == code
    assert message in out + err
    assert sorted(tmp_path.iterdir()) == before
