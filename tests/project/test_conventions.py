"""The conventions, one test a line: what everything else in the package takes for granted.

Each test is a picture small enough to check by hand.
"""

import math

import pytest
import torch

import torchdeform as td
from torchdeform.core.image import Image
from torchdeform.core.warp import sample


def ramp(grid: td.Grid, axis: int) -> torch.Tensor:
    """Return the image whose value at node i is its index along one axis."""
    return (grid.points() / grid.along(grid.spacing, torch.zeros(1)))[:, axis : axis + 1]


def turn(grid: td.Grid, angle: float, plane: tuple[int, int] = (0, 1)) -> torch.Tensor:
    """Return the displacement of the rotation that carries axis plane[0] towards axis plane[1]."""
    a, b = plane
    x = grid.points(dtype=torch.float64)
    u = torch.zeros_like(x)
    u[:, a] = math.cos(angle) * x[:, a] - math.sin(angle) * x[:, b] - x[:, a]
    u[:, b] = math.sin(angle) * x[:, a] + math.cos(angle) * x[:, b] - x[:, b]
    return u


@pytest.mark.parametrize("dim", [2, 3])
def test_component_k_belongs_to_array_axis_k(dim):
    """Moving by one node along axis k reads the next node of that axis, and of no other."""
    grid = td.Grid((4, 5, 6)[:dim], (0.5, 2.0, 3.0)[:dim])
    for k in range(dim):
        u = torch.zeros(1, dim, *grid.shape)
        u[:, k] = grid.spacing[k]
        for axis in range(dim):
            moved = td.warp(ramp(grid, axis), u, grid) - ramp(grid, axis)
            inner = moved.narrow(k + 2, 0, grid.shape[k] - 1)
            torch.testing.assert_close(inner, torch.full_like(inner, float(axis == k)), atol=1e-5, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_number_of_axes_comes_from_the_grid(dim):
    """(1, 2, 3, 4, 5) is a 2-channel volume and never a batch of images: the grid says which."""
    volume = torch.zeros(1, 2, 3, 4, 5)
    if dim == 3:
        assert td.warp(volume, torch.zeros(1, 3, 3, 4, 5), td.Grid((3, 4, 5))).shape == volume.shape
    else:
        with pytest.raises(td.InputError, match=r"must have shape \(B, C, 4, 5\)"):
            td.warp(volume, torch.zeros(1, 2, 4, 5), td.Grid((4, 5)))


def test_nodes_are_voxel_centres_and_the_box_ends_at_the_outermost():
    """Corners align: node n − 1 lies at (n − 1) h, and half of it is the middle of the image."""
    grid = td.Grid((5, 3), (0.5, 4.0))
    assert grid.extent == (2.0, 8.0)
    corner, middle = torch.tensor([2.0, 8.0]).view(1, 2, 1), torch.tensor([1.0, 4.0]).view(1, 2, 1)
    assert sample(ramp(grid, 0), corner, grid).item() == 4.0
    assert sample(ramp(grid, 1), middle, grid).item() == 1.0
    assert sample(ramp(grid, 0), corner + 1.7, grid).item() == 4.0  # beyond the box the boundary's value holds


def test_displacements_are_in_units_of_spacing():
    """The same 2 mm are four nodes along a 0.5 mm axis and one along a 2 mm axis."""
    grid = td.Grid((9, 9), (0.5, 2.0))
    u = torch.full((1, 2, 9, 9), 2.0)
    assert td.warp(ramp(grid, 0), u, grid)[0, 0, 0, 0].item() == pytest.approx(4.0, abs=1e-5)
    assert td.warp(ramp(grid, 1), u, grid)[0, 0, 0, 0].item() == pytest.approx(1.0, abs=1e-5)


def test_warping_pulls_back():
    """warped(x) = moving(φ(x)): a displacement towards larger indices moves the picture towards smaller ones."""
    moving = torch.zeros(1, 1, 7, 7)
    moving[0, 0, 5, 3] = 1.0
    u = torch.zeros(1, 2, 7, 7)
    u[:, 0] = 2.0
    warped = td.warp(moving, u, td.Grid((7, 7)))
    assert (warped[0, 0] > 0.5).nonzero().tolist() == [[3, 3]]


def test_points_move_from_fixed_to_moving():
    """With the φ that pulls back: φ takes the bright point of ``warped`` to the bright point of ``moving``."""
    moving = torch.zeros(1, 1, 7, 7)
    moving[0, 0, 5, 3] = 1.0
    u = torch.zeros(1, 2, 7, 7)
    u[:, 0] = 2.0
    (bright,) = (td.warp(moving, u, td.Grid((7, 7)))[0, 0] > 0.5).nonzero().tolist()
    assert [p + float(u[0, k, *bright]) for k, p in enumerate(bright)] == [5.0, 3.0]


def test_compose_applies_the_second_argument_first():
    """compose(u, w) is (id + u) ∘ (id + w); images are warped by u first, then by w."""
    grid = td.Grid((9, 9))
    x = grid.points()
    double, shift = 1.0 * x, torch.ones_like(x)  # x -> 2 x, x -> x + 1
    assert (x + td.compose(double, shift, grid))[0, 0, 1, 1].item() == pytest.approx(4.0, abs=1e-5)
    assert (x + td.compose(shift, double, grid))[0, 0, 1, 1].item() == pytest.approx(3.0, abs=1e-5)
    image = ramp(grid, 0)
    twice = td.warp(td.warp(image, double, grid), shift, grid)
    torch.testing.assert_close(twice, td.warp(image, td.compose(double, shift, grid), grid), atol=1e-4, rtol=0)


def test_the_jacobian_determinant_is_of_the_map():
    """φ = 2 x along one axis doubles the area; J is of id + u, not of u."""
    grid = td.Grid((5, 6), (0.5, 2.0))
    u = torch.zeros(1, 2, 5, 6)
    assert td.jacobian_determinant(u, grid).unique().tolist() == [1.0]
    u[:, 1] = grid.points()[:, 1]
    torch.testing.assert_close(td.jacobian_determinant(u, grid), torch.full((1, 1, 5, 6), 2.0))
    u[:, 1] = -2 * grid.points()[:, 1]  # a reflection
    torch.testing.assert_close(td.jacobian_determinant(u, grid), torch.full((1, 1, 5, 6), -1.0))


@pytest.mark.parametrize(
    ("dim", "plane", "component"), [(2, (0, 1), 0), (3, (1, 2), 0), (3, (2, 0), 1), (3, (0, 1), 2)]
)
def test_curl_of_a_rotation(dim, plane, component):
    """Carrying axis a towards axis b has ∂_a u_b − ∂_b u_a = 2 sin(angle) in the component of that pair."""
    grid = td.Grid((4, 5, 6)[:dim], (0.5, 2.0, 3.0)[:dim])
    curl = td.curl(turn(grid, 0.3, plane), grid)
    expected = torch.zeros_like(curl)
    expected[:, component] = 2 * math.sin(0.3)
    torch.testing.assert_close(curl, expected)


def test_curl_in_array_order_is_minus_the_curl_in_xyz():
    """The same rigid rotation about z, from x towards y, written in (z, y, x): the curl changes its sign."""
    grid = td.Grid((4, 5, 6))
    z, y, x = range(3)
    u = turn(grid, 0.3, (x, y))
    duy_dx, dux_dy = u[:, y].diff(dim=x + 1).mean(), u[:, x].diff(dim=y + 1).mean()
    curl_z_in_xyz = float(duy_dx - dux_dy)
    assert curl_z_in_xyz == pytest.approx(2 * math.sin(0.3))
    assert float(td.curl(u, grid)[:, z].mean()) == pytest.approx(-curl_z_in_xyz)


def test_the_world_is_in_xyz_and_the_array_in_zyx():
    """ITK's convention, LPS: one step along the last array axis is one step along world x."""
    image = Image(torch.zeros(1, 1, 2, 3, 4), td.Grid((2, 3, 4), (5.0, 3.0, 2.0)), (10.0, 20.0, 30.0))
    one_step = torch.tensor([0.0, 0.0, 2.0]).view(1, 3, 1)
    assert image.to_world(one_step).flatten().tolist() == [12.0, 20.0, 30.0]


def test_flow_and_its_inverse():
    """Positive time moves points along v, negative time against it."""
    grid = td.Grid((9, 9))
    v = torch.zeros(1, 2, 9, 9)
    v[:, 0] = 1.0
    assert td.integrate(v, grid)[0, :, 4, 4].tolist() == pytest.approx([1.0, 0.0])
    assert td.integrate(v, grid, time=-2.0)[0, :, 4, 4].tolist() == pytest.approx([-2.0, 0.0])


def test_the_same_input_gives_the_same_bits():
    grid = td.Grid((33, 35, 31))
    v = torch.randn(1, 3, *grid.shape, generator=torch.manual_seed(0))
    for function in (td.integrate, td.divergence, td.curl, td.jacobian_determinant, td.invert):
        assert torch.equal(function(v, grid), function(v, grid))
    assert torch.equal(td.warp(v, v, grid), td.warp(v, v, grid))
