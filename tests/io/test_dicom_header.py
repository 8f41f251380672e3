"""Headers of DICOM: recognised with or without magic bytes, and read safely whatever is in them."""

import random
import re
import struct
import subprocess
import sys
import zlib
from contextlib import suppress

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_files import enhanced, item, picture, save, volume
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)

from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.dicom_header import is_dicom, read
from torchdeform.io.images import image_size

SYNTAXES = [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian]
GREY = volume(1)[0]


@pytest.mark.parametrize("name", ["a.dcm", "a.IMA", "a", "a.1"])
@pytest.mark.parametrize("syntax", SYNTAXES)
def test_by_content_whatever_the_name(tmp_path, name, syntax):
    path = save(picture(GREY), tmp_path / name, syntax)
    assert is_dicom(path)
    assert read_image(path).grid.shape == GREY.shape


@pytest.mark.parametrize("meta", [True, False])
@pytest.mark.parametrize("syntax", SYNTAXES[:2])
def test_without_the_magic_bytes(tmp_path, syntax, meta):
    data = picture(GREY, ImageType=["ORIGINAL", "PRIMARY"])
    path = save(data, tmp_path / "a.dcm", syntax)
    content = path.read_bytes()[132:]
    if not meta:  # as old files are: the first element is of the data set
        content = content[12 + struct.unpack_from("<I", content, 8)[0] :]
    (tmp_path / "b").write_bytes(content)
    assert is_dicom(tmp_path / "b")
    assert np.array_equal(read_image(tmp_path / "b").data[0, 0].numpy(), GREY)


@pytest.mark.parametrize(
    "content", [b"\x08\0", b"\x08\0\x08\0hello", bytes(200), b"\x02\0\0\0\0\0\0\x7f", b"text" * 50]
)
def test_other_files_are_none(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    assert not is_dicom(tmp_path / "a")


@pytest.mark.parametrize(
    ("elements", "spacing"),
    [
        ({"PixelSpacing": [0.5, 0.25]}, (0.5, 0.25)),
        ({"ImagerPixelSpacing": [0.5, 0.25]}, (0.5, 0.25)),
        ({"PixelSpacing": [1, 2], "ImagerPixelSpacing": [0.5, 0.25]}, (1.0, 2.0)),
        ({"NominalScannedPixelSpacing": [0.5, 0.25]}, (0.5, 0.25)),
        (
            {
                "SequenceOfUltrasoundRegions": item(
                    PhysicalDeltaX=0.025, PhysicalDeltaY=-0.05, PhysicalUnitsXDirection=3, PhysicalUnitsYDirection=3
                )
            },
            (0.5, 0.25),
        ),
    ],
)
def test_spacing_is_that_of_rows_then_columns(tmp_path, elements, spacing):
    image = read_image(save(picture(GREY, **elements), tmp_path / "a.dcm"))
    assert (image.grid.spacing, image.unit) == (spacing, "mm")


def test_without_any_spacing_pixels_are_the_unit(tmp_path):
    region = item(PhysicalDeltaX=0.1, PhysicalDeltaY=0.1, PhysicalUnitsXDirection=4)  # seconds
    assert read_image(save(picture(GREY, SequenceOfUltrasoundRegions=region), tmp_path / "a.dcm")).unit == "px"


def test_rounded_directions_become_square(tmp_path):
    data = picture(volume(4), PixelSpacing=[1, 1], SpacingBetweenSlices=2.0, ImagePositionPatient=[0, 0, 0])
    data.ImageOrientationPatient = [0.87, 0.5, 0.01, -0.49, 0.87, 0]
    axes = np.array(read_image(save(data, tmp_path / "a.dcm")).direction)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[:, 0], np.array([0.87, 0.5, 0.01]) / np.linalg.norm([0.87, 0.5, 0.01]))


def nested(depth, undefined=True):
    """Return a sequence within a sequence within a sequence, 200 thousand times."""
    start = struct.pack("<HH2sHI", 8, 0x1140, b"SQ", 0, 0xFFFFFFFF) + struct.pack("<HHI", 0xFFFE, 0xE000, 0xFFFFFFFF)
    end = struct.pack("<HHI", 0xFFFE, 0xE00D, 0) + struct.pack("<HHI", 0xFFFE, 0xE0DD, 0)
    return start * depth + end * depth * undefined


def hostile(tmp_path, body):
    content = save(picture(GREY), tmp_path / "sound.dcm").read_bytes()
    (tmp_path / "sound.dcm").unlink()
    where = content.index(struct.pack("<HH", 8, 0x16) + b"UI")
    path = tmp_path / "a.dcm"
    path.write_bytes(content[:where] + body + content[where:])
    return path


@pytest.mark.parametrize(
    "body",
    [
        nested(20_000),
        nested(20_000, undefined=False),
        struct.pack("<HH2sHI", 8, 0x15, b"UN", 0, 0xFFFFFFFE),
        struct.pack("<HH2sHI", 8, 0x15, b"OB", 0, 0xFFFFFFFF),
        struct.pack("<HH2sHI", 8, 0x15, b"SQ", 0, 0xFFFFFFFF) + bytes(64),
    ],
)
def test_hostile_headers_are_one_sentence(tmp_path, body):
    path = hostile(tmp_path, body)
    with pytest.raises(
        InputError, match=r"a\.dcm (is damaged|holds no DICOM image|takes more memory than .* it may be damaged)"
    ) as error:
        read_image(path)
    assert "\n" not in str(error.value)
    assert image_size(path) is None


def test_a_hostile_file_ends_no_process(tmp_path):
    path = hostile(tmp_path, nested(40_000))
    code = f"from torchdeform.cli.main import main; raise SystemExit(main(['{path}', '{path}']))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "start",
    [
        struct.pack("<HH2sHI", 8, 0x1140, b"SQ", 0, 0xFFFFFFFF) + struct.pack("<HHI", 0xFFFE, 0xE000, 0xFFFFFFFF),
        struct.pack("<HHI", 8, 0x1140, 0xFFFFFFFF) + struct.pack("<HHI", 0xFFFE, 0xE000, 0xFFFFFFFF),
        b"\x08\0anything",
    ],
)
@pytest.mark.parametrize("name", ["a.dcm", "a.mha", "a"])
def test_what_itk_would_take_for_dicom_never_reaches_it(tmp_path, name, start):
    """ITK shows every file to GDCM, which crashes at some without magic bytes."""
    (tmp_path / name).write_bytes(start * 20_000)
    with pytest.raises(InputError, match=re.escape(name)):
        read_image(tmp_path / name)
    assert image_size(tmp_path / name) is None


def test_a_header_that_keeps_pydicom_busy_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr("torchdeform.io.dicom_header.SECONDS", 0.5)
    (tmp_path / "a").write_bytes((b"DICM" + struct.pack("<HH2sHI", 8, 0x1140, b"SQ", 0, 0xFFFFFFFF)) * 20_000)
    with pytest.raises(InputError, match=r"a keeps its reader busy for more than \d s, so it is damaged"):
        read_image(tmp_path / "a")


def test_a_volume_of_512_columns_of_another_format(tmp_path):
    """Its first two bytes are those of DICOM without a preamble."""
    image = sitk.Image([512, 3, 2], sitk.sitkUInt8)
    sitk.WriteImage(image, str(tmp_path / "a.gipl"))
    assert (tmp_path / "a.gipl").read_bytes().startswith(b"\x02\0")
    assert read_image(tmp_path / "a.gipl").grid.shape == (2, 3, 512)


def test_what_is_packed_small_and_becomes_large(tmp_path, monkeypatch):
    path = save(picture(GREY), tmp_path / "a.dcm", DeflatedExplicitVRLittleEndian)
    content = path.read_bytes()
    start = 144 + struct.unpack_from("<I", content, 140)[0]
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    path.write_bytes(content[:start] + packer.compress(bytes(200_000_000)) + packer.flush())
    monkeypatch.setattr("torchdeform.io.gate.available", lambda: 50_000_000)
    with pytest.raises(InputError, match=r"takes, by its header, .* of memory and 50 MB are free"):
        read(path)


def test_headers_say_no_pixels_that_are_not_there(tmp_path, monkeypatch):
    path = save(picture(GREY, Rows=60000, Columns=60000), tmp_path / "a.dcm")
    with pytest.raises(InputError, match="far more than it can hold"):
        read_image(path)


@pytest.mark.parametrize("seed", range(60))
def test_mutated_files_are_read_or_refused(tmp_path, seed):
    draw = random.Random(seed)
    content = bytearray(enhanced(tmp_path / "a.dcm", volume(4)[:, :6, :8].copy()).read_bytes())
    for _ in range(draw.choice((1, 4, 16))):
        content[draw.randrange(132, len(content))] = draw.choice((0, 255, draw.randrange(256)))
    if draw.random() < 0.2:
        del content[draw.randrange(132, len(content)) :]
    (tmp_path / "a.dcm").write_bytes(content)
    with suppress(InputError):
        assert bool(read_image(tmp_path / "a.dcm").data.isfinite().all())


def test_the_helper_writes_what_the_standard_asks(tmp_path):
    """So that these tests are about files that others have, too."""
    again = pydicom.dcmread(enhanced(tmp_path / "a.dcm", volume()))
    assert len(again.PerFrameFunctionalGroupsSequence) == again.NumberOfFrames == 10
