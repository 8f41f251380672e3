"""The geometry of a grid, and the checks at the boundary of the package."""

import math
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import FrozenInstanceError
from threading import get_ident

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.core import grid as module
from torchdeform.core.grid import Grid, on_threads, over_slabs, slabs
from torchdeform.errors import InputError

SHAPES = st.integers(2, 3).flatmap(lambda dim: st.tuples(*[st.integers(2, 9)] * dim))


SPACINGS = st.floats(0.01, 100)


UNTIMED = settings(deadline=None)  # the first call of a torch function takes long


@UNTIMED
@given(shape=SHAPES, data=st.data())
def test_points_span_the_box(shape, data):
    grid = Grid(shape, data.draw(st.tuples(*[SPACINGS] * len(shape))))
    points = grid.points(dtype=torch.float64)
    assert points.shape == (1, grid.dim, *shape)
    corners = points.flatten(2)[0]
    assert corners[:, 0].tolist() == [0.0] * grid.dim
    torch.testing.assert_close(corners[:, -1], torch.tensor(grid.extent, dtype=torch.float64))
    assert grid.volume == pytest.approx(math.prod(grid.extent))
    for k, axis in enumerate(grid.axes):  # component k grows along axis k, and along no other
        for other in grid.axes:
            step = points[:, k : k + 1].diff(dim=other)
            expected = torch.full_like(step, grid.spacing[k] if other == axis else 0.0)
            torch.testing.assert_close(step, expected)


@UNTIMED
@given(shape=SHAPES, data=st.data())
def test_quadrature_is_exact_on_multilinear_functions(shape, data):
    grid = Grid(shape, data.draw(st.tuples(*[SPACINGS] * len(shape))))
    x = grid.points(dtype=torch.float64)
    product = x.prod(dim=1, keepdim=True)
    exact = math.prod(length**2 / 2 for length in grid.extent)
    weights = grid.quadrature(dtype=torch.float64)
    assert float((weights * product).sum()) == pytest.approx(exact)
    assert float(weights.sum()) == pytest.approx(grid.volume)


def test_spacing_is_one_unless_given():
    grid = Grid([3, 4])  # type: ignore[arg-type]
    assert grid == Grid((3, 4), (1.0, 1.0))
    assert hash(grid) == hash(Grid((3, 4)))
    assert (grid.dim, grid.axes, grid.extent, grid.cell_volume) == (2, (2, 3), (2.0, 3.0), 1.0)
    assert Grid((3, 4, 5)).size_text == "5×4×3"
    with pytest.raises(FrozenInstanceError):
        grid.shape = (5, 5)  # type: ignore[misc]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_type_and_device_follow_the_field(dtype):
    grid, like = Grid((3, 4), (0.5, 2.0)), torch.zeros(1, dtype=dtype)
    assert grid.points(dtype=dtype).dtype == grid.quadrature(dtype=dtype).dtype == dtype
    assert grid.along(grid.spacing, like).dtype == dtype
    assert grid.along(grid.spacing, like).shape == (1, 2, 1, 1)


@pytest.mark.parametrize(
    ("shape", "spacing", "message"),
    [
        ((5,), (), "2 or 3 axes"),
        ((2, 2, 2, 2), (), "2 or 3 axes"),
        ((1, 5), (), "at least 2 nodes"),
        ((4, 5), (1.0,), "2 positive finite"),
        ((4, 5), (1.0, 0.0), "positive finite"),
        ((4, 5), (1.0, math.nan), "positive finite"),
        ((4, 5), (1.0, math.inf), "positive finite"),
        ((4, 5.5), (), "whole numbers"),
        ("ab", (), "whole numbers"),
        ((4, 5), ("a", "b"), "spacing must be numbers"),
    ],
)
def test_unusable_grids_are_refused(shape, spacing, message):
    with pytest.raises(InputError, match=message):
        Grid(shape, spacing)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (torch.zeros(1, 3, 4, 5), r"field must have shape \(B, 2, 4, 5\), got \(1, 3, 4, 5\)"),
        (torch.zeros(1, 2, 5, 4), "got"),
        (torch.zeros(2, 4, 5), "got"),
        (torch.zeros(()), "got"),
        (torch.zeros(0, 2, 4, 5), "is empty, its shape is .*at least one item"),
        (torch.zeros(1, 2, 4, 5, dtype=torch.int64), "of 32 or 64 bits, got torch.int64"),
        ([1.0, 2.0], "of 32 or 64 bits, got list"),
    ],
)
def test_fields_of_another_kind_are_refused(field, message):
    with pytest.raises(InputError, match=message):
        Grid((4, 5)).check_vector(field, "field")


def test_fields_of_the_right_kind_pass():
    grid = Grid((4, 5))
    grid.check_vector(torch.zeros(3, 2, 4, 5), "u")
    grid.check_scalar(torch.zeros(3, 1, 4, 5), "f")
    grid.check(torch.zeros(3, 7, 4, 5), "image")
    with pytest.raises(InputError, match=r"\(B, C, 4, 5\)"):
        grid.check(torch.zeros(4, 5), "image")
    with pytest.raises(InputError, match=r"\(B, 1, 4, 5\)"):
        grid.check_scalar(torch.zeros(3, 2, 4, 5), "f")


@given(SHAPES, st.integers(1, 200), st.integers(1, 4))
def test_slabs_are_all_rows_in_order(shape, nodes, least):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_SLAB_NODES", {"cpu": nodes})
        rows = list(slabs(shape, torch.device("cpu"), least=least))
    assert [k for part in rows for k in range(part.start, part.stop)] == list(range(shape[0]))
    assert all(part.stop - part.start >= least for part in rows[:-1])
    assert all(
        (part.stop - part.start) * math.prod(shape[1:]) <= nodes or part.stop - part.start <= least for part in rows
    )


def test_over_slabs_is_the_whole_and_so_is_its_gradient(monkeypatch):
    monkeypatch.setattr(module, "_SLAB_NODES", {"cpu": 1})
    grid, field = Grid((5, 4, 3), (1.0, 2.0, 0.5)), torch.rand(1, 2, 5, 4, 3, requires_grad=True)
    whole = over_slabs(lambda rows: field[:, :, rows] ** 2, grid.shape, field.device)
    torch.testing.assert_close(whole, field**2)
    torch.testing.assert_close(torch.autograd.grad(whole.sum(), field)[0], 2 * field)
    assert not over_slabs(lambda rows: field.detach()[:, :, rows], grid.shape, field.device).requires_grad
    points = over_slabs(lambda rows: grid.points(rows=rows), grid.shape, field.device)
    assert torch.equal(points, grid.points())


def test_threads_do_all_parts_and_say_what_went_wrong(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    parts, seen, modes = [slice(k, k + 1) for k in range(9)], torch.zeros(9), []

    def work(rows: slice) -> None:
        seen[rows] += 1
        modes.append((torch.is_grad_enabled(), torch.is_inference_mode_enabled(), get_ident()))

    with torch.no_grad():
        on_threads(work, parts, seen.device)
    assert torch.equal(seen, torch.ones(9))
    assert {mode[:2] for mode in modes} == {(False, False)}
    assert get_ident() not in {mode[2] for mode in modes}
    with torch.inference_mode():
        on_threads(work, parts, seen.device)
    assert modes[-1][:2] == (False, True)

    def fail(rows: slice) -> None:
        raise ValueError(f"row {rows.start}")

    with pytest.raises(ValueError, match="row 0"), torch.no_grad():
        on_threads(fail, parts, seen.device)


@pytest.mark.parametrize("fails", [False, True])
def test_threads_to_come_begin_with_as_many_threads_as_before(fails):
    """Also after an error: torch hands the number that one thread sets on to those that begin after it."""

    def work(rows: slice) -> None:
        if fails:
            raise ValueError("row")

    def begin_with() -> int:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(torch.get_num_threads).result()

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        with pytest.raises(ValueError, match="row") if fails else nullcontext():
            on_threads(work, [slice(k, k + 1) for k in range(9)], torch.device("cpu"))
        assert (torch.get_num_threads(), begin_with()) == (3, 3)
    finally:
        torch.set_num_threads(before)
