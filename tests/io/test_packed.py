"""Files packed with gzip, and bombs."""

import gzip

import pytest

import torchdeform.io.packed as module
from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.packed import is_packed, opened, unpack


@pytest.mark.parametrize("packed", [False, True])
def test_files_are_opened_by_content(tmp_path, packed):
    (tmp_path / "a").write_bytes(gzip.compress(b"words") if packed else b"words")
    assert is_packed(tmp_path / "a") == packed
    with opened(tmp_path / "a") as file:
        assert file.read() == b"words"


def test_unpacking(tmp_path):
    (tmp_path / "a").write_bytes(gzip.compress(b"words" * 1000))
    unpack(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"words" * 1000


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_file_that_breaks_off(tmp_path, share):
    content = gzip.compress(b"words" * 1000)
    (tmp_path / "a").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InputError, match="a is damaged"):
        unpack(tmp_path / "a", tmp_path / "b")


def test_a_bomb_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "available", lambda: 40_000_000)
    (tmp_path / "a.mha.gz").write_bytes(gzip.compress(b"NDims = 3\n" + bytes(20_000_000)))
    with pytest.raises(InputError, match=r"a\.mha\.gz is longer than 10 MB unpacked; unpack it"):
        read_image(tmp_path / "a.mha.gz")
