"""Transforms of other tools are applied as ITK applies them: splines, fields on a fourth axis, texts, bad files."""

import subprocess
import sys

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from itk_files import spline_of, written_image

from torchdeform.core.transform import Affine, Displacement
from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.transforms import read_transform


@pytest.fixture
def fixed(tmp_path):
    return written_image(tmp_path / "fixed.nii.gz")


EULER = sitk.Euler3DTransform((0, 0, 0), 0.1, -0.05, 0.2, (3, -2, 1))


@pytest.mark.parametrize("ending", [".h5", ".tfm"])
@pytest.mark.parametrize("kind", ["spline", "spline first", "spline last"])
def test_splines_move_points_as_in_itk(tmp_path, fixed, kind, ending):
    """In their domain, across its border and far outside."""
    spline = spline_of(fixed)
    itk = {
        "spline": spline,
        "spline first": sitk.CompositeTransform([EULER, spline]),
        "spline last": sitk.CompositeTransform([spline, EULER]),
    }[kind]
    sitk.WriteTransform(itk, str(tmp_path / f"a{ending}"))
    chain, draw = read_transform(tmp_path / f"a{ending}"), np.random.default_rng(1)
    assert sum(isinstance(stage, Displacement) for stage in chain.stages) == 1
    index = draw.uniform(-0.4, 1.4, (2000, 3)) * fixed.GetSize()
    points = [fixed.TransformContinuousIndexToPhysicalPoint(i) for i in index.tolist()]
    expected = np.array([itk.TransformPoint(p) for p in points])
    found = chain.points(torch.tensor(points, dtype=torch.float64)).numpy()
    assert np.linalg.norm(found - expected, axis=1).max() < 0.02
    assert np.linalg.norm(expected - points, axis=1).max() > 1


def test_an_image_through_a_spline(tmp_path, fixed):
    itk = sitk.CompositeTransform([EULER, spline_of(fixed)])
    sitk.WriteTransform(itk, str(tmp_path / "a.h5"))
    image = read_image(tmp_path / "fixed.nii.gz")
    ours = read_transform(tmp_path / "a.h5").image(image, image).data[0, 0].numpy()
    theirs = sitk.GetArrayFromImage(sitk.Resample(fixed, fixed, itk, sitk.sitkLinear, 0.0))
    edge = (ours == 0) != (theirs == 0)
    assert edge.mean() < 2e-3
    assert np.abs(ours - theirs)[~edge].max() < 0.5


def test_the_inverse_of_a_spline_is_that_of_a_field(tmp_path, fixed):
    sitk.WriteTransform(spline_of(fixed, size=0.3), str(tmp_path / "a.tfm"))
    chain = read_transform(tmp_path / "a.tfm")
    index = np.random.default_rng(1).uniform(0.2, 0.8, (200, 3)) * fixed.GetSize()
    points = torch.tensor([fixed.TransformContinuousIndexToPhysicalPoint(i) for i in index.tolist()])
    assert (chain.inverse().points(chain.points(points)) - points).norm(dim=1).max() < 0.02


def test_nested_composites(tmp_path, fixed):
    """As texts may hold them."""
    sitk.WriteTransform(sitk.CompositeTransform([EULER, spline_of(fixed)]), str(tmp_path / "a.tfm"))
    assert [type(stage) for stage in read_transform(tmp_path / "a.tfm").stages] == [Displacement, Affine]


def test_a_field_of_one_layer_is_refused(tmp_path):
    field = sitk.GetImageFromArray(np.zeros((1, 8, 8, 3)), isVector=True)
    sitk.WriteTransform(sitk.DisplacementFieldTransform(field), str(tmp_path / "a.h5"))
    with pytest.raises(InputError, match=r"a\.h5 has 3 components on a 2D grid, so it is no displacement"):
        read_transform(tmp_path / "a.h5")


def test_a_field_that_is_not_finite_is_refused(tmp_path):
    field = sitk.GetImageFromArray(np.full((5, 8, 2), np.nan), isVector=True)
    sitk.WriteTransform(sitk.DisplacementFieldTransform(field), str(tmp_path / "a.h5"))
    with pytest.raises(InputError, match=r"a\.h5 holds vectors that are not finite"):
        read_transform(tmp_path / "a.h5")


HUGE = "#Insight Transform File V1.0\nTransform: BSplineTransform_double_3_3\nParameters: 0\nFixedParameters: 1000000 "
BAD = {
    "huge.tfm": (HUGE + "1000000 1000000 0 0 0 1 1 1 1 0 0 0 1 0 0 0 1\n").encode(),
    "empty.h5": b"\x89HDF\r\n\x1a\n" + bytes(400),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_ends_no_process(tmp_path, name):
    (tmp_path / name).write_bytes(BAD[name])
    arguments = ["invert", str(tmp_path / name), "--out", str(tmp_path / "out.h5")]
    done = subprocess.run(
        [sys.executable, "-m", "torchdeform.cli.main", *arguments], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out.h5").exists()
