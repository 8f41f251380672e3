"""Readers that crash, hang or take all memory end with a sentence, and the next call works."""

import ctypes
import math
import time
from pathlib import Path

import pytest

import torchdeform.io.isolated as module
from torchdeform.errors import InputError
from torchdeform.io.isolated import isolated


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "image.dcm"
    path.write_bytes(b"content")
    return path


def test_the_answer_and_the_error_of_the_function(file):
    assert isolated(math.sqrt, 4.0, path=file) == 2.0
    with pytest.raises(ValueError, match=r"math domain error|nonnegative"):
        isolated(math.sqrt, -1.0, path=file)


def test_a_crash_is_a_sentence_and_the_next_call_works(file):
    with pytest.raises(InputError, match=r"image\.dcm makes its reader crash, so it is damaged"):
        isolated(ctypes.string_at, 0, path=file)
    assert isolated(math.sqrt, 9.0, path=file) == 3.0


def test_what_never_ends_is_stopped(file, monkeypatch):
    isolated(math.sqrt, 4.0, path=file)
    monkeypatch.setattr(module, "_SECONDS", 0.2)
    with pytest.raises(InputError, match="keeps its reader busy for more than 0 s"):
        isolated(time.sleep, 60, path=file)


def test_it_gets_no_more_memory_than_is_free(file, monkeypatch):
    monkeypatch.setattr(module, "available", lambda: 10**8)
    with pytest.raises(MemoryError):
        isolated(bytes, 10**9, path=file)
    monkeypatch.undo()
    assert len(isolated(bytes, 10**6, path=file)) == 10**6


def test_it_gets_no_more_memory_than_its_file_can_ask_for(file, monkeypatch):
    monkeypatch.setattr(module, "available", lambda: 10**12)
    with pytest.raises(InputError, match="asks for far more memory than it can fill, so it is damaged"):
        isolated(bytes, 3 * 10**9, path=file)
    assert len(isolated(bytes, 10**6, path=file)) == 10**6


def test_it_needs_no_torch(file):
    code = "import sys; assert 'torch' not in sys.modules"
    assert isolated(exec, code, path=file) is None


def test_one_process_serves_all_calls(file):
    assert len({isolated(Path.cwd, path=file) for _ in range(3)}) == 1
    import os

    assert len({isolated(os.getpid, path=file) for _ in range(3)}) == 1
