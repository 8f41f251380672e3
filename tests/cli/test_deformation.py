"""``grid``, ``reconstruct`` and ``simulate`` at the shell: what they write, what it means, and how they refuse."""

import json
import shlex

import pytest
import SimpleITK as sitk
import torch

import torchdeform as td
from torchdeform.cli.main import torchdeform
from torchdeform.core.image import Image, resample
from torchdeform.io import read_displacement, read_image, write_displacement, write_image


def _disc(grid: td.Grid, radius: float) -> torch.Tensor:
    middle = [side / 2 for side in grid.extent]
    x = grid.points() - grid.along(middle, grid.points())
    return (x.norm(dim=1, keepdim=True) < radius).float()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Images and labels of a disc and of a ball, and a displacement of each dimension."""
    monkeypatch.chdir(tmp_path)
    for dim, shape, spacing in ((2, (40, 32), (1.0, 1.5)), (3, (20, 18, 16), (2.0, 1.0, 1.0))):
        grid = td.Grid(shape, spacing)
        turned = ((0.0, 1.0), (-1.0, 0.0)) if dim == 2 else ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        place = Image(_disc(grid, min(grid.extent) / 4), grid, tuple(range(dim)), turned)
        write_image(place, f"disc{dim}.nii.gz")
        f = td.ball_monitor(grid, [side / 2 for side in grid.extent], min(grid.extent) / 4, 3.0)
        write_displacement(td.grid_from_target_monitor(f, grid), place, f"u{dim}.nii.gz")
    return tmp_path


def _run(line: str, code: int = 0) -> None:
    assert torchdeform(shlex.split(line)) == code


def _record(folder: str) -> dict:
    with open(f"{folder}/result.json", encoding="utf-8") as file:  # noqa: PTH123
        return json.load(file)


def _refused(line: str, capsys: pytest.CaptureFixture[str], tmp_path) -> str:
    before = sorted(p.name for p in tmp_path.iterdir())
    _run(line, code=2)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("torchdeform: ")
    assert err.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    return err


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("monitor", ["gradient", "curvature", "density"])
def test_grid_has_the_cells_that_its_monitor_asks_for(folder, capsys, dim, monitor):
    _run(f"grid disc{dim}.nii.gz --monitor {monitor} --f-min 0.5 --out grid")
    assert "folds" in capsys.readouterr().out
    record = _record("grid")
    assert record["folds"] == 0
    assert record["determinant_error_mean"] < 0.1
    u, f = read_displacement("grid/displacement.nii.gz"), read_image("grid/monitor.nii.gz")
    det = td.jacobian_determinant(u.data, u.grid)
    wanted = td.warp(f.data, u.data, u.grid)
    assert (det / wanted - 1).abs().mean() == pytest.approx(record["determinant_error_mean"], rel=0.05)
    assert sorted(p.name for p in (folder / "grid").iterdir()) == [
        "displacement.nii.gz",
        "grid.png",
        "monitor.nii.gz",
        "result.json",
    ]


def test_grid_takes_an_image_of_the_monitor_itself(folder):
    grid = td.Grid((30, 30))
    f = td.ring_monitor(grid, (14.5, 14.5), 7, 4)
    write_image(Image(f, grid), "f.nii.gz")
    _run("grid f.nii.gz --monitor value --smoothing 0 --out grid --quiet")
    assert _record("grid")["determinant_error_mean"] < 0.02


@pytest.mark.parametrize("dim", [2, 3])
def test_reconstruct_finds_the_map_again(folder, capsys, dim):
    _run(f"reconstruct u{dim}.nii.gz --steps 4 --refine --out again")
    assert "distance" in capsys.readouterr().out
    given, found = (read_displacement(name).data for name in (f"u{dim}.nii.gz", "again/displacement.nii.gz"))
    torch.testing.assert_close(found, given, atol=1e-5, rtol=0)
    torch.testing.assert_close(read_displacement("again/step_2.nii.gz").data, given / 2, atol=1e-5, rtol=0)
    assert _record("again")["distance_max"] < 1e-7
    assert len(list((folder / "again").glob("step_*.nii.gz"))) == 4


def test_reconstruct_names_its_folder_after_the_file(folder):
    _run("reconstruct u2.nii.gz --quiet")
    assert (folder / "u2-reconstructed" / "grids.png").stat().st_size > 0
    assert _record("u2-reconstructed")["distance_max"] > 1e-7


@pytest.mark.parametrize(("dim", "factor"), [(2, 0.8), (2, 1.25), (3, 0.8), (3, 1.25)])
def test_simulate_changes_the_volume_and_its_transform_pulls_the_image_back(folder, dim, factor):
    name = f"disc{dim}.nii.gz"
    _run(f"simulate {name} --labels {name} --volume 1={factor} --out new --quiet")
    record = _record("new")
    assert record["folds"] == 0
    assert record["volumes"] == [{"label": 1, "asked": factor, "reached": pytest.approx(factor, rel=5e-3)}]
    before, after = read_image(name), read_image("new/simulated.nii.gz")
    assert after.data.sum() / before.data.sum() == pytest.approx(factor, rel=0.06)  # a picture of some thousand voxels
    assert set(read_image("new/labels.nii.gz").data.unique().tolist()) == {0.0, 1.0}
    still, moving = sitk.ReadImage(name), sitk.ReadImage(name)
    theirs = sitk.Resample(moving, still, sitk.ReadTransform("new/transform.h5"), sitk.sitkLinear)
    ours = after.data[0, 0].numpy()
    assert abs(sitk.GetArrayFromImage(theirs) - ours).max() < 1e-3
    back = read_displacement("new/displacement.nii.gz")
    torch.testing.assert_close(resample(before, before, back.data).float(), after.data, atol=1e-3, rtol=0)


def test_simulate_leaves_a_rigid_mask_where_it_is(folder):
    grid = td.Grid((40, 32), (1.0, 1.5))
    mask = torch.zeros(1, 1, 40, 32)
    mask[..., :6, :] = 1
    place = read_image("disc2.nii.gz")
    write_image(Image(mask, grid, place.origin, place.direction), "mask.nii.gz")
    _run("simulate disc2.nii.gz --labels disc2.nii.gz --volume 1=0.9 --rigid-mask mask.nii.gz --out new --quiet")
    # the displacement written is an inverse, good to 1e-4 of a voxel
    assert read_displacement("new/displacement.nii.gz").data[..., :6, :].abs().max() < 3e-4


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("grid nothing.png", "nothing.png does not exist"),
        ("grid disc2.nii.gz --monitor gradeint", "did you mean 'gradient'"),
        ("grid disc2.nii.gz --velocity div-curl", "did you mean 'div_curl'"),
        ("grid disc2.nii.gz --f-min 0", "f_min"),
        ("grid disc2.nii.gz --smoothing -1", "smoothing"),
        ("grid disc2.nii.gz --monitor value --smoothing 0", "must be positive"),
        ("grid disc2.nii.gz --device tpu", "device"),
        ("grid disc2.nii.gz --out disc3.nii.gz", "not a folder"),
        ("reconstruct disc2.nii.gz", "no displacement field"),
        ("reconstruct u2.nii.gz --order 3", "order must be one of 2, 4"),
        ("reconstruct u2.nii.gz --steps 0", "steps"),
        ("simulate disc2.nii.gz --labels disc2.nii.gz", "--volume"),
        ("simulate disc2.nii.gz --labels disc2.nii.gz --volume 1", "17=0.95"),
        ("simulate disc2.nii.gz --labels disc2.nii.gz --volume 1=1.1 --volume 1=1.2", "twice"),
        ("simulate disc2.nii.gz --labels disc2.nii.gz --volume 1=0", "positive"),
        ("simulate disc2.nii.gz --labels disc2.nii.gz --volume 2=1.1", "label 2 does not occur"),
        ("simulate disc2.nii.gz --labels disc2.nii.gz --volume 1=90", "no volume"),
        ("simulate disc2.nii.gz --labels disc3.nii.gz --volume 1=1.1", "one grid"),
        ("simulate disc2.nii.gz --labels far.nii.gz --volume 1=1.1", "one place"),
        ("simulate disc2.nii.gz --labels half.nii.gz --volume 1=1.1", "no label image"),
    ],
)
def test_mistakes_are_refused_in_one_sentence(folder, capsys, tmp_path, line, sentence):
    place = read_image("disc2.nii.gz")
    write_image(Image(place.data, place.grid, (5.0, 5.0), place.direction), "far.nii.gz")
    write_image(Image(place.data / 2, place.grid, place.origin, place.direction), "half.nii.gz")
    assert sentence in _refused(line, capsys, tmp_path)
