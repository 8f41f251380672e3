"""Points in the dialects of spreadsheets and of programs for landmarks: the same three points from all."""

import numpy as np
import pytest
import SimpleITK as sitk

from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.io.point_tables import FIXED, MOVING
from torchdeform.io.points import read_points

ROWS = [[1.0, 2.0, 3.0], [10.5, -5.0, 4.0], [-8.0, 7.0, 10.0]]
COMMAS = "1,2,3\n10.5,-5,4\n-8,7,10\n"
SAME = {
    "blanks.csv": "x y z\n1 2 3\n10.5   -5 4\n  -8 7 10\n",
    "tabs.csv": "x\ty\tz\n" + COMMAS.replace(",", "\t"),
    "commas.tsv": "x,y,z\n" + COMMAS,
    "titles.txt": "x y z\n" + COMMAS.replace(",", " "),
    "comment.txt": "# x y z\n" + COMMAS.replace(",", " "),
    "separator.csv": "sep=;\nx;y;z\n" + COMMAS.replace(",", ";"),
    "separator.tsv": "sep=,\r\nx,y,z\r\n" + COMMAS,
    "decimal_commas.csv": "x;y;z\n1,0;2;3\n10,5;-5,0;4\n-8;7;1,0e1\n",
    "decimal_commas.tsv": "x\ty\tz\n1,0\t2\t3\n10,5\t-5,0\t4\n-8\t7\t10\n",
    "capitals.csv": "X,Y,Z\n" + COMMAS,
    "units.csv": "X (mm),y_mm,z [mm]\n" + COMMAS,
    "positions.csv": "Pos X,Pos Y,Pos Z\n" + COMMAS,
    "micrometres.csv": "Centroid X µm,Centroid Y µm,Centroid Z µm\n"
    "1000,2000,3000\n10500,-5000,4000\n-8000,7000,10000\n",
    "ras.csv": "R,A,S\n-1,-2,3\n-10.5,5,4\n8,-7,10\n",
    "ras_other_order.csv": "S,R,A\n3,-1,-2\n4,-10.5,5\n10,8,-7\n",
    "lps.csv": "l,p,s\n" + COMMAS,
    "imagej.csv": " ,Area,Mean,X,Y,Z\n1,0,7,1,2,3\n2,0,7,10.5,-5,4\n3,0,7,-8,7,10\n",
    "trailing_commas.csv": "x,y,z\n1,2,3,,\n10.5,-5,4,\n-8,7,10\n,,\n",
    "quoted.csv": '"x","y","z"\r\n"1","2","3"\r\n"10.5","-5","4"\r\n"-8","7","10"\r\n',
    "outputpoints.txt": "".join(
        f"Point\t{k}\t; InputIndex = [ 0 0 0 ]\t; InputPoint = [ 9 9 9 ]\t; OutputIndexFixed = [ 1 1 1 ]\t; "
        f"OutputPoint = [ {x:f} {y:f} {z:f} ]\t; Deformation = [ 1 2 3 ]\n"
        for k, (x, y, z) in enumerate(ROWS)
    ),
}


@pytest.mark.parametrize("name", SAME)
def test_three_points_in_every_dialect(tmp_path, name):
    (tmp_path / name).write_text(SAME[name], encoding="utf-8", newline="")
    assert read_points(tmp_path / name).positions.tolist() == ROWS


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_names_in_every_coding(tmp_path, coding):
    text = "name;x;y;z\nHöhe;1;2;3\nÄöü ß;10,5;-5;4\nk;-8;7;10\n"
    (tmp_path / "p.csv").write_bytes(text.encode(coding))
    points = read_points(tmp_path / "p.csv")
    assert points.names == ("Höhe", "Äöü ß", "k")
    assert points.positions.tolist() == ROWS


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("napari.csv", "index,axis-0,axis-1,axis-2\n0,3,2,1\n1,4,6.5,5\n"),
        ("voxels.csv", "name,i,j,k\n0,1,2,3\n1,5,6.5,4\n"),
        ("dirlab.txt", "i1 j1 k1\n2 3 4\n6 7.5 5\n"),
        ("pixels.csv", "x (px);y (px);z (px)\n1;2;3\n5;6,5;4\n"),
        ("elastix.txt", "index\n2\n1 2 3\n5 6.5 4\n"),
    ],
)
def test_voxels_as_itk_counts(tmp_path, make_image, name, text):
    image = make_image((9, 8, 7), (2.0, 0.7, 1.1), origin=(5.0, -6.0, 7.0), tilted=True)
    write_image(image, tmp_path / "image.mha")
    itk = sitk.ReadImage(str(tmp_path / "image.mha"))
    (tmp_path / name).write_text(text, encoding="utf-8")
    theirs = [itk.TransformContinuousIndexToPhysicalPoint(index) for index in ([1.0, 2.0, 3.0], [5.0, 6.5, 4.0])]
    np.testing.assert_allclose(read_points(tmp_path / name, image).positions.numpy(), theirs, atol=1e-5)
    with pytest.raises(InputError, match="counts in voxels; give the image"):
        read_points(tmp_path / name)


def test_flat_voxels_of_napari(tmp_path, make_image):
    (tmp_path / "p.csv").write_text("index,axis-0,axis-1\n0,2,1\n", encoding="utf-8")
    assert read_points(tmp_path / "p.csv", make_image((8, 9), (2.0, 3.0))).positions.tolist() == [[3.0, 4.0]]


@pytest.mark.parametrize("dim", [2, 3])
def test_pairs_of_bigwarp(tmp_path, dim):
    """The moving point comes first; pairs that are switched off, or have one point only, are left out."""
    moving, fixed = [row[:dim] for row in ROWS[:2]], [[x + 1 for x in row[:dim]] for row in ROWS[:2]]
    rows = [["Pt-0", "true", *moving[0], *fixed[0]], ["Pt-1", "false", *["Infinity"] * dim, *[9] * dim],
            ["Pt-2", "true", *moving[1], *fixed[1]]]  # fmt: skip
    path = tmp_path / "landmarks.csv"
    path.write_text("".join(",".join(f'"{cell}"' for cell in row) + "\n" for row in rows), encoding="utf-8")
    for side, positions in ((MOVING, moving), (FIXED, fixed)):
        points = read_points(path, side=side)
        assert points.positions.tolist() == positions
        assert points.names == ("Pt-0", "Pt-2")
