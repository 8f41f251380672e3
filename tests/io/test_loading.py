"""Files read by ITK, in this process or another."""

import numpy as np
import pytest
import SimpleITK as sitk
from broken_files import save, volume

from torchdeform.errors import InputError
from torchdeform.io.isolated import isolated
from torchdeform.io.loading import load, quietly, read_by_itk, reason, size_by_itk


def test_values_and_place_are_those_of_itk(tmp_path):
    image = sitk.GetImageFromArray(volume())
    image.SetSpacing((1, 2, 3))
    image.SetOrigin((4, 5, 6))
    image.SetDirection((0, -1, 0, 1, 0, 0, 0, 0, 1))
    sitk.WriteImage(image, str(tmp_path / "a.mha"))
    for found in (read_by_itk(tmp_path / "a.mha"), isolated(read_by_itk, tmp_path / "a.mha", path=tmp_path / "a.mha")):
        np.testing.assert_array_equal(found.values[..., 0], volume())
        assert (found.spacing, found.origin, found.size) == ((1, 2, 3), (4, 5, 6), (11, 10, 9))
        assert found.direction.tolist() == [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert size_by_itk(tmp_path / "a.mha") == ((11, 10, 9), 1)


def test_the_reader_may_be_chosen(tmp_path):
    save(volume(), tmp_path / "a.mha")
    (tmp_path / "a.mha").rename(tmp_path / "a.png")
    assert load(tmp_path / "a.png", "MetaImageIO").GetSize() == (11, 10, 9)


def test_no_image(tmp_path, capfd):
    (tmp_path / "a.txt").write_text("words", encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.txt is no image of a known format; convert it"):
        read_by_itk(tmp_path / "a.txt")
    assert size_by_itk(tmp_path / "a.txt") is None
    assert capfd.readouterr() == ("", "")


def test_errors_are_returned_quietly():
    def fail() -> None:
        raise RuntimeError("a\nitk::ERROR: Reader(0x1): It failed. ")

    error = quietly(fail)
    assert isinstance(error, RuntimeError)
    assert reason(error) == "It failed"
    assert reason(RuntimeError("")) == "no reason given"


def test_announced_sizes_are_checked_before_pixels_are_read(tmp_path):
    head = "# vtk DataFile Version 3.0\nx\nBINARY\nDATASET STRUCTURED_POINTS\nDIMENSIONS 5000 5000 5000\n"
    rest = "SPACING 1 1 1\nORIGIN 0 0 0\nPOINT_DATA 125000000000\nSCALARS s unsigned_char 1\nLOOKUP_TABLE default\n"
    (tmp_path / "a.vtk").write_bytes((head + rest).encode() + bytes(1000))
    with pytest.raises(InputError, match="announces 125 GB of pixels, far more than it can hold"):
        read_by_itk(tmp_path / "a.vtk")


def test_vectors_on_a_fourth_axis(tmp_path):
    values = np.random.default_rng(0).random((3, 4, 5, 6)).astype(np.float32)
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=False), str(tmp_path / "a.mha"))
    found = read_by_itk(tmp_path / "a.mha", "", True)
    np.testing.assert_array_equal(np.moveaxis(found.values, -1, 0), values)
    assert (found.stacked, found.size, len(found.spacing), found.direction.shape) == (True, (6, 5, 4), 3, (3, 3))
    with pytest.raises(InputError, match="is a series of 3 volumes"):
        read_by_itk(tmp_path / "a.mha")
