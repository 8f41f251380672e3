"""Headers of MetaImage: what ITK writes and what people write by hand."""

import os

import numpy as np
import pytest
import SimpleITK as sitk
from broken_files import META, meta_image, volume

from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.metaimage import metaimage_header


def _written(folder, content: bytes, name: str = "a.mha"):
    (folder / name).write_bytes(content)
    return folder / name


@pytest.mark.parametrize("ending", [".mha", ".mhd"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", ["uint8", "int16", "int32", "int64", "float32", "float64"])
@pytest.mark.parametrize("channels", [1, 3])
def test_what_itk_writes(tmp_path, ending, packed, kind, channels):
    values = np.stack([volume(kind)] * channels, -1) if channels > 1 else volume(kind)
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=channels > 1), str(tmp_path / f"a{ending}"), packed)
    header = metaimage_header(tmp_path / f"a{ending}")
    header.require_complete()
    assert (header.size, header.channels, header.width) == ((11, 10, 9), channels, np.dtype(kind).itemsize)
    assert header.packing == ("gzip" if packed else "raw")
    assert [file.name for file in header.files] == ([] if ending == ".mha" else ["a.zraw" if packed else "a.raw"])


@pytest.mark.parametrize("wrong", [name for name in META if name not in ("sheared axes", "a line", "four axes")])
def test_headers_without_sense(tmp_path, wrong):
    with pytest.raises(InputError, match=r"a\.mha"):
        metaimage_header(_written(tmp_path, meta_image(**META[wrong]))).require_complete()


@pytest.mark.parametrize(
    "changes",
    [{"NDims": "-3"}, {"NDims": "0"}, {"NDims": "6"}, {"ElementNumberOfChannels": "-1"}, {"HeaderSize": "-2"}],
)
def test_counts_without_sense(tmp_path, changes):
    with pytest.raises(InputError, match=r"a\.mha has the"):
        metaimage_header(_written(tmp_path, meta_image(**changes)))


@pytest.mark.parametrize("end", [0, 30, 200])
def test_headers_that_are_cut_off(tmp_path, end):
    with pytest.raises(InputError, match="has a header that is cut off"):
        metaimage_header(_written(tmp_path, meta_image()[:end]))


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_ends_of_lines_and_signs(tmp_path, ends):
    content = meta_image()
    head, pixels = content[: -volume().nbytes], content[-volume().nbytes :]
    path = _written(tmp_path, head.replace(b"\n", ends.encode()).replace(b" = ", b"=") + pixels)
    metaimage_header(path).require_complete()


def test_bytes_that_are_skipped(tmp_path):
    """With -1 the pixels are the end of the file, behind whatever is before."""
    content = meta_image(HeaderSize="-1")
    path = _written(tmp_path, content[: -volume().nbytes] + b"notes" + volume().tobytes())
    assert metaimage_header(path).start == 0
    np.testing.assert_array_equal(read_image(path).data[0, 0], volume())
    (tmp_path / "a.raw").write_bytes(b"notes" + volume().tobytes())
    path = _written(tmp_path, meta_image(HeaderSize="5", ElementDataFile="a.raw")[: -volume().nbytes], "a.mhd")
    assert metaimage_header(path).start == 5
    np.testing.assert_array_equal(read_image(path).data[0, 0], volume())


def test_pixels_as_text(tmp_path):
    words = " ".join(f"{value:g}" for value in volume().ravel()).encode() + b"\n"
    head = meta_image(BinaryData="False")[: -volume().nbytes]
    np.testing.assert_allclose(read_image(_written(tmp_path, head + words)).data[0, 0], volume(), rtol=1e-5)
    with pytest.raises(InputError, match="damaged"):
        read_image(_written(tmp_path, head + words[:500]))


@pytest.mark.parametrize("data", ["LIST", "LIST 2D", "s%02d.raw 1 9 1"])
def test_several_files_of_pixels(tmp_path, data):
    names = [f"s{k:02d}.raw" for k in range(1, 10)]
    for name, plane in zip(names, volume(), strict=True):
        (tmp_path / name).write_bytes(plane.tobytes())
    head = meta_image(ElementDataFile=data)[: -volume().nbytes]
    path = _written(
        tmp_path, head + ("".join(f"{name}\n" for name in names).encode() if data.startswith("LIST") else b""), "a.mhd"
    )
    assert [file.name for file in metaimage_header(path).files] == names
    np.testing.assert_array_equal(read_image(path).data[0, 0], volume())
    (tmp_path / "s05.raw").write_bytes(b"short")
    with pytest.raises(InputError, match=r"a\.mhd is damaged"):
        read_image(path)
    (tmp_path / "s05.raw").unlink()
    os.mkfifo(tmp_path / "s05.raw")
    with pytest.raises(InputError, match=r"s05\.raw is no file but a device or a pipe"):
        read_image(path)


@pytest.mark.parametrize(
    ("unit", "size", "shown"), [("um", 1e-3, "µm"), ("mm", 1, "mm"), ("cm", 10, "mm"), ("?", 1, "mm")]
)
def test_units_of_length(tmp_path, unit, size, shown):
    image = read_image(_written(tmp_path, meta_image(DistanceUnits=unit)))
    assert (image.unit, image.grid.spacing) == (shown, (size,) * 3)


@pytest.mark.parametrize("names", [["s1.raw"] * 8, ["s1.raw"] * 10, ["s1.raw"] * 3])
def test_a_list_of_another_length(tmp_path, names):
    content = meta_image(ElementDataFile="LIST")[: -volume().nbytes] + "".join(f"{n}\n" for n in names).encode()
    with pytest.raises(InputError, match=rf"names {len(names)} files of pixels for 9 slices"):
        metaimage_header(_written(tmp_path, content))


def test_a_list_whose_last_line_does_not_end(tmp_path):
    """ITK leaves that file out, and reads whatever the memory holds."""
    content = meta_image(ElementDataFile="LIST")[: -volume().nbytes] + b"\n".join([b"s1.raw"] * 9)
    with pytest.raises(InputError, match=r"names 8 files of pixels for 9 slices.*last line must end"):
        metaimage_header(_written(tmp_path, content))
