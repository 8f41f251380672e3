"""Fields of vectors as images: components on the fifth axis or the fourth, those of FSL, and positions."""

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch
from itk_files import ORIGIN, SPACING, TURN, spline_of, written_image

from torchdeform.errors import InputError
from torchdeform.io import read_displacement
from torchdeform.io.transforms import read_transform


@pytest.fixture
def fixed(tmp_path):
    return written_image(tmp_path / "fixed.nii.gz")


def field_of(fixed, itk):
    return sitk.TransformToDisplacementField(
        itk, sitk.sitkVectorFloat32, fixed.GetSize(), fixed.GetOrigin(), fixed.GetSpacing(), fixed.GetDirection()
    )


def on_fourth_axis(path, field, intent=None):
    """Write a field as nibabel's users do: an array (x, y, z, 3)."""
    values = np.moveaxis(sitk.GetArrayFromImage(field), (0, 1, 2), (2, 1, 0))
    place = np.eye(4)
    place[:3, :3] = np.reshape(field.GetDirection(), (3, 3)) * field.GetSpacing()
    place[:3, 3] = field.GetOrigin()
    image = nibabel.Nifti1Image(values, np.diag([-1.0, -1.0, 1.0, 1.0]) @ place)
    if intent is not None:
        image.header["intent_code"] = intent
    nibabel.save(image, path)
    return path


@pytest.mark.parametrize("intent", [None, 1007])
@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
def test_a_field_on_the_fourth_axis(tmp_path, fixed, ending, intent):
    field = field_of(fixed, spline_of(fixed))
    sitk.WriteImage(field, str(tmp_path / "fifth.nii.gz"))
    fourth = on_fourth_axis(tmp_path / f"fourth{ending}", field, intent)
    one, other = read_displacement(fourth), read_displacement(tmp_path / "fifth.nii.gz")
    assert one.grid.shape == other.grid.shape
    np.testing.assert_allclose(one.grid.spacing, other.grid.spacing, rtol=1e-6)
    np.testing.assert_allclose(one.direction, other.direction, atol=1e-5)
    torch.testing.assert_close(one.data, other.data, atol=1e-5, rtol=0)


def test_a_flat_field_on_the_fourth_axis(tmp_path):
    values = np.random.default_rng(0).normal(size=(8, 7, 1, 2)).astype(np.float32)
    nibabel.save(nibabel.Nifti1Image(values, np.diag([-1.0, -1.0, 1.0, 1.0])), tmp_path / "a.nii.gz")
    u = read_displacement(tmp_path / "a.nii.gz")
    assert u.grid.shape == (7, 8)
    np.testing.assert_allclose(u.data[0].numpy(), values[:, :, 0, ::-1].T, atol=1e-6)


@pytest.mark.parametrize("code", [2006, 2007])
def test_a_warp_of_fsl_leads_to_the_command(tmp_path, fixed, code):
    path = on_fourth_axis(tmp_path / "warp.nii.gz", field_of(fixed, spline_of(fixed)), code)
    with pytest.raises(InputError, match=r"is a warp of FSL.*wb_command -convert-warpfield -from-fnirt warp\.nii\.gz"):
        read_transform(path)


@pytest.mark.parametrize("sign", [1, -1])
def test_positions_are_no_displacements(tmp_path, fixed, sign):
    field = field_of(fixed, spline_of(fixed, size=0.5))
    places = sitk.PhysicalPointSource(sitk.sitkVectorFloat32, fixed.GetSize(), ORIGIN, SPACING, TURN.ravel().tolist())
    values = (sitk.GetArrayFromImage(field) + sitk.GetArrayFromImage(places)) * np.float32([sign, sign, 1])
    moved = sitk.GetImageFromArray(values, isVector=True)
    moved.CopyInformation(fixed)
    with pytest.raises(InputError, match="holds positions, not displacements; subtract from each voxel its place"):
        read_transform(on_fourth_axis(tmp_path / "a.nii.gz", moved))


def test_a_series_of_volumes_is_no_field(tmp_path):
    nibabel.save(nibabel.Nifti1Image(np.zeros((6, 7, 8, 5), np.float32), np.eye(4)), tmp_path / "a.nii.gz")
    with pytest.raises(InputError, match="is a series of 5 volumes"):
        read_transform(tmp_path / "a.nii.gz")
