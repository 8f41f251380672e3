"""Maps that glide along the boundary, and data that are not prescribed everywhere."""

import math

import pytest
import torch
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core.derivatives import curl, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.warp import max_voxels
from torchdeform.deformation.prescribed import from_jacobian_and_curl
from torchdeform.errors import InputError
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.solvers.base import Status

GRIDS = [Grid((41, 52), (1.0, 0.8)), Grid((15, 18, 16), (1.0, 0.8, 1.2))]


def gliding(grid: Grid, cells: float = 0.5) -> Tensor:
    """A map that leads nothing out of the box and moves nodes of its faces along them by so many cells."""
    angle = grid.points(dtype=torch.float64) * grid.along([math.pi / e for e in grid.extent], torch.empty(0).double())
    parts = []
    for k in range(grid.dim):
        own, first, last = (angle[:, a : a + 1] for a in (k, (k + 1) % grid.dim, (k - 1) % grid.dim))
        wave = torch.sin(own) * (torch.cos(first) + 0.4 * torch.cos(2 * last + 0.3)) + 0.2 * torch.sin(2 * own)
        parts.append(cells / 1.2 * grid.spacing[k] * wave)
    return torch.cat(parts, dim=1)


def glide(u: Tensor, grid: Grid) -> float:
    """The largest displacement of a node on a face along it, in cells."""
    scaled = u / grid.along(grid.spacing, u)
    return max(float(scaled.select(axis, end).abs().max()) for axis in grid.axes for end in (0, -1))


def data(u: Tensor, grid: Grid, order: int = 2) -> tuple[Tensor, Tensor]:
    return jacobian_determinant(u, grid, order), curl(u, grid, order)


def without_boundary(field: Tensor, layers: int = 1) -> Tensor:
    kept = torch.full_like(field, math.nan)
    inside = (..., *[slice(layers, -layers)] * (field.dim() - 2))
    kept[inside] = field[inside]
    return kept


def error(found: Tensor, u: Tensor, grid: Grid) -> float:
    return float(max_voxels(found - u, grid).max())


@pytest.mark.parametrize("order", [2, 4])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_map_that_glides_by_half_a_cell_comes_back(grid, order):
    u = gliding(grid)
    assert glide(u, grid) > 0.5
    found = from_jacobian_and_curl(*data(u, grid, order), grid, boundary="slip", order=order)
    assert found.ok
    assert error(found.value, u, grid) < 1e-8
    assert int(found.steps) <= 6
    assert int(diagnose(found.value, grid).folds) == 0
    assert not bool(found.value.masked_select(fixed_unknowns("slip", grid)).any())


def test_without_slip_it_does_not():
    u = gliding(GRIDS[0])
    found = from_jacobian_and_curl(*data(u, GRIDS[0]), GRIDS[0])
    assert found.status == (Status.STAGNATED,)
    assert error(found.value, u, GRIDS[0]) > 0.4


@pytest.mark.parametrize("grid", GRIDS)
def test_what_leads_out_may_be_given(grid):
    stretch = torch.tensor([[0.1, 0.02, 0.0], [-0.03, -0.1, 0.02], [0.0, 0.01, 0.05]])[: grid.dim, : grid.dim].double()
    u = gliding(grid) + torch.einsum("ka,ba...->bk...", stretch, grid.points(dtype=torch.float64))
    given = u.masked_fill(~fixed_unknowns("slip", grid), math.inf).nan_to_num(posinf=7.0)  # the rest does not matter
    found = from_jacobian_and_curl(*data(u, grid), grid, boundary="slip", boundary_displacement=given)
    assert found.ok
    assert error(found.value, u, grid) < 1e-8


@pytest.mark.parametrize(("grid", "near"), [(GRIDS[0], 2e-4), (GRIDS[1], 5e-3)])
def test_without_the_rows_of_the_boundary_the_inside_determines_most(grid, near):
    u = gliding(grid)
    f, g = (without_boundary(field) for field in data(u, grid))
    found = from_jacobian_and_curl(f, g, grid, boundary="slip")
    assert found.ok
    assert error(found.value, u, grid) < near
    on_boundary = from_jacobian_and_curl(f, g, grid, boundary_displacement=u)
    assert on_boundary.ok
    assert error(on_boundary.value, u, grid) < near


def test_rows_of_the_boundary_by_other_differences_spoil_more_than_they_tell():
    """Differences of first order at the boundary, as many tools take them, against none at all."""
    grid = GRIDS[0]
    u = gliding(grid)
    f, g = data(u, grid)
    rows, columns = (torch.gradient(u[0], spacing=grid.spacing[a], dim=a + 1)[0] for a in (0, 1))
    first = ((1 + rows[0]) * (1 + columns[1]) - rows[1] * columns[0]).view_as(f), (rows[1] - columns[0]).view_as(g)
    edge = without_boundary(f).isnan()
    assert float((first[0] - f).abs()[~edge].max()) < 1e-12
    spoilt = from_jacobian_and_curl(*first, grid, boundary="slip")
    left_out = from_jacobian_and_curl(*map(without_boundary, first), grid, boundary="slip")
    assert error(left_out.value, u, grid) < error(spoilt.value, u, grid) / 5


@pytest.mark.parametrize("boundary", ["dirichlet", "slip"])
@pytest.mark.parametrize("grid", [Grid((21, 26), (1.0, 0.8)), Grid((10, 12, 11), (1.0, 0.8, 1.2))])
def test_a_few_numbers_that_are_missing_change_nothing(grid, boundary):
    u = gliding(grid).masked_fill(fixed_unknowns(boundary, grid), 0)
    missing = torch.rand(1, 2, *grid.shape, generator=torch.manual_seed(0)) < 0.01
    f, g = data(u, grid)
    f, g = f.masked_fill(missing[:, :1], math.nan), g.masked_fill(missing[:, 1:], math.nan)
    found = from_jacobian_and_curl(f, g, grid, boundary=boundary)
    assert found.ok
    assert error(found.value, u, grid) < 1e-8


def test_the_determinant_of_a_region_alone_may_be_prescribed():
    grid = Grid((40, 44))
    f = torch.full((1, 1, 40, 44), math.nan, dtype=torch.float64)
    f[..., 12:28, 15:30] = 0.8
    found = from_jacobian_and_curl(f, torch.zeros_like(f), grid, boundary="slip")
    assert found.ok
    det = jacobian_determinant(found.value, grid)
    torch.testing.assert_close(det[..., 12:28, 15:30], torch.full((1, 1, 16, 15), 0.8).double(), rtol=0, atol=1e-7)
    assert float(found.smallest) > 0.4


def test_a_batch_equals_its_items_one_by_one():
    grid = GRIDS[0]
    u = torch.cat([gliding(grid), gliding(grid, 0.3), gliding(grid, -0.4)])
    f, g = data(u, grid)
    f, g = torch.cat([f[:1], without_boundary(f[1:])]), torch.cat([g[:1], without_boundary(g[1:2]), g[2:]])
    f[2, :, 10:12, 5:9] = math.nan
    together = from_jacobian_and_curl(f, g, grid, boundary="slip")
    assert together.ok
    for i in range(3):
        alone = from_jacobian_and_curl(f[i : i + 1], g[i : i + 1], grid, boundary="slip")
        terms = (int(alone.steps) + 5) * terms_of_a_solve(grid)
        assert_same_to_rounding(together.value[i : i + 1], alone.value, terms, condition_of_a_solve(grid))
        assert together.steps[i] == alone.steps[0]
        assert together.linear_steps[i] == alone.linear_steps[0]


@pytest.mark.parametrize(
    ("grid", "noise"), [(Grid((6, 5), (0.7, 1.2)), 0.0), (Grid((5, 4)), 0.05), (Grid((3, 4, 3), (0.7, 1.2, 0.9)), 0.05)]
)
def test_derivatives_with_slip_and_where_nothing_is_prescribed(grid, noise):
    torch.manual_seed(0)
    u = 0.1 * torch.randn(2, grid.dim, *grid.shape, dtype=torch.float64)
    f, g = data(u, grid)
    f, g = f * torch.exp(noise * torch.randn_like(f)), g + noise * torch.randn_like(g)
    f[0, :, 2, 1:3], g[0, :, 0, 0], g[1, :, 1, 2], f[1, :, -1, -1] = (math.nan,) * 4
    missing = f.isnan(), g.isnan()
    inputs = [field.nan_to_num(1.0).requires_grad_() for field in (f, g)]

    def solve(f, g, values):
        f, g = f.masked_fill(missing[0], math.nan), g.masked_fill(missing[1], math.nan)
        return from_jacobian_and_curl(f, g, grid, boundary="slip", boundary_displacement=values).value

    assert gradcheck(solve, (*inputs, u.clone().requires_grad_()), fast_mode=True)
    raw = [field.clone().requires_grad_() for field in (f, g)]
    from_jacobian_and_curl(*raw, grid, boundary="slip", boundary_displacement=u).value.square().sum().backward()
    for field, where in zip(raw, missing, strict=True):
        assert field.grad is not None
        assert bool(field.grad.isfinite().all())
        assert not bool(field.grad[where].any())
        assert bool(field.grad[~where].any())


GRID = Grid((5, 6))
ONE, ZERO, NAN = torch.ones(1, 1, 5, 6), torch.zeros(1, 1, 5, 6), torch.full((1, 1, 5, 6), math.nan)


@pytest.mark.parametrize(
    ("f", "g", "options", "message"),
    [
        (NAN, NAN, {}, "an item has NaN everywhere in f and curl; prescribe at least one"),
        (torch.cat([ONE, NAN]), torch.cat([ZERO, NAN]), {}, "an item has NaN everywhere"),
        (ONE, ZERO, {"boundary": "free"}, "boundary must be one of dirichlet, slip"),
        (ONE, ZERO, {"boundary_displacement": torch.cat([NAN, NAN], 1)}, "boundary_displacement finite"),
        (ONE, ZERO + math.inf, {}, "curl must be finite, or NaN for not prescribed"),
        (torch.where(torch.arange(6) > 2, NAN, -ONE), ZERO, {}, "f must be positive, got -1"),
    ],
)
def test_wrong_input_is_refused(f, g, options, message):
    with pytest.raises(InputError, match=message):
        from_jacobian_and_curl(f, g, GRID, **options)
