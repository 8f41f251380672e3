"""Memory: the estimate against measured processes, what is free, sizes in words, grids that fit."""

import math
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from memory import QUICK, estimated, measure  # type: ignore[attr-defined]
from nested_settings import settings_of

import torchdeform.pipeline.memory as memory
from torchdeform.core.grid import Grid
from torchdeform.core.resampling import MIN_NODES
from torchdeform.errors import InputError
from torchdeform.metrics.similarity import MEASURES
from torchdeform.pipeline.memory import available, fitting_grid, footprint, parse_size, peak, readable

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="measured by what Linux tells of a process")


def need(grid: Grid, channels: int = 1, **settings: object) -> int:
    return footprint(grid, channels, settings_of(**settings))


def fitting(grid: Grid, limit: int, **settings: object) -> Grid:
    return fitting_grid(grid, limit, 1, settings_of(**settings))


@linux
@pytest.mark.parametrize("case", QUICK, ids=str)
def test_the_footprint_is_what_a_process_takes(case):
    """From files to files, in a fresh process, within a quarter."""
    assert estimated(case) == pytest.approx(measure(case), rel=0.25)


@pytest.mark.parametrize("dim", [2, 3])
def test_more_takes_more(dim):
    small, large = Grid((64,) * dim), Grid((96,) * dim)
    for name in MEASURES:
        assert need(small, similarity=name) < need(large, similarity=name)
        assert need(small, similarity=name) < need(small, channels=3, similarity=name)
    assert need(small, similarity="lncc") < need(small, similarity={"lncc": 1.0, "mind": 0.5})
    assert need(small, similarity="ssd") < need(small, similarity="ssd", start="discrete")
    assert need(small, channels=9, similarity={"lncc": 1.0, "mind": 0.5}) == need(
        small, channels=9, similarity={"lncc": 1.0, "mind": 0.5}, start="discrete"
    )  # its levels hold more
    finest = fitting(large, 560_000_000, similarity="ssd", start="discrete")
    assert need(finest, similarity="ssd", start="discrete") <= 560_000_000


def test_two_maps_take_twice_as_much_for_a_voxel_but_no_second_process():
    small, large = Grid((64, 64, 64)), Grid((96, 96, 96))
    one, two = (need(large, symmetric=both) - need(small, symmetric=both) for both in (False, True))
    assert two == 2 * one
    assert need(small, symmetric=True) == need(small) + need(small) - need(Grid((2, 2, 2))) + 960
    assert need(large, similarity="ssd", start="discrete") < need(large, similarity="ssd", symmetric=True)


def test_an_assembled_matrix_takes_its_part_up_to_the_largest():
    """243 entries a node in 3D and 36 in 2D, each 90 bytes while the matrix is made; larger ones are not stored."""
    for grid, entries in (
        (Grid((30, 30, 30)), 243 * 30**3),
        (Grid((200, 100)), 36 * 20_000),
        (Grid((200,) * 3), 2**26),
    ):
        more = footprint(grid, 1, settings_of(solver="assembled")) - footprint(grid, 1, settings_of(solver="cg"))
        assert more == 90 * entries


def test_the_limit_of_two_maps_is_the_one_that_was_given():
    """And the size that is advised suffices."""
    grid = Grid((64, 64, 64))
    with pytest.raises(InputError, match=r"--memory 460MB is too little for a fixed image of 64×64×64: give") as said:
        fitting(grid, 460_000_000, symmetric=True)
    least = parse_size(str(said.value).partition("at least ")[2].partition(",")[0])
    assert max(fitting(grid, round(1.01 * least), symmetric=True).shape) < 64
    assert fitting(grid, need(grid, symmetric=True), symmetric=True) is grid
    assert fitting(grid, need(grid, symmetric=True) - 1, symmetric=True) is not grid


def test_an_unknown_similarity_is_refused():
    with pytest.raises(InputError, match="similarity must be one of"):
        need(Grid((64, 64)), similarity="lnc")
    with pytest.raises(InputError, match="start must be one of"):
        need(Grid((64, 64)), start="discreet")


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


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (3.0, 0.7, 0.7)])
@pytest.mark.parametrize("limit", ["1.3GB", "1.35GB", "2GB", "100GB"])
def test_the_grid_that_fits(spacing, limit):
    grid = Grid((120, 256, 256), spacing)
    fits = fitting(grid, parse_size(limit))
    assert need(fits) <= parse_size(limit)
    assert all(math.isclose(a, b) for a, b in zip(fits.extent, grid.extent, strict=True))
    assert all(MIN_NODES <= small <= large for small, large in zip(fits.shape, grid.shape, strict=True))
    if fits != grid:  # and it is not much coarser than it must be
        assert need(fits) > 0.8 * (parse_size(limit) - need(Grid((8, 8, 8)))) + need(Grid((8, 8, 8)))


def test_thick_slices_are_thinned_last():
    fits = fitting(Grid((60, 256, 256), (4.0, 1.0, 1.0)), parse_size("900MB"))
    assert fits.shape[0] == 60
    assert max(fits.shape[1:]) < 256


def test_what_fits_stays():
    grid = Grid((64, 64))
    assert fitting(grid, parse_size("4GB")) is grid


def test_what_reading_and_writing_take_is_the_least():
    with pytest.raises(
        InputError, match=r"--memory 1GB is too little for a fixed image of 256×256×256: give at"
    ) as said:
        fitting(Grid((256, 256, 256)), parse_size("1GB"))
    least = str(said.value).partition("at least ")[2].partition(",")[0]
    assert max(fitting(Grid((256, 256, 256)), round(1.01 * parse_size(least)), similarity="mind").shape) < 256


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
