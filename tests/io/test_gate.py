"""The gate of files: what is no regular file, too large, no text, or elsewhere is refused before it is opened."""

import errno
import os
import socket
import struct
import warnings
from pathlib import Path

import pytest

import torchdeform.io.gate as gate
from torchdeform.errors import InputError
from torchdeform.io.gate import read_text, require_beside, require_file, require_name, require_room


def written(path: Path, content: bytes = b"content") -> Path:
    path.write_bytes(content)
    return path


def test_a_regular_file_passes(tmp_path):
    require_file(written(tmp_path / "bräin 1.png"))
    (tmp_path / "link").symlink_to(tmp_path / "bräin 1.png")
    require_file(tmp_path / "link")
    require_file(tmp_path, folder=True)


def test_what_is_no_regular_file_is_refused_without_being_opened(tmp_path):
    """Opening a pipe that nobody writes would wait for ever."""
    os.mkfifo(tmp_path / "pipe.png")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        for path in (tmp_path / "pipe.png", tmp_path / "s", Path("/dev/zero")):
            with pytest.raises(InputError, match="is no file but a device or a pipe; give an image file"):
                require_file(path, "image file")
    with pytest.raises(InputError, match="is a folder; give a file"):
        require_file(tmp_path)


def test_missing_names_are_told_the_nearest(tmp_path):
    written(tmp_path / "brain.nii.gz")
    with pytest.raises(
        InputError, match=r"brian\.nii\.gz does not exist; check the name; did you mean 'brain\.nii\.gz'"
    ):
        require_file(tmp_path / "brian.nii.gz")
    with pytest.raises(InputError, match="does not exist"):
        require_file(tmp_path / "brain.nii.gz" / "x")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match="loop cannot be opened"):
        require_file(tmp_path / "loop")
    with pytest.raises(InputError, match="cannot be opened: File name too long"):
        require_file(tmp_path / ("a" * 300))
    with pytest.raises(InputError, match="is empty"):
        require_file(written(tmp_path / "empty.png", b""))


@pytest.mark.parametrize("name", ["a\0b.png", "a\ud800.png", "\ud83d.png"])
def test_names_that_do_not_encode_are_refused(name):
    with pytest.raises(InputError, match="is a name that other programs cannot read; rename the image file"):
        require_name(Path(name), "image file")
    with pytest.raises(InputError, match="cannot read"):
        require_file(Path(name))


def test_texts_of_every_encoding_with_a_mark(tmp_path):
    for coding in ("utf-8", "utf-8-sig", "utf-16"):
        assert read_text(written(tmp_path / "t", "Höhe,1\n".encode(coding))) == "Höhe,1\n"
    latin = written(tmp_path / "latin", "Höhe".encode("latin-1"))
    assert read_text(latin, legacy=True) == "Höhe"
    with pytest.raises(InputError, match="is no text; give a table in UTF-8"):
        read_text(latin, "table")


def test_what_is_no_text_or_too_long_is_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="zero bytes"):
        read_text(written(tmp_path / "nul", b"a\0b"))
    with pytest.raises(InputError, match="is no text"):
        read_text(written(tmp_path / "odd", b"\xff\xfea"), legacy=True)
    monkeypatch.setattr(gate, "LONGEST_TEXT", 10)
    with pytest.raises(InputError, match="is larger than 10 B, too large for a table"):
        read_text(written(tmp_path / "long", b"x" * 11), "table")
    assert len(read_text(written(tmp_path / "fits", b"x" * 10))) == 10


def test_what_a_header_announces_must_be_there_and_fit(tmp_path, monkeypatch):
    file = written(tmp_path / "i.nrrd", b"x" * 1_000_000)
    require_room(file, 1_000_000_000)
    with pytest.raises(InputError, match=r"announces 2 GB of pixels, far more than it can hold; it is damaged"):
        require_room(file, 2_000_000_000)
    require_room(file, 2_000_000_000, stored=2_000_000)  # in other files
    monkeypatch.setattr(gate, "available", lambda: 500_000_000)
    with pytest.raises(InputError, match=r"takes, by its header, 1 GB of memory and 500 MB are free"):
        require_room(file, 1_000_000_000)


def test_pixels_stand_beside_or_below_their_header(tmp_path):
    header = written(tmp_path / "i.mhd")
    (tmp_path / "below").mkdir()
    require_beside(written(tmp_path / "below" / "i.raw"), header)
    require_beside(written(tmp_path / "i.raw"), header)
    with pytest.raises(InputError, match="which is not beside it"):
        require_beside(Path("/etc/passwd"), header)
    (tmp_path / "link.raw").symlink_to("/etc/passwd")
    with pytest.raises(InputError, match="which is not beside it"):
        require_beside(tmp_path / "link.raw", header)
    os.mkfifo(tmp_path / "pipe.raw")
    with pytest.raises(InputError, match="is no file but a device or a pipe"):
        require_beside(tmp_path / "pipe.raw", header)


def test_room_counts_what_reading_takes(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(bytes(100))
    monkeypatch.setattr(gate, "available", lambda: 1000)
    gate.require_room(tmp_path / "a", 900)
    with pytest.raises(InputError, match=r"1.1 kB of memory and 1 kB are free; do this"):
        gate.require_room(tmp_path / "a", 900, held=1100, remedy="do this")


@pytest.mark.parametrize(
    "error", [AssertionError, KeyError("x"), RecursionError, struct.error, SyntaxError, OSError(22, "x")]
)
def test_whatever_a_library_raises_is_one_sentence(tmp_path, error):
    with (
        pytest.raises(InputError, match=r"a\.x is damaged or incomplete; fetch or export it again"),
        gate.reading(tmp_path / "a.x"),
    ):
        raise error


def test_reading_says_what_it_knows(tmp_path):
    with pytest.raises(InputError, match="a takes more memory than there is"), gate.reading(tmp_path / "a"):
        raise MemoryError
    with pytest.raises(InputError, match="of its own"), gate.reading(tmp_path / "a"):
        raise InputError("of its own")
    with pytest.raises(InputError, match="a has a fault"), gate.reading(tmp_path / "a", "has a fault"):
        raise ValueError
    with pytest.raises(OSError, match="stale"), gate.reading(tmp_path / "a"):
        raise OSError(errno.ESTALE, "stale")
    with gate.reading(tmp_path / "a"):
        warnings.warn("dropped", stacklevel=1)
