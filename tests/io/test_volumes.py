"""Every format of volumes, under any name, compared with SimpleITK; and files that stop programs."""

import gzip
import os
import re
import shutil
import struct

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch
from broken_files import SHAPE, meta_image, nrrd_image, save, volume

from torchdeform.errors import InputError
from torchdeform.io import read_image, read_labels
from torchdeform.io.images import image_size
from torchdeform.io.volumes import read_volume

KINDS = [
    ".nii",
    ".nii.gz",
    ".mha",
    ".mhd",
    ".nrrd",
    ".nhdr",
    ".vtk",
    ".gipl",
    ".gipl.gz",
    ".mnc",
    ".hdf5",
    ".hdr",
    ".mrc",
]


def _tilted(kind: str = "int16") -> sitk.Image:
    image = sitk.GetImageFromArray(volume(kind))
    image.SetSpacing((0.5, 0.7, 2.0))
    image.SetOrigin((-12.0, 4.0, 30.0))
    return image


@pytest.mark.parametrize("ending", KINDS)
def test_values_and_place_are_those_of_itk(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    try:
        sitk.WriteImage(_tilted(), str(path))
        theirs = sitk.ReadImage(str(path))
    except RuntimeError:
        pytest.skip("this SimpleITK does not write it")
    image = read_image(path)
    np.testing.assert_array_equal(image.data[0, 0], sitk.GetArrayFromImage(theirs))
    np.testing.assert_allclose(image.grid.spacing, theirs.GetSpacing()[::-1], rtol=1e-6)
    np.testing.assert_allclose(image.origin, theirs.GetOrigin(), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.ravel(image.direction), theirs.GetDirection(), atol=1e-6)
    assert image_size(path) == (SHAPE, 1)


@pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".mha", ".nrrd", ".nhdr"])
@pytest.mark.parametrize("name", ["no_ending", "a.png", "a.nii.gz", "a.dcm", "a.tif", "a.txt.1"])
def test_any_name(tmp_path, ending, name):
    sitk.WriteImage(_tilted(), str(tmp_path / f"x{ending}"))
    expected = read_image(tmp_path / f"x{ending}")
    (tmp_path / f"x{ending}").rename(tmp_path / name)
    image = read_image(tmp_path / name)
    assert torch.equal(image.data, expected.data)
    assert (image.grid, image.origin, image.direction) == (expected.grid, expected.origin, expected.direction)


@pytest.mark.parametrize("ending", [".mha", ".nrrd", ".nii", ".hdf5"])
def test_labels_keep_every_value(tmp_path, ending):
    values = np.full(SHAPE, 2**24 + 1, np.int32)
    values[0] = 7
    save(values, tmp_path / f"a{ending}")
    np.testing.assert_array_equal(read_labels(tmp_path / f"a{ending}").data[0, 0], values)


HOSTILE = {
    "a.mha": meta_image(NDims="-3", DimSize="4 4 4", ElementType="MET_UCHAR"),
    "b.mha": meta_image(NDims="2000000000"),
    "c.mha": meta_image(ElementNumberOfChannels="2000000000"),
    "d.mha": meta_image(CompressedData="True", DimSize="2000 2000 2000"),
    "a.nrrd": b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2000 2000 2000\nencoding: raw\n\n" + bytes(64),
    "b.nrrd": nrrd_image(sizes="2000 2000 2000", encoding="gzip"),
    "c.nrrd": nrrd_image(data_file="%d.raw 1 999999999 1"),
    "d.nrrd": nrrd_image(data_file="/dev/zero"),
    "a.nii": struct.pack("<i36x8h14xhh", 348, 3, 30000, 30000, 30000, 1, 1, 1, 1, 16, 32) + bytes(400),
    "a.vtk": b"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET STRUCTURED_POINTS\nDIMENSIONS -4 4 4\n" + bytes(64),
    "a.hdf5": b"\x89HDF\r\n\x1a\n" + bytes(range(256)) * 8,
    "bomb.mha.gz": gzip.compress(meta_image(DimSize="900000 90000 9")),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_files_that_stop_programs(tmp_path, name):
    (tmp_path / name).write_bytes(HOSTILE[name])
    with pytest.raises(InputError, match=name):
        read_image(tmp_path / name)
    assert image_size(tmp_path / name) is None


@pytest.mark.parametrize("header", ["a.mhd", "a.nhdr"])
@pytest.mark.parametrize("data", ["pipe", "/dev/zero", "../b.raw", "folder"])
def test_pixels_that_are_no_file_beside(tmp_path, header, data):
    folder = tmp_path / "in"
    (folder / "folder").mkdir(parents=True)
    (tmp_path / "b.raw").write_bytes(volume().tobytes())
    os.mkfifo(folder / "pipe")
    content = meta_image(ElementDataFile=data) if header == "a.mhd" else nrrd_image(data_file=data)
    (folder / header).write_bytes(content[: -volume().nbytes])
    with pytest.raises(InputError, match=r"not beside it|is no file|is a folder"):
        read_image(folder / header)
    assert image_size(folder / header) is None


def test_a_link_to_a_file_below_is_followed(tmp_path):
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "b.raw").write_bytes(volume().tobytes())
    (tmp_path / "a.raw").symlink_to(tmp_path / "below" / "b.raw")
    (tmp_path / "a.mhd").write_bytes(meta_image(ElementDataFile="a.raw")[: -volume().nbytes])
    np.testing.assert_array_equal(read_image(tmp_path / "a.mhd").data[0, 0], volume())


NO_IMAGES = {
    "a.zip": (b"PK\3\4" + bytes(100), "is a ZIP archive; unpack it"),
    "a.nii.tar": (bytes(257) + b"ustar" + bytes(250), "is a tar archive; unpack it"),
    "a.nii.bz2": (b"BZh91AY&SY" + bytes(100), "is packed with bzip2; unpack it"),
    "a.nii.gz": (b"version https://git-lfs.github.com/spec/v1\n", "is a pointer of git-lfs, not the file; fetch it"),
    "b.nii.gz": (b"<!DOCTYPE html><html>", "is a web page, not the file; download"),
    "c.nii.gz": (gzip.compress(b"<html>404</html>"), "is a web page, not the file; download"),
    "a.pdf": (b"%PDF-1.7", "is a PDF; export"),
    "a.npy": (b"\x93NUMPY\1\0", "is an array of numpy without a place; write it as"),
    "a.raw": (bytes(100), r"holds pixels only; put its header \(.mhd, .nhdr or .hdr\) beside it"),
    "a.img": (bytes(100), "holds pixels only; put its header"),
}  # fmt: skip


@pytest.mark.parametrize("name", NO_IMAGES)
def test_what_people_give_instead(tmp_path, name):
    content, message = NO_IMAGES[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_image(tmp_path / name)


def test_pixels_know_their_header(tmp_path):
    save(volume(), tmp_path / "a.mhd")
    with pytest.raises(InputError, match=r"a\.raw holds pixels only; give its header, a\.mhd"):
        read_image(tmp_path / "a.raw")


@pytest.mark.parametrize("ending", [".nii", ".nii.gz", ".mgz", ".hdr", ".nrrd", ".mha", "", ".1"])
def test_the_command_that_takes_a_volume_out_of_a_series_works(tmp_path, monkeypatch, ending):
    """Whatever the name of the series, and whether ITK knows the format or nibabel does."""
    values = np.random.default_rng(0).random((6, 7, 8, 4)).astype(np.float32)
    path, affine = tmp_path / f"a{ending}", np.diag([2.0, 3.0, 4.0, 1.0])
    if ending in (".nrrd", ".mha"):
        sitk.WriteImage(sitk.GetImageFromArray(values.T, isVector=False), str(path))
    elif ending.startswith(".mg"):
        nibabel.save(nibabel.MGHImage(values, affine), path)
    else:
        whole = tmp_path / f"whole{ending if ending.startswith(('.n', '.h')) else '.nii.gz'}"
        nibabel.save((nibabel.Nifti1Pair if ending == ".hdr" else nibabel.Nifti1Image)(values, affine), whole)
        path = whole if ending == ".hdr" else whole.rename(path)
    with pytest.raises(InputError, match="is a series of 4 volumes") as error:
        read_volume(path)
    monkeypatch.chdir(tmp_path)
    if renamed := re.search(r"copy it to (\S+),", str(error.value)):
        shutil.copy(path, renamed[1])
    exec(str(error.value).partition("give that: ")[2], {"nibabel": nibabel, "SimpleITK": sitk})
    assert np.array_equal(read_volume(tmp_path / "frame.nii.gz").values[..., 0].T, values[..., 0])
