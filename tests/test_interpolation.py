"""Interpolation beside SimpleITK's and SciPy's, and what splines promise."""

import math

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.errors import InputError
from torchdeform.grid import Grid
from torchdeform.interpolation import MODES, interpolator

SPACING = (0.5, 2.0, 1.2)
GRIDS = {dim: Grid((7, 6, 8)[:dim], SPACING[:dim]) for dim in (2, 3)}
ITK = {"nearest": sitk.sitkNearestNeighbor, "linear": sitk.sitkLinear, "cubic": sitk.sitkBSpline3}
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.manual_seed(seed))


def scattered(grid: Grid, count: int, *, beyond: float = 0.0, seed: int = 1) -> Tensor:
    """Return points of the box and, as a share of its sides, ``beyond`` it."""
    unit = torch.rand(1, grid.dim, count, dtype=torch.float64, generator=torch.manual_seed(seed))
    sides = torch.tensor(grid.extent, dtype=torch.float64).view(1, -1, 1)
    return (unit * (1 + 2 * beyond) - beyond) * sides


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dim", [2, 3])
def test_values_are_those_of_simpleitk(dim, mode):
    """Inside, in the half voxel around, and outside, where both put the same value."""
    grid = GRIDS[dim]
    image = random(1, 1, *grid.shape)
    itk = sitk.GetImageFromArray(image[0, 0].numpy())
    itk.SetSpacing(grid.spacing[::-1])
    points = scattered(grid, 500, beyond=0.2)
    resampled = [
        sitk.Resample(itk, [1] * dim, sitk.Transform(), ITK[mode], p.flip(0).tolist(), [1.0] * dim, (), -7.0)
        for p in points[0].T
    ]
    theirs = torch.tensor([float(sitk.GetArrayFromImage(r).item()) for r in resampled], dtype=torch.float64)
    ours = interpolator(image, grid, mode=mode, outside=-7.0)(points)[0, 0]
    assert (theirs == -7).any()
    torch.testing.assert_close(ours, theirs, atol=1e-9, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_cubic_is_scipy_s_mirrored_spline(dim):
    grid = GRIDS[dim]
    image, points = random(1, 2, *grid.shape), scattered(grid, 300, beyond=0.3)
    inside = torch.stack([points[0, k].clamp(0, side) / grid.spacing[k] for k, side in enumerate(grid.extent)])
    theirs = np.stack([map_coordinates(c.numpy(), inside.numpy(), order=3, mode="mirror") for c in image[0]])
    ours = interpolator(image, grid, mode="cubic", outside=None)(points)
    torch.testing.assert_close(ours[0], torch.from_numpy(theirs), atol=1e-12, rtol=0)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("device", DEVICES)
def test_nodes_keep_their_values(dim, mode, device):
    grid = GRIDS[dim]
    image = random(1, 3, *grid.shape).to(device)
    values = interpolator(image, grid, mode=mode)(grid.points(dtype=torch.float64, device=device))
    torch.testing.assert_close(values, image, atol=1e-12, rtol=0)


@pytest.mark.parametrize(("mode", "order"), [("linear", 2), ("cubic", 4)])
def test_order_of_convergence(mode, order):
    """On a function that is even at the boundary, as the spline's mirror supposes."""

    def error(n: int) -> float:
        grid = Grid((n + 1, n + 1), (1 / n, 1 / n))

        def wave(x: Tensor) -> Tensor:
            return torch.cos(math.pi * x[:, :1]) * torch.cos(2 * math.pi * x[:, 1:])

        points = scattered(grid, 2000)
        found = interpolator(wave(grid.points(dtype=torch.float64)), grid, mode=mode)(points)
        return float((found - wave(points)).abs().max())

    assert math.log2(error(20) / error(40)) == pytest.approx(order, abs=0.2)


def test_halves_are_rounded_up_and_large_labels_stay():
    grid = Grid((2, 4))
    labels = torch.tensor([[[[1, 614454277, 614454278, 4]] * 2]], dtype=torch.float64)
    points = torch.tensor([[[0.0, 0.0, 0.0], [0.5, 1.5, 2.4999]]], dtype=torch.float64)
    assert interpolator(labels, grid, mode="nearest")(points).tolist() == [[[614454277, 614454278, 614454278]]]


@pytest.mark.parametrize("mode", MODES)
def test_nothing_and_far_away_are_outside(mode):
    grid = GRIDS[2]
    points = torch.tensor([[[math.nan, math.inf, 1e300], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    assert interpolator(random(1, 1, *grid.shape), grid, mode=mode, outside=5.0)(points).tolist() == [[[5.0] * 3]]


def test_a_batch_of_points_equals_its_items():
    grid = GRIDS[3]
    image, points = random(1, 2, *grid.shape), torch.cat([scattered(grid, 20, seed=s) for s in range(3)])
    for mode in MODES:
        at = interpolator(image, grid, mode=mode)
        torch.testing.assert_close(at(points), torch.cat([at(p.unsqueeze(0)) for p in points]))


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_of_cubic(dim):
    grid = Grid((4, 3, 5)[:dim], SPACING[:dim])
    image, points = random(1, 1, *grid.shape).requires_grad_(), scattered(grid, 4).requires_grad_()
    assert gradcheck(lambda i, p: interpolator(i, grid, mode="cubic")(p), (image, points))


def test_wrong_arguments_are_refused():
    grid = GRIDS[2]
    with pytest.raises(InputError, match="one of nearest, linear, cubic"):
        interpolator(random(1, 1, *grid.shape), grid, mode="cubc")
    with pytest.raises(InputError, match="must have shape"):
        interpolator(random(1, 1, 3, 3), grid)
