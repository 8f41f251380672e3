"""Images, labels and points go the way the conventions say, in any precision."""

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp
from torchdeform.errors import InputError
from torchdeform.nn import SpatialTransformer

GRIDS = [Grid((9, 12), (1.0, 2.0)), Grid((7, 8, 9), (1.5, 1.0, 1.0))]


@pytest.mark.parametrize("grid", GRIDS)
def test_images_are_pulled_back_and_points_pushed(grid):
    """φ shifts by one voxel along axis 0: the image shows what was at x + 1, a point p goes to p + 1."""
    u = torch.zeros(1, grid.dim, *grid.shape)
    u[:, 0] = grid.spacing[0]
    image = torch.rand(1, 2, *grid.shape)
    carry = SpatialTransformer(grid)
    inside = carry(image, u).narrow(2, 0, grid.shape[0] - 1)
    assert torch.allclose(inside, image.narrow(2, 1, grid.shape[0] - 1), atol=1e-5)
    point = torch.full((1, grid.dim, 1), 2.0)
    moved = carry.points(point, u)
    assert moved[0, 0, 0] == pytest.approx(2 + grid.spacing[0])
    assert torch.equal(moved[0, 1:], point[0, 1:])


@pytest.mark.parametrize("grid", GRIDS)
def test_what_the_warped_image_shows_at_x_is_at_phi_of_x(grid, make_displacement):
    u = make_displacement(grid, 0.1)
    ramp = grid.points()
    carry = SpatialTransformer(grid)
    points = grid.points().flatten(2)
    assert torch.allclose(carry(ramp, u).flatten(2), carry.points(points, u), atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.bool, torch.float32, torch.float64])
def test_labels_keep_their_values_and_type(dtype, make_displacement):
    grid = GRIDS[0]
    labels = torch.randint(0, 2, (2, 1, *grid.shape)).to(dtype)
    u = make_displacement(grid, 0.1).expand(2, -1, -1, -1)
    moved = SpatialTransformer(grid).label(labels, u)
    assert moved.dtype == dtype
    assert torch.equal(moved.float(), warp(labels.float(), u, grid, mode="nearest"))


def test_half_precision_images_are_sampled_where_they_should_be():
    """Positions in bfloat16 would be a voxel off in an image this long."""
    grid = Grid((4, 700))
    image = torch.rand(1, 1, *grid.shape)
    u = torch.zeros(1, 2, *grid.shape)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        same = SpatialTransformer(grid)(image.bfloat16(), u)
    assert same.dtype == torch.bfloat16
    assert torch.allclose(same.float(), image, atol=1e-2)


def test_outside():
    grid = GRIDS[0]
    u = torch.full((1, 2, *grid.shape), 100.0)
    image = torch.ones(1, 1, *grid.shape)
    assert SpatialTransformer(grid)(image, u).min() == 1
    assert SpatialTransformer(grid, outside=0.0)(image, u).max() == 0
    assert SpatialTransformer(grid, outside=0.0).label(image.long(), u).max() == 0


@pytest.mark.parametrize("grid", [Grid((4, 5)), Grid((4, 3, 4))])
def test_gradcheck(grid, make_displacement):
    u = (make_displacement(grid, 0.11) + 0.013).double().requires_grad_()
    image = torch.rand(1, 1, *grid.shape, dtype=torch.float64).requires_grad_()
    points = (grid.points(dtype=torch.float64).flatten(2)[..., :5] * 0.73 + 0.21).requires_grad_()
    carry = SpatialTransformer(grid)
    assert torch.autograd.gradcheck(carry, (image, u))
    assert torch.autograd.gradcheck(carry.points, (points, u))


def test_wrong_input_is_refused():
    grid = GRIDS[0]
    with pytest.raises(InputError, match="mode"):
        SpatialTransformer(grid, mode="cubical")
    with pytest.raises(InputError, match="image must have shape"):
        SpatialTransformer(grid)(torch.zeros(1, 1, 3, 3), torch.zeros(1, 2, *grid.shape))
    with pytest.raises(InputError, match="u must have shape"):
        SpatialTransformer(grid).points(torch.zeros(1, 2, 1), torch.zeros(1, 3, *grid.shape))
    with pytest.raises(InputError, match="points must have shape"):
        SpatialTransformer(grid).points(torch.zeros(1, 3, 1), torch.zeros(1, 2, *grid.shape))
