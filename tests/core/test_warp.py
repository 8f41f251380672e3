"""Sampling against independent samplers, and what warp, compose and invert promise."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core import grid as core_grid
from torchdeform.core import warp as module
from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import compose, invert, max_voxels, sample, warp, warp_by_rows
from torchdeform.errors import InputError

UNTIMED = settings(deadline=None, max_examples=40)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SPACING = (0.5, 2.0, 1.2)
GRIDS = {dim: Grid((7, 6, 8)[:dim], SPACING[:dim]) for dim in (2, 3)}


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.manual_seed(seed))


def random_displacement(grid: Grid, voxels: float, *, items: int = 1, seed: int = 0) -> Tensor:
    return voxels * random(items, grid.dim, *grid.shape, seed=seed) * grid.along(grid.spacing, torch.zeros(1).double())


def onto(grid: Grid, strength: float) -> tuple[Tensor, Tensor]:
    """Return displacements of x -> x / (x + c (1 − x)) along each axis of the unit box, and of its inverse (1/c)."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.zeros(1).double())
    u, w = (unit / (unit + c * (1 - unit)) - unit for c in (strength, 1 / strength))
    scale = grid.along(grid.extent, unit)
    return u * scale, w * scale


def swirl(grid: Grid, turns: float, steps: int = 64) -> Tensor:
    """Return a strong fold-free map of Ω onto itself: the flow of a rotation that is zero on the boundary."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.zeros(1).double())
    bump = torch.sin(math.pi * unit).prod(dim=1, keepdim=True)
    v = torch.cat([bump * 0.8 * turns * (0.5 - unit[:, 1:2]), bump * turns * (unit[:, :1] - 0.5)], dim=1)
    v = torch.cat([v, torch.zeros_like(unit[:, 2:])], dim=1) * grid.along(grid.extent, unit) / steps
    u = torch.zeros_like(v)
    for _ in range(steps):
        u = compose(v, u, grid)
    return u


@pytest.mark.parametrize("items", [(1, 1), (2, 1), (1, 2), (2, 2)])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float32, 1e-5), (torch.float64, 1e-13)])
def test_volumes_are_gathered_as_grid_sample_does(items, dtype, atol, monkeypatch):
    monkeypatch.setattr(module, "_POINTS_AT_ONCE", 100)
    image, places = random(items[0], 3, 5, 2, 7).to(dtype), 0.8 * random(items[1], 3, 6, 9, 8).to(dtype)
    theirs = F.grid_sample(*batch(image, places.movedim(1, -1)), padding_mode="border", align_corners=True)
    for threads in (1, 2):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        with torch.no_grad():
            torch.testing.assert_close(module._gathered(image, places), theirs, rtol=0, atol=atol)
    places[:, :, 0] = torch.nan  # of a map that broke down: no place, but no other's harm
    with torch.no_grad():
        found = module._gathered(image, places)
    torch.testing.assert_close(found[:, :, 1:], theirs[:, :, 1:], rtol=0, atol=atol)


def batch(*fields: Tensor) -> list[Tensor]:
    return [field.expand(max(map(len, fields)), *field.shape[1:]) for field in fields]


def test_a_displacement_by_rows_warps_as_a_whole_one(monkeypatch):
    monkeypatch.setattr(core_grid, "_SLAB_NODES", {"cpu": 1})
    grid = Grid((21, 6, 8), SPACING)
    image, u = random(1, 2, *grid.shape), random_displacement(grid, 2.0)
    with torch.no_grad():
        torch.testing.assert_close(warp_by_rows(image, lambda rows: u[:, :, rows], grid), warp(image, u, grid))
    u.requires_grad_()
    (found,) = torch.autograd.grad(warp_by_rows(image, lambda rows: u[:, :, rows], grid).square().sum(), u)
    torch.testing.assert_close(found, torch.autograd.grad(warp(image, u, grid).square().sum(), u)[0])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("mode", "degree"), [("linear", 1), ("nearest", 0)])
@pytest.mark.parametrize("dim", [2, 3])
def test_sample_is_scipys(dim, mode, degree, dtype, device):
    """On points inside and outside: beyond the boundary the nearest value holds."""
    grid = GRIDS[dim]
    image, index = random(2, 3, *grid.shape), 12 * torch.rand(2, dim, 50, dtype=torch.float64) - 3
    expected = np.stack([
        [map_coordinates(channel.numpy(), where.numpy(), order=degree, mode="nearest") for channel in item]
        for item, where in zip(image, index, strict=True)
    ])  # fmt: skip
    points = index * grid.along(grid.spacing, index).view(1, dim, 1)
    found = sample(image.to(device, dtype), points.to(device, dtype), grid, mode=mode)
    assert (found.dtype, found.shape) == (dtype, (2, 3, 50))
    error = (found.cpu().double() - torch.from_numpy(expected)).abs().max()
    assert float(error) < (1e-4 if dtype == torch.float32 else 1e-12)


def test_warp_is_kornias_remap():
    from kornia.geometry.transform import remap

    grid = Grid((17, 21))
    image, u = random(2, 3, 17, 21), random_displacement(grid, 3.0, items=2)
    y, x = (grid.points(dtype=torch.float64) + u).unbind(1)
    expected = remap(image, x, y, padding_mode="border", align_corners=True)
    torch.testing.assert_close(warp(image, u, grid), expected)


@UNTIMED
@given(data=st.data(), dim=st.sampled_from([2, 3]), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_invariants(data, dim, dtype):
    """No displacement gives the image back; a constant stays; u = const shifts by whole nodes; values stay in range."""
    shape = data.draw(st.tuples(*[st.integers(2, 7)] * dim))
    grid = Grid(shape, data.draw(st.tuples(*[st.floats(0.1, 10)] * dim)))
    image = random(1, 2, *shape, seed=data.draw(st.integers(0, 99))).to(dtype)
    close = {"atol": 1e-5 if dtype == torch.float32 else 1e-12, "rtol": 0}
    zero = torch.zeros(1, dim, *shape, dtype=dtype)
    torch.testing.assert_close(warp(image, zero, grid), image, **close)
    u = random_displacement(grid, 2.0).to(dtype)
    torch.testing.assert_close(warp(torch.full_like(image, 3.0), u, grid), torch.full_like(image, 3.0), **close)
    warped = warp(image, u, grid)
    assert image.min() - 1e-5 <= warped.min()
    assert warped.max() <= image.max() + 1e-5
    shift = zero.clone()
    shift[:, 0] = grid.spacing[0]
    torch.testing.assert_close(warp(image, shift, grid)[:, :, :-1], image[:, :, 1:], **close)
    torch.testing.assert_close(compose(u, zero, grid), u, atol=1e-4, rtol=0)
    torch.testing.assert_close(compose(zero, u, grid), u)


@pytest.mark.parametrize("dim", [2, 3])
def test_linear_functions_are_sampled_exactly(dim):
    """Hence the composition of affine maps is the product of their matrices."""
    grid = GRIDS[dim]
    x, centre = grid.points(dtype=torch.float64), grid.along([e / 2 for e in grid.extent], random(1))
    a, b = 0.3 * random(dim, dim, seed=1), 0.3 * random(dim, dim, seed=2)
    u, w = (torch.einsum("ij,bj...->bi...", m - torch.eye(dim), x - centre) for m in (a, b))
    torch.testing.assert_close(compose(u, w, grid), torch.einsum("ij,bj...->bi...", a @ b - torch.eye(dim), x - centre))


@pytest.mark.parametrize("mode", ["linear", "nearest"])
def test_outside_begins_half_a_voxel_beyond_the_last_node(mode):
    grid = Grid((3, 4), (2.0, 1.0))
    image = torch.ones(1, 1, 3, 4)
    rows = torch.tensor([-1.01, -1.0, 0.0, 4.0, 4.99, 5.0])
    points = torch.stack([rows, torch.ones(6)])[None]
    assert sample(image, points, grid, mode=mode, outside=-7.0).flatten().tolist() == [-7, 1, 1, 1, 1, -7]
    assert sample(image, points, grid, mode=mode).flatten().tolist() == [1] * 6
    u = torch.zeros(1, 2, 3, 4)
    u[:, 1, :, -1] = 0.6
    assert warp(image, u, grid, mode=mode, outside=-7.0)[0, 0, 0].tolist() == [1, 1, 1, -7]


def test_labels_stay_labels():
    labels = torch.randint(0, 5, (1, 1, 9, 9)).float()
    warped = warp(labels, random_displacement(Grid((9, 9)), 1.3).float(), Grid((9, 9)), mode="nearest")
    assert set(warped.unique().tolist()) <= set(labels.unique().tolist())


@pytest.mark.parametrize("dim", [2, 3])
def test_a_batch_equals_its_items(dim):
    """Also where one image serves many displacements, or one displacement many images."""
    grid = GRIDS[dim]
    images, u = random(3, 2, *grid.shape), random_displacement(grid, 1.5, items=3)
    u[1] *= 20
    for left, right in ((images, u), (images[:1], u), (images, u[:1])):
        pairs = zip(left.expand(3, *left.shape[1:]), right.expand(3, *right.shape[1:]), strict=True)
        assert torch.equal(warp(left, right, grid), torch.cat([warp(a[None], b[None], grid) for a, b in pairs]))


def test_the_number_of_threads_changes_nothing(monkeypatch):
    """A single image is dealt out over the threads; an image that wants a gradient is not."""
    grid = Grid((40, 37, 29))
    image, u = random(1, 2, *grid.shape).float(), random_displacement(grid, 2.0).float()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    whole = warp(image, u, grid)
    for threads in (2, 3, 4):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert torch.equal(warp(image, u, grid), whole)
        wanted = image.clone().requires_grad_()
        torch.testing.assert_close(warp(wanted, u, grid), whole, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients(dim):
    grid = Grid((4, 3, 3)[:dim], SPACING[:dim])
    image, u, w = (random(1, dim, *grid.shape, seed=k) for k in range(3))
    inside = grid.points(dtype=torch.float64).clamp(min=0.1)  # points between nodes, where the derivative exists
    u, w = (0.3 * field.tanh() + (inside - grid.points(dtype=torch.float64)) for field in (u, w))
    fields = [field.requires_grad_() for field in (image, u, w)]
    assert gradcheck(lambda a, b: warp(a, b, grid), fields[:2])
    assert gradcheck(lambda a, b: compose(a, b, grid), fields[1:])
    points = (0.9 * random(1, dim, 5).sigmoid() * 1.0).requires_grad_()
    assert gradcheck(lambda a, p: sample(a, p, grid), (fields[0], points))


@pytest.mark.parametrize("dim", [2, 3])
def test_invert_of_a_known_map(dim):
    """The inverse of a map of Ω onto Ω in closed form, up to the interpolation error, which falls as h²."""

    def error(nodes: int) -> float:
        grid = Grid((nodes, nodes + 1, nodes + 2)[:dim], SPACING[:dim])
        u, exact = onto(grid, 2.5)
        return float(max_voxels(invert(u, grid, atol=1e-10) - exact, grid)) / nodes

    assert error(17) < 3e-3
    assert math.log(error(17) / error(33)) / math.log(2) == pytest.approx(2, abs=0.2)


def test_invert_of_a_turned_and_shrunk_image():
    """φ(x) = c + 0.6 R (x − c) by 40 degrees is affine, so exact; its inverse is known where x lies in φ(Ω)."""
    grid = Grid((21, 25), (0.5, 0.4))
    x, centre = grid.points(dtype=torch.float64), grid.along([e / 2 for e in grid.extent], random(1))
    cos, sin = math.cos(0.7), math.sin(0.7)
    matrix = 0.6 * torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    u = torch.einsum("ij,bj...->bi...", matrix, x - centre) + centre - x
    exact = torch.einsum("ij,bj...->bi...", matrix.inverse(), x - centre) + centre - x
    reached = ((x + exact >= 0) & (x + exact <= grid.along(grid.extent, x))).all(dim=1, keepdim=True)
    assert 0.2 < float(reached.double().mean()) < 0.8
    assert float(((invert(u, grid, atol=1e-9) - exact) * reached).abs().max()) < 1e-8


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("dim", "turns"), [(2, 1.5), (2, 2.2), (3, 2.2)])
def test_invert_of_strong_maps(dim, turns, dtype):
    """Points travel a third of the image and turn by more than a right angle; the plain fixed point diverges there."""
    grid = Grid((48, 40, 32)[:dim], SPACING[:dim])
    u = swirl(grid, turns).to(dtype)
    assert 0 < float(smallest_determinant(u, grid)) < 0.5
    w, error = invert(u, grid, return_error=True)
    assert float(error) <= 1e-4
    torch.testing.assert_close(error, max_voxels(compose(u, w, grid), grid))


def test_invert_is_honest_about_folds():
    """One item folds, one does not: each has its own error, and nothing becomes infinite."""
    grid = Grid((24, 20))
    u = torch.cat([swirl(grid, 1.5), random_displacement(grid, 3.0)])
    w, error = invert(u, grid, return_error=True)
    assert bool(w.isfinite().all())
    assert float(error[0]) <= 1e-4
    assert float(error[1]) > 0.1
    assert torch.equal(invert(u[:1], grid), w[:1])


@pytest.mark.parametrize("shape", [(2, 14, 16), (14, 16, 2), (2, 16)])
def test_folds_of_what_is_thin_have_a_finite_inverse_too(shape):
    """Nodes that Newton's method lost begin again from their neighbours, of which there are two along an axis."""
    grid = Grid(shape)
    w, error = invert(2.0 * random(1, grid.dim, *shape).float(), grid, return_error=True)
    assert error > 0.01
    assert w.isfinite().all()


def test_gradient_of_the_inverse():
    """Against a difference quotient on a smooth map: exact up to the second-order differences that it uses."""
    grid = Grid((65, 65))
    u, probe = swirl(grid, 1.5), swirl(grid, -1.0)
    target = swirl(grid, 0.7) + grid.points(dtype=torch.float64)
    wanted = u.clone().requires_grad_()
    w = invert(wanted, grid)
    assert torch.equal(w, invert(u, grid))
    (gradient,) = torch.autograd.grad((w * target).sum(), wanted)
    step = 1e-4
    ahead, behind = ((invert(u + t * probe, grid, atol=1e-10) * target).sum() for t in (step, -step))
    assert float((gradient * probe).sum()) == pytest.approx(float(ahead - behind) / (2 * step), rel=0.02)


def test_wrong_input_is_refused():
    grid = Grid((4, 5))
    image, u = torch.zeros(1, 1, 4, 5), torch.zeros(1, 2, 4, 5)
    with pytest.raises(InputError, match="mode must be one of linear, nearest, got 'cubik'"):
        warp(image, u, grid, mode="cubik")
    with pytest.raises(InputError, match="warp: u must have shape"):
        warp(image, u[:, :1], grid)
    with pytest.raises(InputError, match="warp: image must have shape"):
        warp(image[..., :-1], u, grid)
    with pytest.raises(InputError, match="sample: image must have shape"):
        sample(image[0], u, grid)
    with pytest.raises(InputError, match=r"points must have shape \(B, 2, \*T\), got \(1, 3, 7\)"):
        sample(image, torch.zeros(1, 3, 7), grid)
    with pytest.raises(InputError, match=r"got torch\.int64"):
        sample(image, torch.zeros(1, 2, 7, dtype=torch.int64), grid)
    with pytest.raises(InputError, match="image has 2 batch items but the points have 3"):
        warp(image.expand(2, -1, -1, -1), u.expand(3, -1, -1, -1), grid)
    with pytest.raises(InputError, match="compose: w"):
        compose(u, u[..., :-1], grid)
    with pytest.raises(InputError, match="invert: u"):
        invert(image, grid)


def test_no_points_have_no_values():
    grid = Grid((5, 6))
    assert sample(torch.rand(2, 3, 5, 6), torch.zeros(2, 2, 0), grid).shape == (2, 3, 0)
