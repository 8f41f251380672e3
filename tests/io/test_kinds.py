"""What a file holds is told by its content."""

import gzip

import numpy as np
import pytest
from broken_files import SHAPE, meta_image, nrrd_image, save, volume

from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.kinds import kind_of, known_otherwise

WRITTEN = {
    "a.nii": "nifti", "a.nii.gz": "nifti", "a.mha": "meta", "a.mhd": "meta", "a.nrrd": "nrrd", "a.nhdr": "nrrd",
    "a.png": "", "a.tif": "", "a.dcm": "", "a.vtk": "", "a.gipl": "",
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_kinds_under_any_name(tmp_path, name):
    flat = name[2:] in ("png", "jpg", "bmp", "dcm")
    save(volume("uint8", (30, 40) if flat else SHAPE), tmp_path / name)
    (tmp_path / name).rename(tmp_path / "download")
    assert kind_of(tmp_path / "download") == WRITTEN[name]


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        ("Nifti1Image", "nifti"),
        ("Nifti2Image", "nifti"),
        ("Nifti1Pair", "nifti"),
        ("Nifti2Pair", "nifti"),
        ("AnalyzeImage", "analyze"),
        ("MGHImage", "mgh"),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_what_nibabel_writes(tmp_path, make, kind, packed):
    nibabel = pytest.importorskip("nibabel")
    image = getattr(nibabel, make)(volume(), np.eye(4))
    files = image.make_file_map()
    image.to_file_map({key: type(files["image"])(filename=str(tmp_path / key)) for key in files})
    header = (tmp_path / ("header" if "header" in files else "image")).read_bytes()
    (tmp_path / "x").write_bytes(gzip.compress(header, mtime=0) if packed else header)
    assert kind_of(tmp_path / "x") == ("gzip" if packed and kind == "analyze" else kind)


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (meta_image(), "meta"),
        (b"Comment = by hand\n" + meta_image(), "meta"),
        (nrrd_image(), "nrrd"),
        (gzip.compress(meta_image(), mtime=0), "gzip"),
        (gzip.compress(b"x" * 1000, mtime=0)[:20], "gzip"),
        (b"\x1f\x8bnonsense", "gzip"),
        (b"\0\0\0\1" + bytes(300), ""),
        (b"words", ""),
        (b"", ""),
    ],
)
def test_kinds_by_content(tmp_path, content, kind):
    (tmp_path / "x.png").write_bytes(content)
    assert kind_of(tmp_path / "x.png") == kind


@pytest.mark.parametrize(
    ("content", "what"), [(b"PK\3\4", "is a ZIP archive"), (b"<HTML>", "is a web page"), (b"words", "")]
)
def test_what_is_no_image_at_all(tmp_path, content, what):
    (tmp_path / "x").write_bytes(content)
    assert known_otherwise(tmp_path / "x").startswith(what)


def test_zeros_are_no_image_and_a_bomb_of_them_is_not_unpacked(tmp_path, monkeypatch):
    """A file of zeros is what a broken download leaves; packed, it would fill the disk before anybody looked."""
    (tmp_path / "a.nii").write_bytes(bytes(9000))
    (tmp_path / "a.mha.gz").write_bytes(gzip.compress(bytes(9000), mtime=0))
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(bytes(257) + b"ustar" + bytes(9000), mtime=0))
    monkeypatch.setattr("torchdeform.io.images.unpack", None)
    for name, message in (
        ("a.nii", "zero bytes"),
        ("a.mha.gz", "zero bytes"),
        ("a.tar.gz", "is a tar archive; unpack"),
    ):
        with pytest.raises(InputError, match=message):
            read_image(tmp_path / name)
