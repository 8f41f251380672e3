"""Interpolation beside SimpleITK's and SciPy's, what splines promise, and how labels are voted on."""

import math

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import convolve1d, map_coordinates
from torch import Tensor
from torch.autograd import gradcheck

import torchdeform.core.interpolation as module
from torchdeform.core.grid import Grid
from torchdeform.core.interpolation import MODES, interpolator
from torchdeform.errors import InputError

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


@pytest.mark.parametrize("mode", ITK)
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


@pytest.mark.parametrize("mode", ITK)
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
    with pytest.raises(InputError, match="one of nearest, linear, cubic, label"):
        interpolator(random(1, 1, *grid.shape), grid, mode="cubc")
    with pytest.raises(InputError, match="must have shape"):
        interpolator(random(1, 1, 3, 3), grid)


# --- labels -----------------------------------------------------------------------------------------------------------


def blobs(shape: tuple[int, ...], count: int, *, seed: int = 0) -> Tensor:
    """Return ``(1, 1, *S)`` with about ``count`` labels that touch, each node having that of the nearest centre."""
    generator = torch.manual_seed(seed)
    centres = torch.rand(count, len(shape), generator=generator) * torch.tensor(shape)
    labels = torch.randint(1, 10**6, (count,), generator=generator).double()
    labels[0] = 0
    nodes = Grid(shape).points()[0].flatten(1).T
    return labels[torch.cdist(nodes, centres).argmin(1)].view(1, 1, *shape)


def votes(labels: Tensor, grid: Grid, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the labels there are, and for each (SciPy) its smoothed indicator, interpolated linearly."""
    known = labels.unique()
    index = [(points[0, k] / h).clamp(0, n - 1) for k, (h, n) in enumerate(zip(grid.spacing, grid.shape, strict=True))]
    aside = 1 / (2 + math.exp(2))  # a Gaussian of half a voxel on three nodes
    found = []
    for label in known:
        indicator = (labels[0, 0] == label).double().numpy()
        for axis in range(grid.dim):
            indicator = convolve1d(indicator, [aside, 1 - 2 * aside, aside], axis, mode="mirror")
        found.append(torch.from_numpy(map_coordinates(indicator, torch.stack(index).numpy(), order=1, mode="mirror")))
    return known, torch.stack(found)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("dim", "count"), [(2, 3), (2, 40), (3, 3), (3, 60)])
def test_labels_are_those_with_the_largest_indicator(dim, count, device):
    grid = Grid((19, 17, 18)[:dim], SPACING[:dim])
    labels, points = blobs(grid.shape, count), scattered(grid, 4000)
    known, indicators = votes(labels, grid, points)
    first, second = indicators.topk(2, dim=0).values
    clear = first - second > 1e-5
    assert clear.double().mean() > 0.99
    found = interpolator(labels.to(device), grid, mode="label")(points.to(device))[0, 0].cpu()
    assert torch.equal(found[clear], known[indicators.argmax(0)][clear])
    nearest = interpolator(labels, grid, mode="nearest")(points)[0, 0]
    assert (found != nearest).double().mean() > 0.005


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([(6, 7), (2, 9), (5, 4, 6), (2, 2, 3)]), st.integers(2, 30))
def test_labels_are_copied(seed, shape, count):
    """Whatever is asked for is a label that a node near it has."""
    grid = Grid(shape)
    labels, points = blobs(shape, count, seed=seed), scattered(grid, 100, beyond=0.3, seed=seed)
    found = interpolator(labels, grid, mode="label", outside=-1.0)(points)
    nearest = interpolator(labels, grid, mode="nearest", outside=-1.0)(points)
    assert torch.equal(found == -1, nearest == -1)
    assert set(found.unique().tolist()) <= {-1.0, *labels.unique().tolist()}
    assert not interpolator(labels, grid, mode="label")(grid.points() + 1e4).any()


def test_a_smooth_border_stays_smooth():
    """A disc shifted by fractions of a voxel: fewer nodes are wrong than with the nearest label."""
    grid = Grid((64, 64))

    def disc(shift: float) -> Tensor:
        middle = torch.tensor([31.0, 31.0]).view(1, 2, 1, 1) + shift
        return ((grid.points() - middle).square().sum(1, keepdim=True) < 15.0**2).float()

    def wrong(mode: str) -> int:
        at, nodes = interpolator(disc(0.0), grid, mode=mode), grid.points(dtype=torch.float64)
        return sum(int((at(nodes - shift) != disc(shift)).sum()) for shift in (0.2, 0.37, 0.5, 0.61))

    assert wrong("label") < 0.8 * wrong("nearest")


def test_what_is_two_voxels_thick_stays():
    grid = Grid((20, 20, 20))
    labels = torch.zeros(1, 1, 20, 20, 20)
    labels[..., 5:7, 3:17, 3:17], labels[..., 12:14, 12:14, 12:14] = 3, 8
    found = interpolator(labels, grid, mode="label")(grid.points(dtype=torch.float64))
    assert torch.equal(found, labels.where(labels == 8, found))
    assert (found == 3).sum() >= 0.95 * (labels == 3).sum()


def test_labels_of_several_channels_and_many_points_at_once(monkeypatch):
    grid = GRIDS[3]
    labels = torch.cat([blobs(grid.shape, 5, seed=s) for s in range(3)], dim=1)
    points = torch.cat([scattered(grid, 200, seed=s) for s in range(2)]).unflatten(2, (10, 20))
    whole = interpolator(labels, grid, mode="label")(points)
    monkeypatch.setattr(module, "_POINTS_AT_ONCE", 7)
    assert torch.equal(interpolator(labels, grid, mode="label")(points), whole)
    for channel in range(3):
        alone = interpolator(labels[:, channel : channel + 1], grid, mode="label")(points)
        assert torch.equal(alone, whole[:, channel : channel + 1])


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_labels_that_are_not_finite_are_refused(value):
    labels = blobs((6, 7), 3)
    labels[0, 0, 2, 2] = value
    with pytest.raises(InputError, match="labels must be finite numbers"):
        interpolator(labels, Grid((6, 7)), mode="label")
