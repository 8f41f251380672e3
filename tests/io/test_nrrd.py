"""Headers of NRRD: what ITK writes and what people write by hand."""

import bz2
import gzip

import numpy as np
import pytest
import SimpleITK as sitk
from broken_files import NRRD, nrrd_image, volume

from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.images import image_size
from torchdeform.io.nrrd import nrrd_header


def _written(folder, content: bytes, name: str = "a.nrrd"):
    (folder / name).write_bytes(content)
    return folder / name


def _head(**changes: str) -> bytes:
    return nrrd_image(**changes)[: -volume().nbytes]


@pytest.mark.parametrize("ending", [".nrrd", ".nhdr"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", ["uint8", "int16", "uint16", "int32", "int64", "float32", "float64"])
@pytest.mark.parametrize("channels", [1, 3])
def test_what_itk_writes(tmp_path, ending, packed, kind, channels):
    values = np.stack([volume(kind)] * channels, -1) if channels > 1 else volume(kind)
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=channels > 1), str(tmp_path / f"a{ending}"), packed)
    header = nrrd_header(tmp_path / f"a{ending}")
    header.require_complete()
    assert (header.size, header.channels, header.width) == ((11, 10, 9), channels, np.dtype(kind).itemsize)
    assert header.packing == ("gzip" if packed else "raw")
    assert len(header.files) == (ending == ".nhdr")
    assert image_size(tmp_path / f"a{ending}") == ((9, 10, 11), channels)


TYPES = {
    "signed char": 1, "uchar": 1, "uint8_t": 1, "short int": 2, "unsigned short int": 2, "int16": 2, "int": 4,
    "unsigned int": 4, "signed int": 4, "uint32_t": 4, "long long int": 8, "unsigned long long": 8, "double": 8,
}  # fmt: skip


@pytest.mark.parametrize("name", TYPES)
def test_names_of_types(tmp_path, name):
    assert nrrd_header(_written(tmp_path, nrrd_image(type=name))).width == TYPES[name]


@pytest.mark.parametrize("wrong", [name for name in NRRD if name not in ("sheared axes", "four axes")])
def test_headers_without_sense(tmp_path, wrong):
    with pytest.raises(InputError, match=r"a\.nrrd"):
        nrrd_header(_written(tmp_path, nrrd_image(**NRRD[wrong]))).require_complete()


@pytest.mark.parametrize("changes", [{"line_skip": "-1"}, {"byte_skip": "-2"}, {"byte_skip": "x"}, {"dimension": "-3"}])
def test_counts_without_sense(tmp_path, changes):
    with pytest.raises(InputError, match=r"a\.nrrd has the"):
        nrrd_header(_written(tmp_path, nrrd_image(**changes)))


def test_a_header_that_is_cut_off(tmp_path):
    with pytest.raises(InputError, match="has a header that is cut off"):
        nrrd_header(_written(tmp_path, nrrd_image()[:60]))


PACKINGS = {
    "gzip": gzip.compress, "gz": gzip.compress, "raw": bytes, "hex": lambda pixels: pixels.hex().encode(),
    "text": lambda pixels: " ".join(f"{v:.9g}" for v in np.frombuffer(pixels, "f4")).encode(),
}  # fmt: skip


@pytest.mark.parametrize("encoding", PACKINGS)
@pytest.mark.parametrize("apart", [False, True])
def test_encodings(tmp_path, encoding, apart):
    pixels = PACKINGS[encoding](volume().tobytes())
    if apart:
        (tmp_path / "pixels").write_bytes(pixels)
    head = _head(encoding=encoding, **({"data_file": "pixels"} if apart else {}))
    path = _written(tmp_path, head + (b"" if apart else pixels), "a.nhdr" if apart else "a.nrrd")
    np.testing.assert_array_equal(read_image(path).data[0, 0], volume())
    target = tmp_path / "pixels" if apart else path
    target.write_bytes(target.read_bytes()[: len(head) * (not apart) + len(pixels) // 3])
    with pytest.raises(InputError, match="is damaged"):
        read_image(path)


def test_bzip2_is_counted(tmp_path):
    """ITK may lack it; the check does not."""
    nrrd_header(_written(tmp_path, _head(encoding="bzip2") + bz2.compress(volume().tobytes()))).require_complete()


def test_what_is_skipped(tmp_path):
    (tmp_path / "a.raw").write_bytes(b"one line\nand 4" + volume().tobytes())
    for skip in ({"line_skip": "1", "byte_skip": "5"}, {"byte_skip": "-1"}):
        path = _written(tmp_path, _head(data_file="a.raw", **skip), "a.nhdr")
        np.testing.assert_array_equal(read_image(path).data[0, 0], volume())


@pytest.mark.parametrize(("unit", "size", "shown"), [('"um"', 1e-3, "µm"), ('"mm"', 1, "mm"), ('"m"', 1e3, "mm")])
def test_units_of_space(tmp_path, unit, size, shown):
    changes = {
        "space_units": " ".join([unit] * 3),
        "space_directions": "(0.5,0,0) (0,0.5,0) (0,0,2)",
        "space_origin": "(1,2,3)",
    }
    image = read_image(_written(tmp_path, nrrd_image(**changes)))
    assert image.unit == shown
    np.testing.assert_allclose(image.grid.spacing, np.array((2, 0.5, 0.5)) * size)
    np.testing.assert_allclose(image.origin, np.array((1, 2, 3)) * size)


def test_comments_and_keys_of_the_user_have_no_say(tmp_path):
    head = _head().replace(b"NRRD0004\n", b"NRRD0004\n# sizes: 1 1 1\nsizes:=1 1 1\n")
    path = _written(tmp_path, head + volume().tobytes())
    assert nrrd_header(path).size == (11, 10, 9)
    np.testing.assert_array_equal(read_image(path).data[0, 0], volume())


def test_axes_in_different_units_are_refused(tmp_path):
    with pytest.raises(InputError, match="has axes in different units"):
        read_image(_written(tmp_path, nrrd_image(space_units='"um" "um" "mm"')))


def test_an_empty_line_in_a_list_of_files_is_named(tmp_path):
    """ITK counts it as a file of pixels."""
    for k in range(3):
        (tmp_path / f"{k}.raw").write_bytes(bytes(20))
    head = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 5 4 3\nencoding: raw\ndata file: LIST\n0.raw\n1.raw\n2.raw\n"
    (tmp_path / "a.nhdr").write_text(head, encoding="utf-8")
    (tmp_path / "b.nhdr").write_text(head + "\n", encoding="utf-8")
    assert read_image(tmp_path / "a.nhdr").grid.shape == (3, 4, 5)
    with pytest.raises(InputError, match=r"b\.nhdr has an empty line in or behind its list of files; delete that line"):
        read_image(tmp_path / "b.nhdr")
