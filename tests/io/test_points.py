"""Landmarks: the same points from every format, in LPS mm, and one sentence for what is wrong."""

import json
import string

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.io.points import Points, matched, read_points, write_points

ENDINGS = [".csv", ".tsv", ".txt", ".fcsv", ".mrk.json"]
LPS = [[1.5, -2.25, 3.0], [10.0, 20.0, -30.5]]


def _points(count=7, dim=3):
    positions = 300 * torch.randn(count, dim, dtype=torch.float64, generator=torch.manual_seed(0))
    return Points(positions, tuple(string.ascii_uppercase[:count]))


def _write(tmp_path, name, text):
    (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path / name


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ending", ENDINGS)
def test_points_come_back(tmp_path, ending, dim):
    """To the last bit, with their names where the format has any."""
    points = _points(dim=dim)
    write_points(points, tmp_path / f"new/points{ending}")
    back = read_points(tmp_path / f"new/points{ending}", dim=dim)
    assert torch.equal(back.positions, points.positions)
    assert back.positions.dtype == torch.float64
    assert back.named == (ending != ".txt")
    assert back.names == (points.names if back.named else tuple("1234567"))


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([".csv", ".tsv", ".fcsv", ".mrk.json"]),
    st.lists(st.text(string.ascii_letters + string.digits + " ,;\"'äµ_-", min_size=1).map(str.strip), unique=True),
)
def test_any_name_survives(tmp_path, ending, names):
    names = [name for name in names if name] or ["P"]
    positions = torch.randn(len(names), 3, dtype=torch.float64, generator=torch.manual_seed(1))
    write_points(Points(positions, tuple(names)), tmp_path / f"p{ending}")
    back = read_points(tmp_path / f"p{ending}")
    assert (back.names, back.positions.tolist()) == (tuple(names), positions.tolist())


MARKUP = {"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [
    {"id": "1", "label": "a", "position": LPS[0]}, {"id": "2", "label": "b", "position": LPS[1]}]}  # fmt: skip
RAS = [[-x, -y, z] for x, y, z in LPS]
RAS_MARKUP = MARKUP | {
    "coordinateSystem": "RAS",
    "coordinateUnits": ["mm", "UCUM", "length"],
    "controlPoints": [
        {"label": "a", "position": RAS[0]},
        {"label": "never placed", "position": [0, 0, 0], "positionStatus": "undefined"},
        {"label": "b", "position": RAS[1], "positionStatus": "defined"},
    ],
}
SAME = {
    "plain.csv": "x,y,z\n1.5,-2.25,3\n10,20,-30.5\n",
    "titleless.csv": "1.5,-2.25,3\n10,20,-30.5\n",
    "semicolons.csv": "X;Y;Z\n1.5;-2.25;3\n10;20;-30.5\n",
    "named.csv": "\ufeffZ, Y ,X,Name\n3,-2.25,1.5,a\n-30.5,20,10,b\n\n",
    "commented.csv": "# made by hand\n#,x,y,z\na,1.5,-2.25,3\nb,10,20,-30.5\n",
    "ants.csv": "x,y,z,t,label,comment\n1.5,-2.25,3,0,1,\n10,20,-30.5,0,1,\n",
    "tabs.tsv": "label\tx\ty\tz\na\t1.5\t-2.25\t3\nb\t10\t20\t-30.5\n",
    "elastix.txt": "point\n2\n1.5 -2.25 3\n1.0e+01 20 -30.5\n",
    "slicer5.fcsv": "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    '1,1.5,-2.25,3,0,0,0,1,1,1,0,a,,\n2,10,20,-30.5,0,0,0,1,1,1,0,"b",,\n',
    "slicer4.fcsv": "# Markups fiducial file version = 4.4\n# CoordinateSystem = 0\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    "vtkMRMLMarkupsFiducialNode_0,-1.5,2.25,3,0,0,0,1,1,1,0,a,,\nn_1,-10,-20,-30.5,0,0,0,1,1,1,0,b,,\n",
    "slicer4_lps.fcsv": "# CoordinateSystem = 1\n# columns = id,x,y,z,label\n1,1.5,-2.25,3,a\n2,10,20,-30.5,b\n",
    "slicer3.fcsv": "# Fiducial List file /tmp/f.fcsv\n# version = 2\n# columns = label,x,y,z,sel,vis\n"
    "a,-1.5,2.25,3,1,1\nb,-10,-20,-30.5,1,1\n",
    "lps.mrk.json": json.dumps({"markups": [MARKUP]}),
    "ras.mrk.json": json.dumps({"markups": [RAS_MARKUP]}),
}


@pytest.mark.parametrize("name", SAME)
def test_two_points_in_every_dialect(tmp_path, name):
    points = read_points(_write(tmp_path, name, SAME[name]))
    assert points.positions.tolist() == LPS
    nameless = ("plain", "titleless", "semicolons", "ants", "elastix")
    assert points.named is not name.startswith(nameless)
    assert points.names == (("a", "b") if points.named else ("1", "2"))


@pytest.mark.parametrize("name", ["ants.csv", "flat.fcsv", "plain.csv"])
def test_flat_points(tmp_path, name):
    """2D points with a third coordinate of zeros, where 2D is wanted or the file is one of ANTs."""
    text = {"ants.csv": "x,y,z,t\n1,2,0,0\n", "flat.fcsv": "1,-1,-2,0,1,1\n", "plain.csv": "x,y,z\n1,2,0\n"}[name]
    path = _write(tmp_path, name, text)
    assert read_points(path, dim=2).positions.tolist() == [[1.0, 2.0]]
    assert read_points(path).positions.shape == (1, 2 if name == "ants.csv" else 3)
    assert read_points(path, dim=3).positions.tolist() == [[1.0, 2.0, 0.0]]


@pytest.mark.parametrize("dim", [2, 3])
def test_voxel_indices_as_itk_counts(tmp_path, make_image, dim):
    """i, j, k run along x, y, z from 0 and may lie between voxels, in csv and in elastix files."""
    image = make_image((9, 8, 7)[:dim], (2.0, 0.7, 1.1)[:dim], origin=(5.0, -6.0, 7.0)[:dim], tilted=True)
    write_image(image, tmp_path / "image.mha")
    itk = sitk.ReadImage(str(tmp_path / "image.mha"))
    index = [[1.0, 2.0, 3.0][:dim], [0.5, 4.25, 6.0][:dim]]
    rows = [[repr(x) for x in row] for row in index]
    table = [",".join("IJK"[:dim]), *(",".join(row) for row in rows)]
    paths = [
        _write(tmp_path, "voxels.csv", "\n".join(table)),
        _write(tmp_path, "voxels.txt", "\n".join(["index", "2", *(" ".join(row) for row in rows)])),
    ]
    theirs = [itk.TransformContinuousIndexToPhysicalPoint(i) for i in index]
    for path in paths:
        np.testing.assert_allclose(read_points(path, image).positions.numpy(), theirs, atol=1e-5)
        with pytest.raises(InputError, match="counts in voxels; give the image"):
            read_points(path)


def test_matching_by_name():
    moving = _points(7)
    fixed = Points(moving.positions[:5], moving.names[:5])
    order = [3, 1, 6]
    moving = Points(moving.positions[order], tuple(moving.names[k] for k in order))
    one, other, names = matched(fixed, moving)
    assert names == ("B", "D")
    assert torch.equal(one, fixed.positions[[1, 3]])
    assert torch.equal(other, one)


def test_matching_by_order():
    fixed, moving = _points(4), Points(_points(4).positions + 1, tuple("1234"), named=False)
    one, other, names = matched(fixed, moving)
    assert names == fixed.names
    assert torch.equal(other, one + 1)


def test_what_cannot_be_matched_is_refused():
    fixed = _points(3)
    with pytest.raises(InputError, match="no name in common"):
        matched(fixed, Points(fixed.positions, tuple("xyz")))
    with pytest.raises(InputError, match="3 fixed but 2 moving points"):
        matched(fixed, Points(fixed.positions[:2], tuple("12"), named=False))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("p.docx", "x", "is no file of points; use one of .csv"),
        ("p.csv", "", "fetch or export it again"),
        ("p.csv", "x,y,z\n", "holds no points"),
        ("p.csv", "a,b,c\n1,2,3\n", "has no columns x, y"),
        ("p.csv", "1,2,3,4\n", "has no columns x, y"),
        ("p.csv", "x,y,z\n1,2\n", "has 2 of 3 columns"),
        ("p.csv", "x,y\n1,two\n", "are no coordinates"),
        ("p.csv", "x,y\n1,nan\n", "are no coordinates"),
        ("p.csv", "x,y\n1,inf\n", "are no coordinates"),
        ("p.csv", "x,y\n1,2,3\n", "has 3 of 2 columns"),
        ("p.csv", "x,y\n1_0,2\n", "are no coordinates"),
        ("p.csv", "x,y\n" + "9" * 400 + ",2\n", "are no coordinates"),
        ("p.csv", "x,y\n1e300,2\n", "are no coordinates"),
        ("p.csv", "x;y\n1,5;2.5\n", "are no coordinates"),
        ("p.csv", "x_mm,y_um\n1,2\n", "has columns in different units"),
        ("p.csv", "x (inch),y (inch)\n1,2\n", "has no columns x, y"),
        ("p.csv", 'x,y\n1,"' + "x" * 200_000, "line 2: field larger than field limit"),
        ("p.csv", '"Pt-0","true","1","2","3","2","3","4"\n', "holds points of two images, as BigWarp writes them"),
        ("p.txt", "1\t2\t3\n10\t-5\t4\n", "i1 j1 k1 for voxels from 1, as DIR-Lab counts$"),
        ("p.txt", "1.5 2 3\n", "numbers without titles, so their order and unit are unknown"),
        ("p.txt", "name x y z\nleft eye 1 2 3\n", "has 5 of 4 columns"),
        ("p.txt", "point\n" + "9" * 5000 + "\n1 2 3\n", "line 2 the count"),
        ("p.txt", "hello\n", "line 1 must be point or index"),
        ("p.txt", "point\nmany\n1 2 3\n", "line 1 must be point or index"),
        ("p.txt", "point\n2\n1 2 3\n", "announces 2 points"),
        ("p.txt", "point\n2\n1 2 3\n4 5\n", "has rows of other than 2 or 3 numbers"),
        ("p.txt", "point\n0\n", "holds no points"),
        ("p.fcsv", "# CoordinateSystem = 2\n1,2,3,4,1,1\n", "has coordinate system '2'"),
        ("p.fcsv", "# columns = a,b\n1,2\n", "names no columns x, y, z"),
        ("p.fcsv", "a,1,2\n", "has 3 of 4 columns"),
        ("p.mrk.json", "{", "is no valid JSON .*; give a file of markups from 3D Slicer"),
        ("p.mrk.json", '{"markups": [{"controlPoints": [{"position": [' + "1" * 400 + ', 2, 3]}]}]}', "of 400 digits"),
        ("p.mrk.json", '{"markups": [{"controlPoints": [{"position": [true, 2, 3]}]}]}', "are no coordinates"),
        ("p.mrk.json", "[]", "no file of markups"),
        ("p.mrk.json", '{"markups": [3]}', "no file of markups"),
        ("p.mrk.json", '{"markups": []}', "holds no points"),
        ("p.mrk.json", json.dumps({"markups": [MARKUP | {"coordinateUnits": "um"}]}), "has its points in 'um'"),
        ("p.mrk.json", json.dumps({"markups": [MARKUP | {"coordinateSystem": "IJK"}]}), "coordinate system 'IJK'"),
        ("p.mrk.json", '{"markups": [{"controlPoints": [{"position": [1, 2]}]}]}', "without 3 coordinates"),
        ("p.mrk.json", '{"markups": [{"controlPoints": [{"position": [1, 2, null]}]}]}', "are no coordinates"),
        ("p.mrk.json", '{"markups": [{"controlPoints": [{}]}]}', "no file of markups"),
    ],
)  # fmt: skip
def test_wrong_files_are_one_sentence(tmp_path, name, content, message):
    path = _write(tmp_path, name, content)
    with pytest.raises(InputError, match=message) as raised:
        read_points(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_wrong_places_and_dimensions_are_one_sentence(tmp_path, make_image):
    with pytest.raises(InputError, match="does not exist"):
        read_points(tmp_path / "no.csv")
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no text"):
        read_points(tmp_path / "binary.csv")
    path = _write(tmp_path, "p.csv", "x,y,z\n1,2,3\n")
    with pytest.raises(InputError, match="holds 3D points, but 2D is needed"):
        read_points(path, make_image((8, 8)))
    flat = _write(tmp_path, "flat.csv", "x,y\n1,2\n")
    with pytest.raises(InputError, match="holds 2D points, but 3D is needed"):
        read_points(flat, dim=3)
    with pytest.raises(InputError, match="holds 2D points, but image is 3D"):
        read_points(_write(tmp_path, "v.csv", "i,j\n1,2\n"), make_image((8, 8, 8)), dim=2)
    with pytest.raises(InputError, match="no ending that points are written with"):
        write_points(_points(), tmp_path / "p.xyz")
    assert not (tmp_path / "p.xyz").exists()


@pytest.mark.data
def test_real_landmarks(data_folder):
    lungs = [read_points(data_folder / "lung_ct_3d" / f"{side}_points.txt") for side in ("fixed", "moving")]
    fixed, moving, _ = matched(*lungs)
    assert fixed.shape == (51, 3)
    assert float((fixed - moving).norm(dim=1).mean()) == pytest.approx(35.3, abs=0.1)
    sections = [read_points(data_folder / "histology_2d" / f"{name}.csv") for name in ("1-he", "2-cd31")]
    fixed, moving, names = matched(*sections)
    assert (fixed[0].tolist(), names[:2]) == ([144.0, 36.0], ("1", "2"))
    assert 12 < float((fixed - moving).norm(dim=1).mean()) < 32
