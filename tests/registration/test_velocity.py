"""The metric of a level: velocities are those of the least squares, whatever solves them, on the scale of a step."""

import math

import pytest
import torch
from nested_settings import settings_of

from torchdeform.core.grid import Grid, per_item
from torchdeform.fem.div_curl import solve_div_curl
from torchdeform.fem.solver import SolverSettings
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.registration.tissue import Tissue
from torchdeform.registration.velocity import (
    VelocityMetric,
    evened,
    fold_barrier,
    image_force,
    limited_step,
    max_norm,
    normalise_step,
    step_size,
)

GRIDS = [Grid((12, 14), (1.0, 0.5)), Grid((7, 8, 6), (0.5, 1.0, 0.8))]
SETTINGS = settings_of(length_scale=(6.0, 3.0), weight_div=0.4)


def field(grid: Grid, channels: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(channels)
    return torch.randn(2, channels, *grid.shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_velocity_is_that_of_the_div_curl_least_squares(grid):
    """K v = M force: the same as asking for the divergence and curl whose least squares have that load."""
    alpha = field(grid, 1)
    metric = VelocityMetric.of(grid, SETTINGS.metric, SETTINGS.solver, alpha, below=1)
    length = 6.0 * grid.cell_volume ** (1 / grid.dim)
    weights = Weights(0.4, 1.0, 0.4 / length**2)
    assert metric.system.weights == weights
    alpha = alpha - solve_div_curl(alpha, None, grid).incompatibility.view(-1, *[1] * (grid.dim + 1))
    wanted = solve_div_curl(alpha, None, grid, weights=weights, solver=SolverSettings(method="cg", rtol=1e-12)).value
    torch.testing.assert_close(metric.factor(metric.system.load(div=alpha)), wanted, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("method", ["cg", "assembled"])
@pytest.mark.parametrize("grid", GRIDS)
def test_every_solver_gives_the_same_direction(grid, method):
    force, lowest = field(grid, grid.dim), torch.rand(2, 1, *grid.shape, dtype=torch.float64)
    barrier, points = fold_barrier(lowest, 0.15), 0.1 * field(grid, grid.dim)
    how = SolverSettings(method=method, preconditioner="jacobi", rtol=1e-12)
    found = [
        VelocityMetric.of(grid, SETTINGS.metric, solver, force).ascent(force, barrier, points)
        for solver in (SolverSettings(), how)
    ]
    torch.testing.assert_close(found[0], found[1], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_direction_has_no_unit_and_one_voxel(grid):
    force = field(grid, grid.dim)
    metric = VelocityMetric.of(grid, SETTINGS.metric, SETTINGS.solver, force)
    v = normalise_step(metric.ascent(force), grid)
    torch.testing.assert_close(max_norm(v / grid.along(grid.spacing, v)), torch.ones(2, dtype=v.dtype))
    torch.testing.assert_close(metric.ascent(1e-9 * force), metric.ascent(force))
    assert not normalise_step(torch.zeros_like(v), grid).any()
    work = (v * metric.system.mass(force)).flatten(1).sum(1)  # it is a direction of ascent
    assert (work > 0).all()


def test_the_barrier_opens_where_cells_are_small():
    lowest = torch.tensor([0.3, 0.15, 0.05, 0.01]).view(1, 1, 2, 2)
    torch.testing.assert_close(fold_barrier(lowest, 0.15).flatten(), torch.tensor([0.0, 0.0, 2.0, 14.0]))
    grid, small = GRIDS[0], torch.ones(1, 1, 12, 14, dtype=torch.float64)
    small[0, 0, 6, 7] = 0.03
    force = torch.zeros(1, 2, 12, 14, dtype=torch.float64)
    v = VelocityMetric.of(grid, SETTINGS.metric, SETTINGS.solver, force).ascent(force, fold_barrier(small, 0.15))
    assert v[0, 0, 8, 7] > 0 > v[0, 0, 4, 7]  # away from the small cell
    assert v[0, 1, 6, 9] > 0 > v[0, 1, 6, 5]


@pytest.mark.parametrize("by", ["auto", "convolution", "shifts"])
@pytest.mark.parametrize("grid", GRIDS)
def test_the_force_of_an_image_is_its_gradient(grid, by):
    slope, image = field(grid, 2), grid.points(dtype=torch.float64)[:, :2].expand(2, -1, *grid.shape).clone()
    force = image_force(slope, image, grid, by)
    torch.testing.assert_close(force[:, :2], slope)
    assert grid.dim == 2 or not force[:, 2].any()
    for rows in (slice(0, 1), slice(3, 7), slice(grid.shape[0] - 1, grid.shape[0])):
        torch.testing.assert_close(image_force(slope, image, grid, by, rows), force[:, :, rows])


def test_steps_fall_to_a_tenth():
    optimiser = settings_of(step_length=2.0).optimiser
    assert step_size(optimiser, 0, 10) == 2.0
    assert math.isclose(step_size(optimiser, 10, 10), 0.2)
    assert math.isclose(step_size(optimiser, 5, 10), 1.1)
    assert per_item(torch.ones(2), torch.ones(2, 1, 3, 3)).shape == (2, 1, 1, 1)


def tissue_on(grid: Grid, labels: torch.Tensor | None = None) -> Tissue:
    """A rigid and an own tissue; half of the first axis each, unless labels are given."""
    if labels is None:
        node = torch.arange(grid.shape[0]).view(1, 1, -1, *[1] * (grid.dim - 1))
        labels = (node >= 3).long() + (node >= 2 * grid.shape[0] // 3)
        labels = labels.expand(1, 1, *grid.shape)
    chosen = settings_of(tissues={1: "rigid", 2: {"div": 5.0, "strain": 2.0, "curl": 0.0}})
    return Tissue.of(labels, chosen, torch.zeros(1, dtype=torch.float64))


@pytest.mark.parametrize("grid", GRIDS)
def test_with_tissue_a_velocity_is_that_of_the_weights_by_element(grid):
    force, tissue, exact = field(grid, grid.dim), tissue_on(grid), SolverSettings(rtol=1e-12)
    metric = VelocityMetric.of(grid, SETTINGS.metric, exact, force, tissue=tissue)
    weights = tissue.weights(metric.system.weights)
    v = metric.velocity(force, near=torch.ones_like(force))
    system = DivCurlSystem(grid, weights, "slip")
    load, product = metric.system.load(force=force), system.product(force)(v)
    # What leads out of the box is given there.
    for axis in range(grid.dim):
        load[:, axis], product[:, axis] = (inner(part[:, axis], axis) for part in (load, product))
    torch.testing.assert_close(product, load, rtol=1e-7, atol=1e-7)


def inner(component: torch.Tensor, axis: int) -> torch.Tensor:
    """A component ``(B, *S)`` that is 0 on the two faces across an axis."""
    node = torch.arange(component.shape[axis + 1]).view([-1 if a == axis + 1 else 1 for a in range(component.dim())])
    return torch.where((node == 0) | (node == component.shape[axis + 1] - 1), 0, component)


@pytest.mark.parametrize("grid", GRIDS)
def test_tissue_is_solved_to_a_share_of_the_load_unless_told_otherwise(grid):
    force, tissue = field(grid, grid.dim), tissue_on(grid)
    exact = VelocityMetric.of(grid, SETTINGS.metric, SolverSettings(rtol=1e-12), force, tissue=tissue).ascent(force)
    metric = VelocityMetric.of(grid, SETTINGS.metric, SETTINGS.solver, force, tissue=tissue)
    rough, again = metric.ascent(force), metric.ascent(force, near=exact)
    sizes = exact.flatten(1).norm(dim=1)
    assert ((again - exact).flatten(1).norm(dim=1) < 1e-2 * sizes).all()
    assert ((rough - exact).flatten(1).norm(dim=1) < 0.5 * sizes).all()
    work = (rough * metric.system.mass(force)).flatten(1).sum(1)
    assert (work > 0).all()


@pytest.mark.parametrize("grid", GRIDS)
def test_tissue_without_prices_is_no_tissue(grid):
    force = field(grid, grid.dim)
    labels = torch.ones(1, 1, *grid.shape)
    free = Tissue.of(labels, settings_of(tissues={1: "free"}), force)
    plain = VelocityMetric.of(grid, SETTINGS.metric, SETTINGS.solver, force)
    found = VelocityMetric.of(grid, SETTINGS.metric, SETTINGS.solver, force, tissue=free)
    assert found.system.weights == plain.system.weights
    torch.testing.assert_close(found.ascent(force), plain.ascent(force), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_rigid_box_moves_as_one(grid):
    """A force on a part of a dear tissue moves all of it nearly alike, and bends what is not dear."""
    labels, force = torch.zeros(1, 1, *grid.shape), torch.zeros(1, grid.dim, *grid.shape, dtype=torch.float64)
    box = (..., *[slice(2, n - 2) for n in grid.shape])
    labels[box] = 1
    force[(0, 0, *[n // 2 for n in grid.shape])] = 1
    spread = []
    for kind in ("free", "rigid"):
        tissue = Tissue.of(labels, settings_of(tissues={1: kind}), force)
        v = VelocityMetric.of(grid, SETTINGS.metric, SolverSettings(rtol=1e-10), force, tissue=tissue).ascent(force)
        inside = v[:, 0][box].flatten()
        spread.append(float(inside.std() / inside.mean()))
    assert spread[1] < 0.3 * spread[0]


@pytest.mark.parametrize("grid", GRIDS)
def test_items_that_are_scaled_together_keep_their_proportions(grid):
    v = field(grid, grid.dim) * torch.tensor([1.0, 3.0]).view(2, 1, *[1] * grid.dim)
    together = normalise_step(v, grid, lambda sizes: sizes.amax().expand_as(sizes))
    torch.testing.assert_close(together[0] / together[1], v[0] / v[1])
    assert max_norm(together / grid.along(grid.spacing, v)).amax() == pytest.approx(1.0)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_limited_step_keeps_directions_and_cuts_what_is_long(grid):
    v = field(grid, grid.dim)
    v[1] *= 5.0  # items are scaled by themselves
    v[:, :, 3, 3] *= 3
    found = limited_step(v, grid, 1.5)
    moves = (found / grid.along(grid.spacing, v)).norm(dim=1)
    assert moves.flatten(1).amax(1).tolist() == pytest.approx([1.0, 1.0])
    along = torch.nn.functional.cosine_similarity(found, v, dim=1)
    torch.testing.assert_close(along, torch.ones_like(along))
    size = (v / grid.along(grid.spacing, v)).norm(dim=1)
    limit = 1.5 * (size**4).flatten(1).sum(1).div((size**2).flatten(1).sum(1)).sqrt()
    torch.testing.assert_close(moves, (size / per_item(limit, size)).clamp(max=1.0))


def test_a_limited_step_does_not_know_how_much_background_there_is():
    grid, wide = Grid((20, 20)), Grid((80, 80))
    v = field(grid, 2)
    padded = torch.nn.functional.pad(v, (30, 30, 30, 30))
    torch.testing.assert_close(limited_step(padded, wide, 1.5)[..., 30:50, 30:50], limited_step(v, grid, 1.5))


def test_a_step_that_nothing_asks_for_is_none():
    grid = GRIDS[0]
    zero = torch.zeros(2, 2, *grid.shape)
    assert torch.equal(limited_step(zero, grid, 1.5), zero)
    assert torch.equal(evened(zero, 0.1), zero)


def test_an_even_force_leads_the_same_way_and_is_as_strong_in_weak_places():
    force = field(Grid((60, 60)), 2)
    force[..., 30:] *= 0.01
    found = evened(force, 1e-3)
    along = torch.nn.functional.cosine_similarity(found, force, dim=1)
    torch.testing.assert_close(along, torch.ones_like(along))
    left, right = (found[..., part].square().mean().sqrt() for part in (slice(5, 20), slice(40, 55)))
    assert right / left == pytest.approx(1.0, abs=0.2)  # it was 0.01
    torch.testing.assert_close(evened(force, 1e6), force, rtol=1e-4, atol=1e-6)  # a large share changes nothing
    torch.testing.assert_close(evened(1e-3 * force, 0.1), 1e-3 * evened(force, 0.1))  # nor does the unit matter
