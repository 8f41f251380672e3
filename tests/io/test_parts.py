"""The files that an image is made of."""

import os
from pathlib import Path

import dicom_files
import numpy as np
import pytest
from broken_files import meta_image, nrrd_image, save, volume

from torchdeform.errors import InputError
from torchdeform.io.parts import files_of


def _names(path: Path) -> list[str]:
    return [file.name for file in files_of(path)]


def _split_meta(folder: Path, data: str, after: str = "") -> Path:
    """Write a header whose pixels are elsewhere, and slices 1 to 9 of its pixels."""
    head = meta_image(ElementDataFile=data)[: -volume().nbytes]
    (folder / "a.mhd").write_bytes(head + after.encode())
    for k, plane in enumerate(volume(), 1):
        (folder / f"s{k:02d}.raw").write_bytes(plane.tobytes())
    return folder / "a.mhd"


PLANES = [f"s{k:02d}.raw" for k in range(1, 10)]


@pytest.mark.parametrize("ending", [".mha", ".nrrd", ".nii", ".nii.gz", ".vtk", ".png", ".tif"])
def test_one_file(tmp_path, ending):
    save(volume("uint8", (30, 40)), tmp_path / f"a{ending}")
    assert _names(tmp_path / f"a{ending}") == [f"a{ending}"]


def test_one_file_of_pixels(tmp_path):
    for ending in (".mhd", ".nhdr"):
        save(volume(), tmp_path / f"a{ending}")
        assert _names(tmp_path / f"a{ending}") == [f"a{ending}", "a.raw"]


def test_a_list_of_files(tmp_path):
    assert _names(_split_meta(tmp_path, "LIST", "\n".join([*PLANES, ""]))) == ["a.mhd", *PLANES]


def test_a_pattern_of_files(tmp_path):
    assert _names(_split_meta(tmp_path, "s%02d.raw 1 9 1")) == ["a.mhd", *PLANES]


@pytest.mark.parametrize("data", ["s%02d.raw 1 9 1", "s%02d.raw 1 9 1 2", "LIST 2\n" + "\n".join(PLANES)])
def test_files_of_an_nrrd(tmp_path, data):
    _split_meta(tmp_path, "LOCAL")
    head = nrrd_image(data_file=data)[: -volume().nbytes]
    if "LIST" in data:  # it ends with the header, which no empty line may end
        head = head.rstrip() + b"\n"
    (tmp_path / "a.nhdr").write_bytes(head)
    assert _names(tmp_path / "a.nhdr") == ["a.nhdr", *PLANES]


def test_both_files_of_a_pair_from_either(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    nibabel.save(nibabel.Nifti1Pair(volume(), np.eye(4)), tmp_path / "a.img")
    assert _names(tmp_path / "a.hdr") == _names(tmp_path / "a.img") == ["a.hdr", "a.img"]


def test_a_folder_of_slices(tmp_path):
    """A slice of a volume is read with its series; other files of the folder have no part in it."""
    dicom_files.single(tmp_path, dicom_files.volume(9))
    slices = sorted(path.name for path in tmp_path.iterdir())
    dicom_files.save(dicom_files.picture(dicom_files.volume(1)[0], SeriesInstanceUID="1.2.4"), tmp_path / "other.dcm")
    (tmp_path / "notes.txt").write_text("no slice", encoding="utf-8")
    assert _names(tmp_path / slices[3]) == slices
    assert _names(tmp_path / "other.dcm") == ["other.dcm"]
    assert _names(tmp_path) == sorted([*slices, "other.dcm"])


def test_the_files_of_an_ome_tiff(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><TiffData>'
        '<UUID FileName="a.ome.tif">1</UUID><UUID FileName="b.ome.tif">2</UUID>'
        "</TiffData></OME>"
    )
    for name in ("a.ome.tif", "b.ome.tif"):
        tifffile.imwrite(tmp_path / name, volume("uint8", (30, 40)), description=xml, metadata=None)
    assert _names(tmp_path / "a.ome.tif") == ["a.ome.tif", "b.ome.tif"]
    tifffile.imwrite(tmp_path / "a.ome.tif", volume("uint8", (30, 40)), description=xml.replace("b.", "../b."))
    assert _names(tmp_path / "a.ome.tif") == ["a.ome.tif"]


@pytest.mark.parametrize(
    "data", ["../b.raw", "/etc/passwd", "pipe.raw", "absent.raw", "LIST", "%s%s 1 2 1", "%d 1 999999999 1"]
)
def test_what_is_not_beside_or_no_file_is_left_out(tmp_path, data):
    (tmp_path / "in").mkdir()
    (tmp_path / "b.raw").write_bytes(b"x")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "in" / "pipe.raw")
    (tmp_path / "in" / "a.mhd").write_bytes(meta_image(ElementDataFile=data)[: -volume().nbytes])
    assert _names(tmp_path / "in" / "a.mhd") == ["a.mhd"]


@pytest.mark.parametrize("name", ["absent.nii", "pipe.nii", "empty.nii"])
def test_no_file_is_an_error(tmp_path, name):
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.nii")
    (tmp_path / "empty.nii").touch()
    with pytest.raises(InputError, match=name):
        files_of(tmp_path / name)


def test_damaged_files_are_themselves(tmp_path):
    """Whatever bytes there are, the answer is the file or an `InputError`."""
    rng = np.random.default_rng(0)
    for start in (
        b"",
        b"NRRD0004\n",
        b"NDims = 3\n",
        b"II*\0\x08\0\0\0",
        b"\x1f\x8b\x08\0",
        b"\x5c\1\0\0",
        b"\0\0\0\1",
    ):
        (tmp_path / "a").write_bytes(start + rng.bytes(400))
        assert _names(tmp_path / "a") == ["a"]
