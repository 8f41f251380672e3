"""Labels that keep their volume: determinants, volumes counted by other means, and what is left alone."""

import math
from itertools import permutations, product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled import ball, scaled, smooth_map, turned
from torch import Tensor

from torchdeform.core.derivatives import curl, jacobian_determinant
from torchdeform.core.diagnostics import diagnose, smallest_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.regions import Crop
from torchdeform.deformation.incompressible import _inverse_laplacian, hold_volume
from torchdeform.deformation.rigid import hold_rigid
from torchdeform.deformation.tissue import label_fit
from torchdeform.errors import InputError

GRIDS = [Grid((72, 64), (1.0, 1.3)), Grid((40, 38, 36), (1.0, 1.2, 0.8))]
UNTIMED = settings(deadline=None, max_examples=15)


def middle(grid: Grid) -> tuple[float, ...]:
    return (0.5,) * grid.dim


def kuhn_volume(u: Tensor, cells: Tensor, grid: Grid) -> float:
    """Volume of φ(cells) cut into the D! simplices along the paths from corner to corner, by numpy.

    Args:
        u: ``(1, D, *S)``.
        cells: mask of the cells ``(*S − 1)``.
        grid: the grid.
    """
    phi = (grid.points(dtype=torch.float64) + u.double())[0].numpy()
    corner = np.argwhere(cells.numpy())
    total = 0.0
    for path in permutations(range(grid.dim)):
        steps = np.cumsum(np.eye(grid.dim, dtype=int)[list(path)], axis=0)
        start = phi[(slice(None), *corner.T)]
        edges = [phi[(slice(None), *(corner + step).T)] - start for step in steps]
        sign = np.linalg.det(np.eye(grid.dim)[list(path)])
        total += sign * np.linalg.det(np.moveaxis(np.stack(edges), (0, 1), (1, 2)).transpose(0, 2, 1)).sum()
    return total / math.factorial(grid.dim)


def cells_of(inside: Tensor) -> Tensor:
    """Cells all of whose corners are nodes of the label ``(*S)``."""
    cells = torch.ones([n - 1 for n in inside.shape], dtype=torch.bool)
    for corner in product((0, 1), repeat=inside.dim()):
        cells &= inside[tuple(slice(c, n - 1 + c) for c, n in zip(corner, inside.shape, strict=True))]
    return cells


def check(u: Tensor, held: Tensor, inside: Tensor, grid: Grid, volume: float = 2e-3) -> None:
    fit = label_fit(held, inside, grid)
    assert float(fit.determinant) < 0.01
    assert float(fit.volume) == pytest.approx(1, abs=volume)
    assert int(diagnose(held, grid).folds) == 0
    assert float(smallest_determinant(held, grid)) >= min(0.05, float(smallest_determinant(u, grid)) / 2)
    for k, axis in enumerate(grid.axes):
        for side in (0, -1):
            assert torch.equal(held[:, k].select(axis - 1, side), u[:, k].select(axis - 1, side))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("factor", [0.85, 1.12])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_label_that_shrank_or_grew_keeps_its_volume(grid, factor, dtype):
    inside = ball(grid, middle(grid), 8)
    u = scaled(grid, inside, factor, smooth_map(grid, 0.4)).to(dtype)
    assert float(label_fit(u, inside, grid).determinant) > 0.25
    held = hold_volume(u, inside, grid)
    assert held.dtype == dtype
    check(u, held, inside, grid)


@pytest.mark.parametrize("grid", GRIDS)
def test_volumes_are_right_by_a_count_of_other_simplices(grid):
    inside = ball(grid, middle(grid), 8)
    u = scaled(grid, inside, 0.9, smooth_map(grid, 0.3))
    cells = cells_of(inside[0, 0])
    before = int(cells.sum()) * grid.cell_volume
    assert kuhn_volume(torch.zeros_like(u), cells, grid) == pytest.approx(before)
    assert kuhn_volume(u, cells, grid) < 0.85 * before
    assert kuhn_volume(hold_volume(u, inside, grid), cells, grid) == pytest.approx(before, rel=2e-3)


@pytest.mark.parametrize("grid", GRIDS)
def test_little_else_changes(grid):
    inside = ball(grid, middle(grid), 8)
    u = scaled(grid, inside, 0.95, smooth_map(grid, 0.3))
    held = hold_volume(u, inside, grid)
    margin = max(6, math.ceil(int(inside.sum()) ** (1 / grid.dim) / 2))
    crop = Crop.around(inside[0, 0], grid, margin)
    beyond = torch.ones_like(inside)
    crop.of(beyond).fill_(False)
    assert torch.equal(held.masked_select(beyond), u.masked_select(beyond))
    assert float((curl(held, grid) - curl(u, grid)).abs().max()) < 0.06
    away = ((held - u) / grid.along(grid.spacing, u)).norm(dim=1).max()
    assert float(away) < 1.2


@pytest.mark.parametrize("grid", GRIDS)
def test_what_keeps_its_volume_is_left(grid):
    inside = ball(grid, middle(grid), 7)
    u = hold_rigid(turned(grid, inside, 0.2, smooth_map(grid, 0.2)), inside, grid)
    assert torch.equal(hold_volume(u, inside, grid), u)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (0.0, 0.5, 0.5), (1.0, 1.0, 0.4)])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_label_at_the_faces_of_the_box(grid, centre):
    inside = ball(grid, centre[: grid.dim], 9)
    u = smooth_map(grid, 0.6, seed=2)
    assert float(label_fit(u, inside, grid).determinant) > 0.03
    check(u, hold_volume(u, inside, grid), inside, grid)


@pytest.mark.parametrize("grid", GRIDS)
def test_all_of_the_box(grid):
    inside = torch.ones(1, 1, *grid.shape, dtype=torch.bool)
    u = smooth_map(grid, 0.4)
    check(u, hold_volume(u, inside, grid), inside, grid)


@pytest.mark.parametrize("grid", GRIDS)
def test_pieces_that_touch_and_shells(grid):
    half = torch.arange(grid.shape[-1]) < grid.shape[-1] // 2
    whole = ball(grid, middle(grid), 9)
    labels = torch.cat([whole & half, whole & ~half], 1)
    u = smooth_map(grid, 0.5, seed=1)
    held = hold_volume(u, labels, grid)
    for label in labels.split(1, 1):
        check(u, held, label, grid)
    shell = whole & ~ball(grid, middle(grid), 6)
    check(u, hold_volume(u, shell, grid), shell, grid)


@given(st.integers(0, 99), st.floats(0.1, 0.5), st.sampled_from((0.02, 0.1, 0.5)), st.sampled_from((2, 3)))
@UNTIMED
def test_scattered_nodes(seed, size, share, dim):
    grid = Grid((24, 18, 14)[:dim], (1.0, 1.7, 0.8)[:dim])
    noise = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(seed))
    inside = noise < share
    inside[(..., *[9] * dim)] = True
    u = smooth_map(grid, size, seed)
    if float(smallest_determinant(u, grid)) > 0.3:
        check(u, hold_volume(u, inside, grid), inside, grid, volume=0.01)


def test_where_volumes_do_not_fit_the_error_still_falls():
    grid = Grid((30, 30))
    inside = torch.ones(1, 1, 30, 30, dtype=torch.bool)
    u = smooth_map(grid, 0.4) - 0.05 * grid.points(dtype=torch.float64)
    held = hold_volume(u, inside, grid)
    off = [float((jacobian_determinant(w, grid) - 1).square().mean().sqrt()) for w in (u, held)]
    assert 0.09 < off[1] < off[0]  # 1 − 0.95² = 0.0975 everywhere would be the best
    assert float(smallest_determinant(held, grid)) > 0
    assert float(label_fit(held, inside, grid).volume) == pytest.approx(float(label_fit(u, inside, grid).volume))


@pytest.mark.parametrize("grid", GRIDS)
def test_what_is_still_stays_to_the_bit(grid):
    bone = ball(grid, middle(grid), 4)
    muscle = ball(grid, middle(grid), 10) & ~bone
    u = hold_rigid(smooth_map(grid, 0.5), bone, grid)
    held = hold_volume(u, muscle, grid, still=bone)
    assert torch.equal(held.masked_select(bone), u.masked_select(bone))
    check(u, held, muscle, grid, volume=4e-3)


def test_a_batch_equals_its_items_one_by_one():
    grid = GRIDS[0]
    labels = torch.cat([ball(grid, (0.4, 0.4), 6), ball(grid, (0.6, 0.5), 9), torch.zeros(1, 1, 72, 64).bool()])
    u = torch.cat(
        [scaled(grid, labels[:1], 0.8, smooth_map(grid, 0.3, 1)), *[smooth_map(grid, 0.2, k) for k in (2, 3)]]
    )
    together = hold_volume(u, labels, grid)
    for i in (0, 1):
        check(u[i : i + 1], together[i : i + 1], labels[i : i + 1], grid)
    assert torch.equal(together[2], u[2])
    shared = hold_volume(u[:2], labels[:1], grid)
    for i in (0, 1):
        alone = hold_volume(u[i : i + 1], labels[:1], grid)
        torch.testing.assert_close(shared[i : i + 1], alone, rtol=0, atol=1e-10)


def test_without_a_label_nothing_happens():
    grid = GRIDS[0]
    u = smooth_map(grid, 0.3)
    assert hold_volume(u, torch.zeros(1, 2, *grid.shape, dtype=torch.bool), grid) is u


@pytest.mark.parametrize("low", [(0, 0), (0, 3), (2, 3)])
def test_the_laplacian_is_inverted(low):
    """Against the dense matrix of ∫ |∇v|² by forward differences with trapezoidal weights."""
    grid = Grid((9, 11), (0.7, 1.1))
    crop = Crop(grid, low, (7, 11))
    n = crop.grid.shape
    solve = _inverse_laplacian(crop, torch.empty(0, dtype=torch.float64))
    for k in (0, 1):
        first, second = (_stiffness(m, h) for m, h in zip(n, grid.spacing, strict=True))
        masses = [np.diag([0.5, *[1] * (m - 2), 0.5]) for m in n]
        dense = np.kron(first, masses[1]) + np.kron(masses[0], second)
        fixed = np.zeros(n, dtype=bool)
        for axis, end in product((0, 1), (0, -1)):
            if crop.cut(axis, abs(end)) or axis == k:
                fixed[(slice(None),) * axis + (end,)] = True
        load = np.random.default_rng(0).normal(size=n)
        free = ~fixed.ravel()
        want = np.zeros(n[0] * n[1])
        want[free] = np.linalg.solve(dense[np.ix_(free, free)], load.ravel()[free])
        got = solve(torch.from_numpy(load).expand(1, 2, *n))[0, k]
        np.testing.assert_allclose(got, want.reshape(n), atol=1e-12)


def _stiffness(count: int, spacing: float) -> np.ndarray:
    slopes = np.diff(np.eye(count), axis=0) / spacing
    return slopes.T @ slopes


LABEL = torch.ones(1, 1, 72, 64, dtype=torch.bool)


@pytest.mark.parametrize(
    ("u", "inside", "options", "message"),
    [
        (torch.zeros(1, 3, 72, 64), LABEL, {}, "hold_volume: u must have shape"),
        (torch.zeros(1, 2, 72, 64), LABEL.float(), {}, "hold_volume: inside must be bool"),
        (torch.zeros(1, 2, 72, 64), LABEL, {"still": LABEL[..., 1:]}, "hold_volume: still must be bool"),
    ],
)
def test_wrong_input_is_refused(u, inside, options, message):
    with pytest.raises(InputError, match=message):
        hold_volume(u, inside, GRIDS[0], **options)
