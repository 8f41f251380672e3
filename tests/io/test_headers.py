"""What text headers may say, and the files of pixels that they name."""

import bz2
import gzip
import os
import zlib
from dataclasses import replace
from pathlib import Path
from random import Random

import pytest

from torchdeform.errors import InputError
from torchdeform.io import headers
from torchdeform.io.headers import Header

PATH = Path("a.mhd")


@pytest.mark.parametrize(
    ("text", "rank", "found"), [("3", "", (3,)), ("4 5 6", "3", (4, 5, 6)), ("1 2 3 4 5", "5", (1, 2, 3, 4, 5))]
)
def test_sizes(text, rank, found):
    assert headers.sizes(PATH, text, rank) == found


@pytest.mark.parametrize(
    ("text", "rank"),
    [
        ("", ""),
        ("0 5", "2"),
        ("-4 5", "2"),
        ("x", "1"),
        ("4 5", "3"),
        ("4 4 4", "-3"),
        ("1 1 1 1 1 1", "6"),
        ("²", "1"),
        ("9" * 5000, "1"),
    ],
)
def test_sizes_that_cannot_be(text, rank):
    with pytest.raises(InputError, match=r"a\.mhd has the (size|number of axes)"):
        headers.sizes(PATH, text, rank)


@pytest.mark.parametrize("text", ["x", "-2", "1.5", "9" * 400, ""])
def test_counts_that_cannot_be(text):
    with pytest.raises(InputError, match=r"a\.mhd has the HeaderSize"):
        headers.count(PATH, "HeaderSize", text, -1)


@pytest.mark.parametrize("text", ["1e-4 0 0 0 1e-4 0 0 0 1e-4", "1 0 0 1", "", "(1,0,0) (0,1,0)"])
def test_matrices(text):
    headers.require_matrix(PATH, text)


@pytest.mark.parametrize("text", ["0 0 0 0", "1 1 1 1", "1 nan 0 1", "a 0 0 1", "1e-4 0 1e-4 0"])
def test_matrices_that_cannot_be(text):
    with pytest.raises(InputError, match=r"a\.mhd has (the|a) direction"):
        headers.require_matrix(PATH, text)


def test_numbered_files():
    found = headers.numbered_files(Path("in/a.mhd"), "s%03d.raw 8 12 2")
    assert [file.as_posix() for file in found] == ["in/s008.raw", "in/s010.raw", "in/s012.raw"]
    assert len(headers.numbered_files(PATH, "a file %d 1 3 1")) == 3


@pytest.mark.parametrize(
    "text",
    ["%s 1 2 1", "%d%d 1 2 1", "%999999d 1 2 1", "%d", "%d 1", "%d 1 x 1", "%d 2 1 1", "%d 0 999999999 1", "%*d 1 2 1"],
)
def test_patterns_that_are_none(text):
    with pytest.raises(InputError, match=r"a\.mhd keeps its pixels in"):
        headers.numbered_files(PATH, text)


UNITS = {
    '"um"': (1e-3, "µm"), "µm": (1e-3, "µm"), "microns": (1e-3, "µm"), "Micrometer": (1e-3, "µm"), "nm": (1e-6, "µm"),
    "m": (1e3, "mm"), "metre": (1e3, "mm"), "cm": (10, "mm"), "mm": (1, "mm"), "millimeter": (1, "mm"), "?": (1, "mm"),
    "": (1, "mm"),
}  # fmt: skip


@pytest.mark.parametrize("name", UNITS)
def test_units(name):
    assert headers.unit_of(name) == UNITS[name]


PACKINGS = {
    "raw": bytes(24), "gzip": gzip.compress(bytes(24)), "bzip2": bz2.compress(bytes(24)), "text": b"0 " * 24,
    "hex": b"00" * 24,
}  # fmt: skip


def _header(folder: Path, packing: str, content: bytes, **changes) -> Header:
    (folder / "a.raw").write_bytes(content)
    (folder / "a.mhd").write_bytes(b"header")
    header = Header(folder / "a.mhd", (4, 3, 2), 1, 1, (folder / "a.raw",), packing, 0)
    return replace(header, **changes)


@pytest.mark.parametrize("packing", PACKINGS)
def test_pixels_must_be_as_long_as_announced(tmp_path, packing):
    _header(tmp_path, packing, PACKINGS[packing]).require_complete()
    with pytest.raises(InputError, match=r"a\.mhd is damaged"):
        _header(tmp_path, packing, PACKINGS[packing][: len(PACKINGS[packing]) // 3]).require_complete()
    with pytest.raises(InputError, match=r"a\.mhd is damaged"):
        _header(tmp_path, packing, PACKINGS[packing], size=(4, 3, 3)).require_complete()


def test_zlib_too(tmp_path):
    _header(tmp_path, "gzip", zlib.compress(bytes(24))).require_complete()


def test_bytes_before_the_pixels_do_not_count(tmp_path):
    with pytest.raises(InputError, match=r"a\.mhd is damaged"):
        _header(tmp_path, "raw", bytes(24), start=1).require_complete()


@pytest.mark.parametrize("packing", ["gzip", "bzip2"])
@pytest.mark.parametrize("chunks", [(1000, 1000), (100, 5000), (5000, 100), (1 << 22, 1 << 18)])
@pytest.mark.parametrize("pattern", ["noise", "zeros", "words"])
def test_what_is_packed_is_counted_piece_by_piece(tmp_path, packing, chunks, pattern, monkeypatch):
    """However much is in the file, in the unpacker and in a piece."""
    for name, size in zip(("_CHUNK", "_PACKED"), chunks, strict=True):
        monkeypatch.setattr(headers, name, size)
    pixels = {"noise": Random(0).randbytes(100_000), "zeros": bytes(100_000), "words": bytes(range(200)) * 500}[pattern]
    content = {"gzip": gzip.compress, "bzip2": bz2.compress}[packing](pixels)
    _header(tmp_path, packing, content, size=(100, 100, 10)).require_complete()
    with pytest.raises(InputError, match="is damaged"):
        _header(tmp_path, packing, content, size=(100, 100, 11)).require_complete()


def test_several_gzip_in_a_row_are_one(tmp_path):
    content = gzip.compress(bytes(20)) + gzip.compress(bytes(4))
    _header(tmp_path, "gzip", content).require_complete()
    with pytest.raises(InputError, match="is damaged"):
        _header(tmp_path, "gzip", content, size=(5, 5, 1)).require_complete()


def test_pixels_that_cannot_be_there(tmp_path):
    with pytest.raises(InputError, match="announces 8 GB of pixels, far more than it can hold"):
        _header(tmp_path, "raw", bytes(24), size=(2000, 2000, 2000)).require_room()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent.raw", "does not exist"),
        ("../b.raw", "not beside it"),
        ("/dev/zero", "not beside it"),
        ("pipe.raw", "a device or a pipe"),
    ],
)
def test_pixels_elsewhere(tmp_path, name, message):
    (tmp_path / "b.raw").write_bytes(bytes(24))
    (tmp_path / "in").mkdir()
    os.mkfifo(tmp_path / "in" / "pipe.raw")
    header = _header(tmp_path / "in", "raw", bytes(24), files=(tmp_path / "in" / name,))
    with pytest.raises(InputError, match=message):
        header.require_room()
