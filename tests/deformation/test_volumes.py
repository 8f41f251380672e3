"""Volumes of moved regions against other ways to measure them, and maps that change them as asked for."""

import math
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core.derivatives import determinant, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.warp import sample
from torchdeform.deformation.monitors import label_monitor
from torchdeform.deformation.volumes import nodal_volumes, simulate_volume_change
from torchdeform.errors import ComputationError, InputError
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.solvers.base import Status

GRIDS = [Grid((48, 40), (1.0, 1.2)), Grid((28, 26, 30), (1.0, 1.2, 0.9))]
CENTRES = {1: (0.3, 0.3, 0.35), 2: (0.66, 0.62, 0.5), 3: (0.3, 0.75, 0.6)}
RADII = {1: 0.15, 2: 0.2, 3: 0.12}


def balls(grid: Grid, centres: dict[int, tuple[float, ...]] = CENTRES, dtype: torch.dtype = torch.float64) -> Tensor:
    """Labels 1 to 3: balls apart from each other."""
    x = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.empty(0, dtype=torch.float64))
    labels = torch.zeros(1, 1, *grid.shape, dtype=dtype)
    for label, centre in centres.items():
        away = x - torch.tensor(centre[: grid.dim], dtype=torch.float64).view(1, -1, *[1] * grid.dim)
        labels[away.norm(dim=1, keepdim=True) < RADII[label]] = label
    return labels


def wavy(grid: Grid, size: float = 0.8) -> Tensor:
    x = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.empty(0, dtype=torch.float64))
    return size * torch.sin(3 * x.flip(1) + 2 * x)


def voxel_volume(u: Tensor, grid: Grid, region: Tensor, parts: int = 4) -> float:
    """Volume of the image of the region's voxels, boxes around the nodes, under φ interpolated multilinearly.

    Each voxel is cut into small boxes, of which the image is a parallelepiped, nearly.
    """
    nodes = region[0, 0].nonzero().double() * torch.tensor(grid.spacing).double()
    steps = ((torch.arange(parts) + 0.5) / parts - 0.5).double()
    total, h = 0.0, 1e-4
    for offset in product(steps, repeat=grid.dim):
        p = (nodes + torch.stack(offset) * torch.tensor(grid.spacing)).T.unsqueeze(0)
        columns = []
        for axis in range(grid.dim):
            e = h * torch.eye(grid.dim, dtype=torch.float64)[axis].view(1, -1, 1)
            columns.append((sample(u, p + e, grid) - sample(u, p - e, grid)) / (2 * h) + e / h)
        total += float(determinant(torch.stack(columns, dim=2)).sum())
    return total / len(steps) ** grid.dim * grid.cell_volume


@pytest.mark.parametrize("grid", [Grid((4, 5), (0.5, 2.0)), Grid((4, 3, 5), (0.5, 2.0, 1.0))])
def test_without_a_map_they_are_the_weights_of_the_nodes(grid):
    u = torch.zeros(1, grid.dim, *grid.shape, dtype=torch.float64)
    torch.testing.assert_close(nodal_volumes(u, grid), grid.quadrature(dtype=torch.float64))


@pytest.mark.parametrize("grid", [Grid((4, 5), (0.5, 2.0)), Grid((4, 3, 5), (0.5, 2.0, 1.0))])
def test_a_linear_map_multiplies_them_by_its_determinant(grid):
    matrix = torch.randn(grid.dim, grid.dim, dtype=torch.float64)
    x = grid.points(dtype=torch.float64)
    u = torch.einsum("ka,ba...->bk...", matrix, x) - x
    want = torch.linalg.det(matrix) * grid.quadrature(dtype=torch.float64)
    torch.testing.assert_close(nodal_volumes(u, grid), want)


def test_in_the_plane_those_of_a_cell_are_the_area_of_its_quadrangle():
    grid, square = Grid((2, 2)), torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    u = 0.3 * torch.randn(5, 2, 2, 2, dtype=torch.float64)
    moved = [(grid.points(dtype=torch.float64) + u)[:, :, i, j] for i, j in square.tolist()]
    shoelace = sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] for a, b in zip(moved, moved[1:] + moved[:1], strict=True)) / 2
    torch.testing.assert_close(nodal_volumes(u, grid).flatten(1).sum(1), shoelace)


@st.composite
def inner_displacements(draw) -> tuple[Tensor, Grid]:
    dim = draw(st.sampled_from((2, 3)))
    grid = Grid(draw(st.tuples(*[st.integers(2, 6)] * dim)), draw(st.tuples(*[st.floats(0.3, 3)] * dim)))
    u = torch.randn(2, dim, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(draw(st.integers(0, 99))))
    return u.masked_fill(fixed_unknowns("dirichlet", grid), 0), grid


@given(inner_displacements())
@settings(deadline=None, max_examples=30)
def test_whatever_happens_inside_the_sum_is_the_volume_of_the_box(made):
    u, grid = made
    total = nodal_volumes(u, grid).flatten(1).sum(1)
    torch.testing.assert_close(total, torch.full_like(total, grid.volume))


@pytest.mark.parametrize("grid", GRIDS)
def test_regions_measure_as_much_as_their_voxels_do(grid):
    region, u = balls(grid) == 2, wavy(grid)
    mine = float((nodal_volumes(u, grid) * region).sum())
    assert mine == pytest.approx(voxel_volume(u, grid, region), rel=1e-3)
    assert mine != pytest.approx(float(region.sum()) * grid.cell_volume, rel=1e-2)


def test_volumes_are_differentiable():
    for grid in (Grid((3, 4), (1.0, 0.7)), Grid((3, 2, 3), (1.0, 0.7, 1.2))):
        u = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64, requires_grad=True)
        assert gradcheck(lambda u, grid=grid: nodal_volumes(u, grid), (u,), fast_mode=True)
    with pytest.raises(InputError, match="nodal_volumes: u must have shape"):
        nodal_volumes(torch.zeros(1, 3, 4, 5), Grid((4, 5)))


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("factors", [{1: 0.8}, {2: 1.25}, {1: 0.8, 2: 1.25, 3: 1.1}])
def test_regions_change_by_their_factors_however_they_are_measured(grid, factors):
    labels = balls(grid)
    change = simulate_volume_change(labels, factors, grid)
    assert change.ok
    assert float(change.residual) < 5e-4
    assert int(change.steps) <= 5
    assert bool(diagnose(change.value, grid).diffeomorphic.all())
    assert float(change.smallest) > 0
    det = jacobian_determinant(change.value, grid)
    weights = grid.quadrature(dtype=torch.float64)
    for label, factor in factors.items():
        region = labels == label
        before = float((weights * region).sum())
        assert float(change.factors[label]) == pytest.approx(factor, rel=5e-4)
        assert voxel_volume(change.value, grid, region) / before == pytest.approx(factor, rel=5e-3)
        assert float((det * weights * region).sum()) / before == pytest.approx(factor, rel=5e-3)
        # Evenly: not only in sum.
        assert float((det[region] / factor - 1).abs().max()) < 0.03
    normal = change.value.masked_select(fixed_unknowns("slip", grid))
    assert not normal.any()


@pytest.mark.parametrize("grid", GRIDS)
def test_what_is_rigid_does_not_move_at_all(grid):
    labels = balls(grid)
    rigid = labels == 3
    change = simulate_volume_change(labels, {1: 0.8, 2: 1.25}, grid, rigid_mask=rigid)
    assert change.ok
    assert not change.value.masked_select(rigid).any()
    assert float(change.value.abs().max()) > 0.1
    assert bool(diagnose(change.value, grid).diffeomorphic.all())
    for label, factor in ((1, 0.8), (2, 1.25)):
        assert float(change.factors[label]) == pytest.approx(factor, rel=5e-4)


def next_to_rigid() -> tuple[Grid, Tensor, Tensor]:
    """Two regions with a rigid wall between them."""
    labels = torch.zeros(1, 1, 24, 24, dtype=torch.int64)
    labels[..., 4:12, 4:12], labels[..., 4:12, 14:20] = 1, 2
    rigid = torch.zeros_like(labels, dtype=torch.bool)
    rigid[..., 4:12, 12:14] = True
    return Grid((24, 24)), labels, rigid


def test_next_to_what_is_rigid_volumes_change_without_folds_or_it_is_said():
    grid, labels, rigid = next_to_rigid()
    change = simulate_volume_change(labels, {1: 0.8, 2: 1.25}, grid, rigid_mask=rigid)
    assert change.ok
    assert float(change.smallest) > 0
    with pytest.raises(ComputationError, match="the map folds around rigid_mask"):
        simulate_volume_change(labels, {1: 0.5, 2: 3.0}, grid, rigid_mask=rigid)
    with pytest.raises(ComputationError):
        simulate_volume_change(labels, {1: 0.02, 2: 4.0}, grid, rigid_mask=rigid)


@pytest.mark.parametrize("factors", [{1: 1.25, 2: 0.8}, {1: 0.8, 2: 1.25}, {1: 0.8}, {2: 1.25}])
def test_regions_that_touch(factors):
    """A ring around a disc, at the boundary of Ω too."""
    grid = Grid((48, 48))
    away = (grid.points(dtype=torch.float64) - 12).norm(dim=1, keepdim=True)
    labels = (away < 10).long() + 2 * ((away >= 10) & (away < 14)).long()
    change = simulate_volume_change(labels, factors, grid)
    assert change.ok
    volumes = nodal_volumes(change.value.double(), grid)
    for label, factor in factors.items():
        region, weights = labels == label, grid.quadrature(dtype=torch.float64)
        got = float((volumes * region).sum() / (weights * region).sum())
        assert got == pytest.approx(factor, rel=1e-3)
    assert bool(diagnose(change.value, grid).diffeomorphic.all())


def test_labels_that_leave_only_thin_gaps():
    grid = Grid((30, 30))
    labels = torch.ones(1, 1, 30, 30, dtype=torch.int64)
    labels[..., ::10, :] = 0
    labels[..., 15:, :] *= 2
    change = simulate_volume_change(labels, {1: 0.97, 2: 1.02}, grid)
    assert change.ok


@pytest.mark.parametrize("rigid", [False, True])
def test_a_batch_equals_its_items_one_by_one(rigid):
    grid = Grid((24, 30))
    moved = {label: tuple(1 - c for c in centre) for label, centre in CENTRES.items()}
    labels = torch.cat([balls(grid), balls(grid, moved)])
    labels[0][labels[0] == 1] = 2  # two regions of one label, and another number of maps
    mask = labels == 3 if rigid else None
    together = simulate_volume_change(labels, {2: 1.2}, grid, rigid_mask=mask)
    for i in range(2):
        part = slice(i, i + 1)
        alone = simulate_volume_change(labels[part], {2: 1.2}, grid, rigid_mask=None if mask is None else mask[part])
        terms, condition = 10 * terms_of_a_solve(grid), condition_of_a_solve(grid)
        assert_same_to_rounding(together.value[part], alone.value, terms, condition)
        assert together.steps[i] == alone.steps[0]
        assert_same_to_rounding(together.factors[2][i], alone.factors[2][0], terms, condition)


def test_types_of_labels_and_of_the_result():
    grid = Grid((24, 24))
    for dtype, want in ((torch.uint8, torch.float32), (torch.int64, torch.float32), (torch.float64, torch.float64)):
        change = simulate_volume_change(balls(grid, dtype=dtype), {1: 0.9}, grid)
        assert change.value.dtype == want
        assert change.ok
    assert not simulate_volume_change(balls(grid), {1: 1.0}, grid).value.abs().max() > 1e-12


def test_maps_that_run_out_are_said():
    change = simulate_volume_change(balls(GRIDS[0]), {1: 0.8}, GRIDS[0], rtol=1e-9, max_steps=2)
    assert change.status == (Status.MAX_STEPS,)
    assert change.steps.tolist() == [2]
    assert float(change.residual) > 1e-9


PLANE = Grid((12, 12))
SPOT = torch.zeros(1, 1, 12, 12, dtype=torch.int64)
SPOT[..., 3:9, 3:9] = 7


@pytest.mark.parametrize(
    ("labels", "factors", "options", "message"),
    [
        (SPOT[0], {7: 0.9}, {}, "labels must have shape"),
        (SPOT, {}, {}, "factors must be positive and finite, one or more"),
        (SPOT, {7: 0.0}, {}, "factors must be positive"),
        (SPOT, {7: math.nan}, {}, "factors must be positive"),
        (SPOT, {8: 0.9}, {}, "label 8 does not occur"),
        (SPOT, {7: 5.0}, {}, "leave the rest of the domain no volume"),
        (SPOT, {7: 0.9, 0: 1.0}, {}, r"labels fill the domain, and the factors would make its volume 0\.\d+ times"),
        (SPOT, {7: 0.9}, {"rigid_mask": SPOT == 7}, "label 7 lies in rigid_mask"),
        (SPOT, {7: 0.9}, {"rigid_mask": SPOT}, "must be a mask of bool"),
        (SPOT, {7: 0.9}, {"rigid_mask": SPOT[..., :3] == 0}, "rigid_mask must have shape"),
        (SPOT, {7: 0.9}, {"rtol": 0.0}, "rtol must be positive"),
        (SPOT, {7: 0.9}, {"max_steps": 0}, "max_steps at least 1"),
        (SPOT, {7: 0.9}, {"smoothing": -1.0}, "sigma must be finite and not negative"),
    ],
)
def test_wrong_input_is_refused(labels, factors, options, message):
    with pytest.raises(InputError, match=message):
        simulate_volume_change(labels, factors, PLANE, **options)


@pytest.mark.parametrize("grid", GRIDS)
def test_labels_may_fill_the_domain_where_the_factors_keep_its_volume(grid):
    labels = torch.ones(1, 1, *grid.shape, dtype=torch.int64)
    labels[:, :, grid.shape[0] // 2 :] = 2
    share = float(grid.quadrature(dtype=torch.float64)[labels == 1].sum()) / grid.volume
    factors = {1: 0.8, 2: (1 - 0.8 * share) / (1 - share)}
    change = simulate_volume_change(labels, factors, grid)
    assert change.ok
    assert {label: float(f) for label, f in change.factors.items()} == pytest.approx(factors, rel=1e-3)
    assert float(change.smallest) > 0
    torch.testing.assert_close(
        label_monitor(labels, factors, grid)[labels == 1], torch.full((int((labels == 1).sum()),), 0.8)
    )


def test_one_label_that_fills_the_domain_stays():
    everything = torch.ones(1, 1, 12, 12, dtype=torch.int64)
    assert simulate_volume_change(everything, {1: 1.0}, PLANE).value.abs().max() == 0
    with pytest.raises(InputError, match=r"would make its volume 0\.9 times as large; leave out a label"):
        simulate_volume_change(everything, {1: 0.9}, PLANE)
    with pytest.raises(InputError, match="the labels fill item 1 of the batch"):
        simulate_volume_change(torch.cat([SPOT, 0 * SPOT + 7]), {7: 0.9}, PLANE)
