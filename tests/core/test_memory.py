"""Memory of this machine: what is free, what was used, sizes in words."""

import sys
from pathlib import Path

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

import torchdeform.core.memory as memory
from torchdeform.core.memory import available, parse_size, peak, readable
from torchdeform.errors import InputError

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="measured by what Linux tells of a process")


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("4GB", 4 * 10**9), ("4 gb", 4 * 10**9), ("4g", 4 * 10**9), ("512MiB", 512 * 2**20), ("1.5 GiB", 3 * 2**29),
        ("800m", 8 * 10**8), ("1000000", 10**6), (".5T", 5 * 10**11), ("64 kB", 64000), ("  2 TiB ", 2**41),
    ],
)  # fmt: skip
def test_sizes_in_words(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "four GB", "4 XB", "-4GB", "0", "0.0GB", "nan", "inf", "4GB8", "1e9", "4,5GB"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(InputError, match="such as 4GB or 512MB"):
        parse_size(text)


@given(st.integers(1, 10**14))
@example(999_500_000_000)
def test_readable_sizes_can_be_read(size):
    assert parse_size(readable(size)) == pytest.approx(size, rel=6e-3)
    assert " " not in readable(size, spaced=False)


@linux
def test_what_is_free_here():
    total = next(
        int(line.split()[1]) * 1024
        for line in Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        if "Total" in line
    )
    free = available()
    assert free is not None
    assert 0 < free <= total


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with 8 GB free, whose control groups the test writes."""
    monkeypatch.setattr(memory, "_MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "_PROCESS", tmp_path / "process")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")
    (tmp_path / "meminfo").write_text("MemTotal: 16000000 kB\nMemAvailable: 8000000 kB\n", encoding="utf-8")
    return tmp_path


def group(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".", 1)).write_text(text + "\n", encoding="utf-8")


def test_limits_of_control_groups(machine):
    assert available() == 8000000 * 1024
    (machine / "process").write_text("0::/work/job\n", encoding="utf-8")
    group(machine / "groups" / "work" / "job", memory_max="max", memory_current="100")
    assert available() == 8000000 * 1024
    group(machine / "groups" / "work", memory_max="3000000000", memory_current="1000000000")
    assert available() == 2 * 10**9
    group(machine / "groups" / "work" / "job", memory_max="500", memory_current="700")
    assert available() == 0


def test_limits_of_the_first_version_of_control_groups(machine):
    (machine / "process").write_text("9:cpu:/\n5:memory:/job\n", encoding="utf-8")
    group(machine / "groups" / "memory" / "job", memory_limit_in_bytes="700", memory_usage_in_bytes="200")
    assert available() == 500


def test_nothing_known_is_none(machine):
    (machine / "meminfo").unlink()
    assert available() is None


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_what_is_free_on_a_gpu():
    free = available("cuda")
    assert free is not None
    assert 0 < free <= torch.cuda.get_device_properties(0).total_memory


@linux
def test_the_peak_is_that_of_the_process():
    """At least what Linux says it holds now, and no smaller after more."""
    before = peak()
    assert before is not None
    held = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096
    assert 0.9 * held <= before < 2**40
    block = torch.ones(2**24)
    after = peak()
    assert after is not None
    assert after >= before
    del block


def test_the_peak_is_not_known_everywhere(monkeypatch):
    monkeypatch.setitem(sys.modules, "resource", None)
    monkeypatch.setattr(memory, "_STATUS", Path("nowhere"))
    assert peak() is None
