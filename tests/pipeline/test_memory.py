"""Memory: the estimate against measured processes, what is free, sizes in words, grids that fit."""

import math
import re
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory import QUICK, estimated, measure  # type: ignore[attr-defined]
from nested_settings import settings_of

from torchdeform.core.grid import Grid
from torchdeform.core.memory import at_least, parse_size
from torchdeform.core.resampling import MIN_NODES
from torchdeform.errors import InputError
from torchdeform.metrics.similarity import MEASURES
from torchdeform.pipeline.memory import advice, fitting_grid, footprint

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


def test_each_label_that_glides_takes_the_part_of_a_map():
    """Measured at 96³ with one and three of them: 654 and 802 MB where a pair without takes 610."""
    grid = Grid((96, 96, 96))
    free, one, three = (need(grid, similarity="lncc", sliding=labels) for labels in ((), (1,), (1, 2, 3)))
    assert three - free == pytest.approx(3 * (one - free), abs=4)
    assert (free, one, three) == (
        pytest.approx(610e6, rel=0.1),
        pytest.approx(654e6, rel=0.1),
        pytest.approx(802e6, rel=0.1),
    )
    assert one == need(grid, similarity="lncc", sliding=(1, 1))


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


@settings(max_examples=60, deadline=None)
@given(
    shape=st.lists(st.integers(8, 700), min_size=2, max_size=3),
    channels=st.integers(1, 4),
    symmetric=st.booleans(),
    start=st.sampled_from(["identity", "discrete", "keypoints"]),
    similarity=st.sampled_from(sorted(MEASURES)),
    solver=st.sampled_from(["auto", "assembled"]),
    limit=st.integers(1, 2 * 10**9),
)
def test_the_limit_that_is_advised_is_accepted(shape, channels, symmetric, start, similarity, solver, limit):
    """Whatever was refused: the size in the sentence, given next, is not refused again."""
    grid = Grid(tuple(shape))
    how = settings_of(symmetric=symmetric, start=start, similarity=similarity, solver=solver)
    try:
        fitting_grid(grid, limit, channels, how)
    except InputError as error:
        advised = parse_size(str(error).partition("at least ")[2].partition(",")[0])
        fitting_grid(grid, advised, channels, how)
    found = re.search(r"--memory (\S+) to register", advice(grid, limit, channels, how))
    if found:
        fitting_grid(grid, parse_size(found[1]), channels, how)
    else:
        with pytest.raises(InputError, match="too little"):
            fitting_grid(grid, limit, channels, how)


@given(st.integers(1, 9 * 10**14))
def test_a_size_that_is_rounded_up_is_not_less_and_hardly_more(size):
    assert size <= parse_size(at_least(size)) <= max(1.02 * size, size + 1)
