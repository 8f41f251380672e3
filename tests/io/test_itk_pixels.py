"""Pixels that ITK reads in another process."""

from contextlib import suppress

import numpy as np
import pytest
import SimpleITK as sitk

from torchdeform.io.isolated import isolated
from torchdeform.io.itk_pixels import itk_pixels


def test_pixels_are_those_of_itk(tmp_path):
    values = np.random.default_rng(0).integers(0, 65535, (20, 30)).astype(np.uint16)
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / "a.tif"), True)
    path = tmp_path / "a.tif"
    assert np.array_equal(itk_pixels(str(path)), values)
    assert np.array_equal(isolated(itk_pixels, str(path), path=path), values)


def test_warnings_are_as_before_afterwards(tmp_path):
    """What is read next in the same process may tell a fault by them."""
    sitk.WriteImage(sitk.Image(20, 30, sitk.sitkUInt8), str(tmp_path / "a.tif"))
    before = sitk.ProcessObject.GetGlobalWarningDisplay()
    for path in (tmp_path / "a.tif", tmp_path / "none.tif"):
        with suppress(RuntimeError):
            itk_pixels(str(path))
        assert sitk.ProcessObject.GetGlobalWarningDisplay() == before


def test_what_is_made_up_is_an_error(tmp_path, capfd):
    values = np.random.default_rng(0).integers(0, 65535, (400, 300)).astype(np.uint16)
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / "a.tif"))
    content = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(content[: len(content) // 2])
    with pytest.raises((RuntimeError, ValueError)):
        itk_pixels(str(tmp_path / "a.tif"))
    assert capfd.readouterr() == ("", "")
