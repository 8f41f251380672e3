"""The verbs that apply, invert, compose and measure transforms: what they write, what they say, and how they fail."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import typer

from torchdeform.cli import main as cli
from torchdeform.cli import transforms
from torchdeform.core.diagnostics import diagnose, inverse_error
from torchdeform.core.image import Image, surroundings
from torchdeform.core.transform import Affine, Displacement, Transform
from torchdeform.core.warp import invert
from torchdeform.io import read_displacement, read_image, write_displacement, write_image
from torchdeform.io.images import read_labels
from torchdeform.io.points import Points, read_points, write_points
from torchdeform.io.transforms import read_transform, write_transform
from torchdeform.report.record import describe_map

DIMS = [2, 3]
VERBS = {name: getattr(transforms, name) for name in ("apply", "points", "invert", "compose", "jacobian")}


def run(*arguments):
    """Run a verb as the shell does, and return the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    for name, verb in VERBS.items():
        app.command(name)(verb)
    return cli._run(app, "torchdeform", list(map(str, arguments)))


@pytest.fixture(params=DIMS)
def folder(request, tmp_path, monkeypatch, make_image, make_displacement):
    """A working folder with a pair of images, labels, points, and the transform between them."""
    monkeypatch.chdir(tmp_path)
    _fill(request.param, make_image, make_displacement)
    return tmp_path


@pytest.fixture
def volumes(tmp_path, monkeypatch, make_image, make_displacement):
    monkeypatch.chdir(tmp_path)
    _fill(3, make_image, make_displacement)
    return tmp_path


def _fill(dim, make_image, make_displacement):
    shapes, origin = ((16, 18, 20)[:dim], (17, 15, 16)[:dim]), (-8.0, 20.0, 33.0)[:dim]
    fixed = make_image(shapes[0], (1.3, 0.7, 1.1)[:dim], origin=origin, tilted=True)
    moving = make_image(shapes[1], (0.9, 1.1, 1.2)[:dim], origin=origin)
    affine = Affine(torch.eye(dim).double() * 1.05, torch.full((dim,), -0.5).double())
    u = make_displacement(fixed.grid, 0.06)
    chain = Transform.from_displacement(u, fixed, affine=affine, moving=moving)
    write_image(fixed, "fixed.nrrd")
    write_image(moving, "moving.nrrd")
    values = torch.randint(0, 2**31, moving.data.shape, generator=torch.manual_seed(0)).numpy()
    _write_itk(values[0, 0].astype(np.uint32), moving, "labels.nrrd")
    write_transform(chain, "transform.h5")
    write_transform(Transform((affine,)), "affine.mat")
    write_displacement(u, fixed, "u.nrrd")
    nodes = fixed.to_world(fixed.grid.points(dtype=torch.float64)).flatten(2)[0].T
    write_points(Points(nodes[::301], tuple(f"p{k}" for k in range(len(nodes[::301])))), "points.csv")


def _write_itk(values, place, name):
    itk = sitk.GetImageFromArray(values)
    itk.SetOrigin(place.origin)
    itk.SetSpacing(place.grid.spacing[::-1])
    itk.SetDirection(np.array(place.direction).ravel().tolist())
    sitk.WriteImage(itk, name)


def _resampled(moving, fixed, transform, how):
    itk = sitk.ReadTransform(transform)
    return sitk.GetArrayFromImage(sitk.Resample(sitk.ReadImage(moving), sitk.ReadImage(fixed), itk, how, 0.0))


@pytest.mark.parametrize(("name", "how"), [("linear", sitk.sitkLinear), ("cubic", sitk.sitkBSpline)])
def test_apply_is_itk_s_resampling(folder, name, how):
    options = ["--out", "out/warped.nii.gz", "--interpolation", name, "--outside", "0"]
    assert run("apply", "transform.h5", "moving.nrrd", "--reference", "fixed.nrrd", *options) == 0
    ours = sitk.ReadImage("out/warped.nii.gz")
    np.testing.assert_allclose(
        sitk.GetArrayFromImage(ours), _resampled("moving.nrrd", "fixed.nrrd", "transform.h5", how), atol=0.02
    )
    np.testing.assert_allclose(ours.GetDirection(), sitk.ReadImage("fixed.nrrd").GetDirection(), atol=1e-6)


@pytest.mark.parametrize("out", ["warped.nii.gz", "warped.mha", "warped.nrrd"])
def test_labels_keep_values_and_type(folder, out):
    assert run("apply", "transform.h5", "labels.nrrd", "--out", out, "--interpolation", "nearest") == 0
    ours = sitk.GetArrayFromImage(sitk.ReadImage(out))
    assert ours.dtype == np.uint32
    theirs = _resampled("labels.nrrd", "fixed.nrrd", "transform.h5", sitk.sitkNearestNeighbor)
    assert (ours != theirs).mean() <= 2e-3  # points on the border of two voxels
    assert (ours > 0).mean() > 0.2


@pytest.mark.parametrize("name", ["nearest", "label"])
def test_labels_are_those_of_the_class(folder, name):
    """With `label`, neighbours decide together: among as many values as voxels it is still one of them."""
    assert run("apply", "transform.h5", "labels.nrrd", "--out", "warped.nrrd", "--interpolation", name) == 0
    labels, found = read_labels("labels.nrrd"), read_labels("warped.nrrd")
    assert (found.pixel_type, found.data.dtype) == ("uint32", torch.float64)
    assert torch.equal(found.data, read_transform("transform.h5").labels(labels, mode=name).data)
    assert set(found.data.unique().tolist()) <= {0.0, *labels.data.unique().tolist()}


def test_apply_takes_the_grid_of_the_transform(folder):
    assert run("apply", "transform.h5", "moving.nrrd", "--out", "a.nrrd") == 0
    assert run("apply", "transform.h5", "moving.nrrd", "--out", "b.nrrd", "--reference", "fixed.nrrd") == 0
    np.testing.assert_allclose(*(sitk.GetArrayFromImage(sitk.ReadImage(f"{n}.nrrd")) for n in "ab"), atol=1e-3)
    assert run("apply", "transform.h5", "moving.nrrd", "--out", "c.nrrd", "--outside", "-5") == 0
    assert read_image("c.nrrd").data.min() == -5
    beyond = read_image("c.nrrd").data == -5
    surrounded = read_image("a.nrrd").data[beyond].unique()
    assert surrounded.tolist() == surroundings(read_image("moving.nrrd")).tolist() != [0.0]
    assert run("apply", "transform.h5", "moving.nrrd", "--out", "d.nrrd", "--outside", "black") == 2


def test_apply_the_other_way(folder):
    options = ["--reference", "moving.nrrd", "--inverse", "--outside", "0", "--out", "back.nrrd"]
    assert run("apply", "transform.h5", "fixed.nrrd", *options) == 0
    assert run("invert", "transform.h5", "--out", "inverse.h5", "--quiet") == 0
    expected = _resampled("fixed.nrrd", "moving.nrrd", "inverse.h5", sitk.sitkLinear)
    np.testing.assert_allclose(read_image("back.nrrd").data[0, 0], expected, atol=0.02)


@pytest.mark.parametrize("ending", [".csv", ".mrk.json"])
def test_points_go_to_moving_and_back(folder, ending):
    assert run("points", "transform.h5", "points.csv", "--out", f"moved{ending}") == 0
    start, end = read_points("points.csv"), read_points(f"moved{ending}", dim=read_image("fixed.nrrd").grid.dim)
    itk = sitk.ReadTransform("transform.h5")
    theirs = [itk.TransformPoint(p) for p in start.positions.tolist()]
    np.testing.assert_allclose(end.positions.numpy(), theirs, atol=1e-4)
    assert end.names == start.names
    assert run("points", "transform.h5", f"moved{ending}", "--out", "back.csv", "--inverse") == 0
    assert (read_points("back.csv").positions - start.positions).norm(dim=1).max() < 0.1


def test_points_in_voxels(folder):
    dim = read_image("fixed.nrrd").grid.dim
    (folder / "voxels.csv").write_text(f"{','.join('ijk'[:dim])}\n{','.join('345'[:dim])}\n", encoding="utf-8")
    assert run("points", "u.nrrd", "voxels.csv", "--out", "out.csv") == 2
    assert run("points", "u.nrrd", "voxels.csv", "--out", "out.csv", "--reference", "fixed.nrrd") == 0
    index, u = (3, 4, 5)[:dim], read_displacement("u.nrrd")
    moved = u.grid.points(dtype=torch.float64) + u.data
    expected = u.to_world(moved)[(0, slice(None), *index[::-1])]
    torch.testing.assert_close(read_points("out.csv").positions[0], expected, atol=1e-4, rtol=0)


def test_invert_inverts(folder, capsys):
    assert run("invert", "transform.h5", "--out", "inverse.h5") == 0
    out = capsys.readouterr().out
    assert out.startswith("inverse consistency")
    assert out.endswith("written              inverse.h5\n")
    there, back = (sitk.ReadTransform(f"{name}.h5") for name in ("transform", "inverse"))
    for p in read_points("points.csv").positions.tolist():
        np.testing.assert_allclose(back.TransformPoint(there.TransformPoint(p)), p, atol=0.1)
    u = read_displacement("u.nrrd")
    assert run("invert", "u.nrrd", "--out", "w.nrrd") == 0
    torch.testing.assert_close(read_displacement("w.nrrd").data, invert(u.data, u.grid), atol=1e-3, rtol=0)
    assert run("invert", "affine.mat", "--out", "back.mat") == 0
    points = read_points("points.csv").positions
    chain = read_transform("affine.mat").then(read_transform("back.mat"))
    torch.testing.assert_close(chain.points(points), points, atol=1e-9, rtol=0)


def test_compose_keeps_the_order(folder):
    """Points go through the first one first: displacement, then affine, is what the chain's own file holds."""
    assert run("compose", "u.nrrd", "affine.mat", "--out", "both.h5") == 0
    points = read_points("points.csv").positions
    expected = read_transform("transform.h5").points(points)
    torch.testing.assert_close(read_transform("both.h5").points(points), expected, atol=1e-4, rtol=0)
    assert run("compose", "u.nrrd", "affine.mat", "--out", "both.nii.gz") == 0
    torch.testing.assert_close(read_transform("both.nii.gz").points(points), expected, atol=1e-3, rtol=0)
    assert run("compose", "affine.mat", "affine.mat", "affine.mat", "--out", "cubed.mat") == 0
    matrix = read_transform("cubed.mat").stages[0].matrix
    torch.testing.assert_close(matrix, torch.eye(len(matrix)).double() * 1.05**3)
    options = ["--out", "field.mha", "--reference", "moving.nrrd"]
    assert run("compose", "affine.mat", "u.nrrd", *options) == 0
    assert read_displacement("field.mha").grid.shape == read_image("moving.nrrd").grid.shape


def test_jacobian(folder, capsys):
    assert run("jacobian", "transform.h5", "--out", "det.nii.gz") == 0
    out = capsys.readouterr().out
    chain = read_transform("transform.h5")
    det = chain.jacobian_determinant().data
    torch.testing.assert_close(read_image("det.nii.gz").data.double(), det, atol=1e-5, rtol=0)
    assert f"{float(det.max()):.3g}" in out
    assert "folds                  0" in out
    assert "written                det.nii.gz" in out
    assert run("jacobian", "affine.mat", "--reference", "moving.nrrd", "--out", "a.nrrd", "--quiet") == 0
    affine = read_image("a.nrrd").data
    torch.testing.assert_close(affine, torch.full_like(affine, 1.05**chain.dim))


def test_a_picture_stays_one(tmp_path, monkeypatch, make_image, make_displacement, capsys):
    monkeypatch.chdir(tmp_path)
    picture = make_image((24, 30), channels=3, pixel_type="uint8")
    write_image(picture, "moving.png")
    write_transform(make_displacement(picture.grid, 0.1), picture, "t.h5")
    assert run("apply", "t.h5", "moving.png", "--out", "warped.png", "--interpolation", "cubic") == 0
    assert run("apply", "t.h5", "moving.png", "--out", "w.png", "--outside", "-5") == 2
    assert "moving.png is stored as uint8, which holds 0 to 255, so -5 does not fit" in capsys.readouterr().err
    warped = read_image("warped.png")
    assert (warped.pixel_type, tuple(warped.data.shape)) == ("uint8", (1, 3, 24, 30))


def test_what_is_read_is_never_replaced(volumes, capsys):
    before = {p.name: p.read_bytes() for p in volumes.iterdir()}
    (volumes / "link.nrrd").symlink_to("moving.nrrd")
    for arguments in (
        ["apply", "transform.h5", "moving.nrrd", "--out", "moving.nrrd"],
        ["apply", "transform.h5", "moving.nrrd", "--out", "./fixed.nrrd", "--reference", "fixed.nrrd"],
        ["apply", "transform.h5", "moving.nrrd", "--out", "link.nrrd"],
        ["points", "transform.h5", "points.csv", "--out", "points.csv"],
        ["invert", "transform.h5", "--out", "transform.h5"],
        ["compose", "u.nrrd", "affine.mat", "--out", "u.nrrd"],
        ["jacobian", "u.nrrd", "--out", "u.nrrd"],
    ):
        assert run(*arguments) == 2
        assert "is one of the files to read; choose another name" in capsys.readouterr().err
    (volumes / "link.nrrd").unlink()
    assert {p.name: p.read_bytes() for p in volumes.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["apply", "no.h5", "moving.nrrd", "--out", "o.nrrd"], "no.h5 does not exist"),
        (["apply", "transform.h5", "moving.nrd", "--out", "o.nrrd"], "did you mean 'moving.nrrd'?"),
        (["apply", "moving.nrrd", "moving.nrrd", "--out", "o.nrrd"], "no displacement field"),
        (["apply", "points.csv", "moving.nrrd", "--out", "o.nrrd"], "cannot be read as a transform"),
        (["apply", "affine.mat", "moving.nrrd", "--out", "o.nrrd"], "give --reference IMAGE"),
        (["apply", "affine.mat", "moving.nrrd", "--out", "o.nrrd", "--reference", "no.nrrd"], "no.nrrd does not exist"),
        (["apply", "transform.h5", "moving.nrrd", "--out", "o.doc"], "no ending that images are written with"),
        (["apply", "transform.h5", "labels.nrrd", "--out", "o.png", "--interpolation", "nearest"], "cannot hold"),
        (["apply", "transform.h5", "moving.nrrd", "--out", "o.nrrd", "--interpolation", "nearst"], "'nearest'?"),
        (["apply", "transform.h5", "moving.nrrd", "--out", "."], "no ending that images"),
        (["apply", "transform.h5", "moving.nrrd", "--out", "points.csv/o.nrrd"], "points.csv is not a folder"),
        (["apply", "transform.h5", "flat.nrrd", "--out", "o.nrrd"], "flat.nrrd is 2D but the transform is 3D"),
        (["apply", "transform.h5", "moving.nrrd", "--out", "o.nrrd", "--reference", "flat.nrrd"], "flat.nrrd is 2D"),
        (["apply", "transform.h5", "moving.nrrd", "--out", "o.nrrd", "--reference", "away.nrrd"], "lie apart"),
        (["apply", "transform.h5", "moving.nrrd"], "--out"),
        (["points", "transform.h5", "no.csv", "--out", "o.csv"], "no.csv does not exist"),
        (["points", "transform.h5", "points.csv", "--out", "o.xls"], "no ending that points are written with"),
        (["points", "transform.h5", "flat.csv", "--out", "o.csv"], "flat.csv holds 2D points, but 3D is needed"),
        (["invert", "transform.h5", "--out", "o.png"], "no ending that transforms are written with"),
        (["invert", "transform.h5", "--out", "o.mat"], "hold affine maps only"),
        (["invert", "transform.h5", "--out", "o.nii.gz"], "needs a grid"),
        (["compose", "u.nrrd", "--out", "o.h5"], "at least two transforms"),
        (["compose", "u.nrrd", "flat.mat", "--out", "o.h5"], "one dimension throughout"),
        (["jacobian", "affine.mat", "--out", "o.nrrd"], "give --reference IMAGE"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_sentence_and_leaves_nothing(volumes, capsys, arguments, message):
    write_image(
        Image(torch.rand(1, 1, 9, 9), replace(read_image("fixed.nrrd").grid, shape=(9, 9), spacing=())), "flat.nrrd"
    )
    write_image(replace(read_image("fixed.nrrd"), origin=(900.0, 0.0, 0.0)), "away.nrrd")
    write_transform(Transform((Affine.identity(2),)), "flat.mat")
    (volumes / "flat.csv").write_text("x,y\n1,2\n", encoding="utf-8")
    before = sorted(p.name for p in volumes.iterdir())
    assert run(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert sorted(p.name for p in volumes.iterdir()) == before


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission_is_named(volumes, capsys):
    (volumes / "locked").mkdir(mode=0o500)
    assert run("invert", "u.nrrd", "--out", "locked/out.h5") == 2
    assert "cannot write to locked" in capsys.readouterr().err


DIRECTIONS = {
    "apply": ["onto the grid of the fixed image", "Images go from moving to fixed", "points from fixed to moving"],
    "points": ["Points go from fixed to moving", "brings the moving image to the fixed one"],
    "invert": ["maps points from moving to fixed", "images from fixed to moving"],
    "compose": ["points go through FIRST, then SECOND", "images the other way"],
    "jacobian": ["Points go from fixed to moving", "moving volume over fixed volume"],
}


@pytest.mark.parametrize("verb", VERBS)
def test_help_says_which_way_points_and_images_go(verb, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    assert run(verb, "--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    for words in DIRECTIONS[verb]:
        assert words in text, text


def test_what_is_printed_is_what_register_reports(folder, capsys):
    """Folds, determinant and inverse consistency are those of the deformation, in voxels, whichever verb is asked."""
    chain = read_transform("transform.h5")
    u, grid = chain.stages[0].field.data, chain.stages[0].field.grid
    back = invert(u, grid)
    write_transform(replace(chain, stages=(Displacement(chain.stages[0].field), *chain.stages[1:])), "plain.h5")
    known, (mean, largest) = diagnose(u, grid), inverse_error(u, back, grid)
    assert run("jacobian", "transform.h5", "--out", "det.nii.gz", "--json") == 0
    found = json.loads(capsys.readouterr().out)["deformations"]
    assert found == [pytest.approx(describe_map(known))]
    for name in ("transform.h5", "plain.h5"):
        assert run("invert", name, "--out", "inverse.h5", "--json") == 0
        record = json.loads(capsys.readouterr().out)
        assert record["inverse_error_mean"] == pytest.approx(mean.item(), rel=1e-3)
        assert record["inverse_error_max"] == pytest.approx(largest.item(), rel=1e-3)


def test_folds_that_central_differences_miss_are_counted(tmp_path, monkeypatch, make_image, capsys):
    monkeypatch.chdir(tmp_path)
    image = make_image((20, 20))
    u = torch.zeros(1, 2, 20, 20)
    u[:, 0, 8:12:2] = 1.2  # every second row passes the next one
    write_transform(u, image, "t.h5")
    assert run("jacobian", "t.h5", "--out", "det.nii.gz", "--json") == 0
    assert json.loads(capsys.readouterr().out)["folds"] == int(diagnose(u, image.grid).folds) > 0


def test_every_verb_says_what_it_wrote(folder, capsys):
    for verb in (
        ("apply", "transform.h5", "moving.nrrd"),
        ("points", "transform.h5", "points.csv"),
        ("compose", "u.nrrd", "affine.mat"),
    ):
        out = f"new/{verb[0]}{'.csv' if verb[0] == 'points' else '.nrrd'}"
        assert run(*verb, "--out", out) == 0
        assert capsys.readouterr() == (f"written  {out}\n", "")
        assert run(*verb, "--out", out, "--quiet") == 0
        assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["linear", "cubic", "label", "nearest"])
def test_labels_are_not_mixed_in_silence(folder, capsys, name):
    assert run("apply", "transform.h5", "labels.nrrd", "--out", "a.nrrd", "--interpolation", name) == 0
    warned = capsys.readouterr().err
    assert ("labels.nrrd looks like labels" in warned) == (name in ("linear", "cubic"))
