"""The proof that others reproduce our images: SimpleITK's own resampler with the files we write."""

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.errors import InputError
from torchdeform.image import resample
from torchdeform.io import read_displacement, write_displacement, write_image, write_transform
from torchdeform.warp import compose, invert, max_voxels

SHAPES = {2: ((40, 52), (45, 38)), 3: ((18, 22, 26), (20, 17, 24))}
SPACINGS = {2: ((1.3, 0.7), (0.9, 1.1)), 3: ((2.2, 0.7, 1.1), (1.4, 1.3, 1.2))}
ORIGINS = {2: ((-8.0, 120.0), (-12.0, 117.0)), 3: ((-8.0, 120.0, 33.0), (-11.0, 117.0, 32.0))}


def _pair(make_image, dim, tilted, channels=1):
    fixed, moving = (
        make_image(shape, spacing, origin=origin, tilted=turn, channels=count)
        for shape, spacing, origin, turn, count in zip(
            SHAPES[dim], SPACINGS[dim], ORIGINS[dim], (tilted, False), (1, channels), strict=True
        )
    )
    return fixed, moving


def _resample(folder, fixed, moving, transform):
    write_image(fixed, folder / "fixed.nii.gz")
    write_image(moving, folder / "moving.nii.gz")
    like, image = (sitk.ReadImage(str(folder / f"{name}.nii.gz")) for name in ("fixed", "moving"))
    values = sitk.GetArrayFromImage(sitk.Resample(image, like, transform, sitk.sitkLinear, 0.0))
    return torch.from_numpy(values)


def _agree(ours, theirs):
    """Equal to 1e-3 of the intensity range, at every voxel."""
    assert (ours - theirs).abs().max() < 1e-3 * 200
    assert (ours == 0).any()  # some of the fixed grid looks past the moving image, as it often does
    assert (ours > 0).double().mean() > 0.3


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_displacement_file_gives_the_same_image_in_itk(tmp_path, make_image, make_displacement, dim, tilted):
    fixed, moving = _pair(make_image, dim, tilted)
    u = make_displacement(fixed.grid, 0.08)
    write_displacement(u, fixed, tmp_path / "displacement.nii.gz")
    field = sitk.ReadImage(str(tmp_path / "displacement.nii.gz"), sitk.sitkVectorFloat64)
    theirs = _resample(tmp_path, fixed, moving, sitk.DisplacementFieldTransform(field))
    _agree(resample(moving, fixed, u)[0, 0], theirs)


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_transform_file_gives_the_same_image_in_itk(tmp_path, make_image, make_displacement, dim, tilted):
    fixed, moving = _pair(make_image, dim, tilted)
    u = make_displacement(fixed.grid, 0.08)
    write_transform(u, fixed, tmp_path / "transform.h5")
    transform = sitk.ReadTransform(str(tmp_path / "transform.h5"))
    assert (transform.GetName(), transform.GetDimension()) == ("CompositeTransform", dim)
    _agree(resample(moving, fixed, u)[0, 0], _resample(tmp_path, fixed, moving, transform))


def test_colour_is_resampled_alike(tmp_path, make_image, make_displacement):
    fixed, moving = _pair(make_image, 2, True, channels=3)
    u = make_displacement(fixed.grid, 0.08)
    write_transform(u, fixed, tmp_path / "transform.h5")
    theirs = _resample(tmp_path, fixed, moving, sitk.ReadTransform(str(tmp_path / "transform.h5")))
    _agree(resample(moving, fixed, u)[0], theirs.movedim(-1, 0))


@pytest.mark.parametrize("dim", [2, 3])
def test_points_go_from_fixed_to_moving(tmp_path, make_image, make_displacement, dim):
    """A landmark of the fixed image goes to its world position plus the vector; the inverse brings it back."""
    fixed, _ = _pair(make_image, dim, tilted=True)
    u = make_displacement(fixed.grid, 0.05)
    index = (7, 9, 6)[:dim]
    points = fixed.grid.points(dtype=torch.float64)
    start, end = (fixed.to_world(p)[(0, slice(None), *index)].numpy() for p in (points, points + u))
    write_transform(u, fixed, tmp_path / "transform.h5")
    write_transform(invert(u, fixed.grid), fixed, tmp_path / "inverse.h5")
    forward, back = (sitk.ReadTransform(str(tmp_path / name)) for name in ("transform.h5", "inverse.h5"))
    np.testing.assert_allclose(forward.TransformPoint(start.tolist()), end, atol=1e-4)
    np.testing.assert_allclose(back.TransformPoint(end.tolist()), start, atol=0.02)


@pytest.mark.parametrize("ending", [".nii.gz", ".mha", ".nrrd"])
@pytest.mark.parametrize("dim", [2, 3])
def test_displacement_comes_back(tmp_path, make_image, make_displacement, dim, ending):
    fixed, _ = _pair(make_image, dim, tilted=True)
    u = make_displacement(fixed.grid, 0.08)
    write_displacement(u, fixed, tmp_path / f"u{ending}")
    back = read_displacement(tmp_path / f"u{ending}")
    torch.testing.assert_close(back.data, u, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(back.direction, fixed.direction, atol=1e-6)
    np.testing.assert_allclose(back.origin, fixed.origin, rtol=1e-6)


def test_displacement_of_itk_is_read_in_array_order(tmp_path, make_image):
    """ITK's own field of a pure shift along world x is a shift along the last array axis."""
    fixed = make_image((6, 8, 10), (3.0, 2.0, 1.0))
    field = np.zeros((6, 8, 10, 3))
    field[..., 0] = 2.5
    image = sitk.GetImageFromArray(field, isVector=True)
    image.SetSpacing(fixed.grid.spacing[::-1])
    sitk.WriteImage(image, str(tmp_path / "u.mha"))
    u = read_displacement(tmp_path / "u.mha").data
    assert u[0, :, 3, 3, 3].tolist() == [0.0, 0.0, 2.5]


def test_inverse_file_inverts(make_image, make_displacement):
    fixed, _ = _pair(make_image, 3, tilted=True)
    u = make_displacement(fixed.grid, 0.05)
    assert max_voxels(compose(u, invert(u, fixed.grid), fixed.grid), fixed.grid).item() < 1e-3


def test_wrong_fields_are_refused(tmp_path, make_image, make_displacement):
    fixed, _ = _pair(make_image, 2, tilted=False)
    u = make_displacement(fixed.grid)
    with pytest.raises(InputError, match="batch of 2"):
        write_displacement(torch.cat((u, u)), fixed, tmp_path / "u.nii.gz")
    with pytest.raises(InputError, match="must have shape"):
        write_transform(u[:, :, 1:], fixed, tmp_path / "u.h5")
    with pytest.raises(InputError, match=r"use the ending .h5"):
        write_transform(u, fixed, tmp_path / "u.xyz")
    write_image(fixed, tmp_path / "image.mha")
    with pytest.raises(InputError, match="no displacement field"):
        read_displacement(tmp_path / "image.mha")
    (tmp_path / "text.txt").write_text("hello")
    with pytest.raises(InputError, match="cannot be read"):
        read_displacement(tmp_path / "text.txt")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["image.mha", "text.txt"]
