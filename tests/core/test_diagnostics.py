"""The certificate against the published package, and the rest of the diagnosis against definitions."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdeform.core import grid as grids
from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.diagnostics import (
    diagnose,
    inverse_error,
    one_sided_determinant,
    smallest_determinant,
)
from torchdeform.core.grid import Grid
from torchdeform.core.warp import invert
from torchdeform.errors import InputError

UNTIMED = settings(deadline=None, max_examples=30)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SPACING = (0.5, 2.0, 1.2)


def random_displacement(grid: Grid, voxels: float, *, items: int = 1, seed: int = 0) -> Tensor:
    noise = torch.randn(items, grid.dim, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(seed))
    return voxels * noise * grid.along(grid.spacing, noise)


def published(u: Tensor, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return the determinants of all one-sided frames and the central one of one item, by digital-diffeomorphism."""
    package = pytest.importorskip("digital_diffeomorphism.jacobian_calculator_torch")
    voxels = np.moveaxis((u / grid.along(grid.spacing, u))[0].numpy(), 0, -1)
    identity = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1)
    calculate = {2: package.calc_jacdets_2d, 3: package.calc_jacdets_3d}[grid.dim]
    found = calculate((voxels + identity).astype(np.float32), torch.device("cpu"))
    central = found.pop("0" * grid.dim)
    return np.stack([det / (2 if "*" in frame else 1) for frame, det in found.items()]), central


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("voxels", [0.1, 0.3, 2.0])
@pytest.mark.parametrize("device", DEVICES)
def test_folds_are_those_of_the_published_package(dim, voxels, device):
    """From none to almost everywhere, boundary included, on anisotropic grids."""
    for seed, shape in enumerate([(9, 12, 7), (2, 3, 9), (16, 5, 11)]):
        grid = Grid(shape[:dim], SPACING[:dim])
        u = random_displacement(grid, voxels, seed=seed)
        frames, central = published(u, grid)
        assert len(frames) == {2: 4, 3: 10}[dim]
        u = u.to(device)
        lowest = one_sided_determinant(u, grid)[0, 0].cpu()
        np.testing.assert_allclose(lowest.numpy(), frames.min(axis=0), atol=2e-4)
        found = diagnose(u, grid) if min(grid.shape) > 2 else None
        if found is not None:
            assert int(found.folds) == int((frames <= 0).any(axis=0).sum())
            assert int(found.central_folds) == int((central <= 0).sum())
            assert bool(found.diffeomorphic) == bool((frames > 0).all())
        assert bool(smallest_determinant(u, grid) > 0) == bool((frames > 0).all())


def test_the_package_agrees_on_a_smooth_map_that_folds_in_one_place():
    package = pytest.importorskip("digital_diffeomorphism.core")
    grid = Grid((33, 29))
    x = grid.points(dtype=torch.float64)
    hill = torch.exp(-((x - 15.0) ** 2).sum(dim=1, keepdim=True) / 18)
    u = 7.0 * hill * torch.tensor([1.0, -0.5]).view(1, 2, 1, 1)
    area, *_, pixels, _, _ = package.nda(np.moveaxis(u[0].numpy(), 0, -1).astype(np.float32), is_disp=True)
    found = diagnose(u, grid)
    assert (int(found.central_folds), area > 0) == (int(pixels), True)
    frames, _ = published(u, grid)
    assert 0 < int(found.folds) == int((frames <= 0).any(axis=0).sum()) < 100


@pytest.mark.parametrize("dim", [2, 3])
def test_a_checkerboard_fold_is_seen(dim):
    """One node pushed past its neighbour: the central determinant at the node itself does not even look at it."""
    grid = Grid((9,) * dim)
    u = torch.zeros(1, dim, *grid.shape)
    u[(0, 0, *[4] * dim)] = 1.5
    found = diagnose(u, grid)
    assert int(found.folds) > int(found.central_folds)
    assert not bool(found.diffeomorphic)
    assert float(found.smallest) == pytest.approx(-0.5)
    assert float(jacobian_determinant(u, grid)[(0, 0, *[4] * dim)]) == 1.0


def test_a_twisted_cell_keeps_its_corners_and_turns_over_inside():
    """One face turned by 100 degrees against the other: the corners keep J = 1, the inner tetrahedra get cos 100°."""
    grid, half = Grid((2, 2, 2)), math.radians(50)
    x = grid.points(dtype=torch.float64)
    angle = half * (2 * x[:, :1] - 1)
    a, b = x[:, 1:2] - 0.5, x[:, 2:] - 0.5
    turned = torch.cat([angle.cos() * a - angle.sin() * b, angle.sin() * a + angle.cos() * b], dim=1) + 0.5
    u = torch.cat([torch.zeros_like(a), turned - x[:, 1:]], dim=1)
    frames, _ = published(u, grid)
    assert frames[:8].min() > 0 > frames[8:].min()
    assert float(smallest_determinant(u, grid)) == pytest.approx(math.cos(2 * half))
    assert not bool(smallest_determinant(u, grid) > 0)


@UNTIMED
@given(
    dim=st.sampled_from([2, 3]),
    data=st.data(),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    scale=st.floats(1e-3, 1e3),
)
def test_spacing_and_type_do_not_matter(dim, data, dtype, scale):
    """Determinants have no unit: what counts is the displacement in voxels."""
    shape = data.draw(st.tuples(*[st.integers(3, 7)] * dim))
    spacing = data.draw(st.tuples(*[st.floats(0.1, 10)] * dim))
    one, other = Grid(shape), Grid(shape, tuple(scale * h for h in spacing))
    u = random_displacement(one, 0.25, seed=data.draw(st.integers(0, 99)))
    stretched = (u * other.along(other.spacing, u)).to(dtype)
    expected = diagnose(u, one)
    found = diagnose(stretched, other)
    for name in ("det_min", "det_max", "det_mean", "smallest"):
        assert float(getattr(found, name)) == pytest.approx(float(getattr(expected, name)), abs=1e-4), name
    assert found.det_min.dtype == dtype


@pytest.mark.parametrize("dim", [2, 3])
def test_affine_maps(dim):
    """All one-sided determinants of φ = A x inside Ω are det A."""
    grid = Grid((6, 7, 5)[:dim], SPACING[:dim])
    matrix = torch.eye(dim) + 0.4 * torch.randn(dim, dim, generator=torch.manual_seed(3))
    u = torch.einsum("ij,bj...->bi...", matrix - torch.eye(dim), grid.points())
    inner = one_sided_determinant(u, grid)[(slice(None), slice(None), *[slice(1, -1)] * dim)]
    torch.testing.assert_close(inner, torch.full_like(inner, float(matrix.det())), atol=1e-5, rtol=0)
    found = diagnose(u, grid)
    for value in (found.det_min, found.det_max, found.det_mean):
        assert float(value) == pytest.approx(float(matrix.det()), abs=1e-5)
    assert float(found.det_log_std) == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("dim", [2, 3])
def test_statistics_follow_their_definitions(dim):
    grid = Grid((8, 9, 7)[:dim], SPACING[:dim])
    u = random_displacement(grid, 0.5)
    det = jacobian_determinant(u, grid).flatten()
    found = diagnose(u, grid)
    assert (det <= 0).any()
    assert float(found.det_min) == float(det.min())
    assert float(found.det_max) == float(det.max())
    assert float(found.det_mean) == pytest.approx(float(det.mean()))
    assert float(found.det_log_std) == pytest.approx(float(det.clamp(min=1e-9).log().std()))
    assert float(found.smallest) == float(one_sided_determinant(u, grid).min())


@pytest.mark.parametrize("dim", [2, 3])
def test_the_identity_does_nothing(dim):
    grid = Grid((5,) * dim, SPACING[:dim])
    found = diagnose(torch.zeros(2, dim, *grid.shape), grid)
    for name, value in [("det_min", 1), ("det_max", 1), ("det_mean", 1), ("det_log_std", 0), ("smallest", 1)]:
        assert getattr(found, name).tolist() == [value] * 2
    assert found.folds.tolist() == found.central_folds.tolist() == [0, 0]
    assert found.diffeomorphic.tolist() == [True, True]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_batch_equals_its_items(dim):
    grid = Grid((7, 6, 8)[:dim], SPACING[:dim])
    u = torch.cat([random_displacement(grid, voxels, seed=k) for k, voxels in enumerate((0.05, 5.0, 0.3))])
    together, single = diagnose(u, grid), [diagnose(item[None], grid) for item in u]
    for name in ("det_min", "det_max", "smallest", "folds", "central_folds", "diffeomorphic"):
        assert torch.equal(getattr(together, name), torch.cat([getattr(one, name) for one in single])), name
    for name in ("det_mean", "det_log_std"):
        torch.testing.assert_close(getattr(together, name), torch.cat([getattr(one, name) for one in single]))
    assert torch.equal(smallest_determinant(u, grid), together.smallest)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("nodes", [1, 300, 10**9])
def test_slabs_change_nothing(dim, nodes, monkeypatch):
    """However the first axis is cut up, and whether the last slab is as thick as the others or not."""
    grid = Grid((19, 6, 8)[:dim], SPACING[:dim])
    u = random_displacement(grid, 0.4, items=2)
    whole = one_sided_determinant(u, grid)
    monkeypatch.setattr(grids, "_SLAB_NODES", {"cpu": nodes})
    assert torch.equal(one_sided_determinant(u, grid), whole)
    assert torch.equal(smallest_determinant(u, grid), whole.flatten(1).amin(1))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_counts_as_a_fold(bad):
    grid = Grid((6, 6, 6))
    u = torch.zeros(2, 3, 6, 6, 6)
    u[1, 2, 3, 3, 3] = bad
    found = diagnose(u, grid)
    assert found.diffeomorphic.tolist() == [True, False]
    assert (smallest_determinant(u, grid) > 0).tolist() == [True, False]
    assert found.folds[1] > 0
    assert found.central_folds[1] > 0


def test_memory_layout_does_not_matter():
    """A field that is a view of something else, and one that wants a gradient."""
    grid = Grid((5, 6, 7))
    u = random_displacement(grid, 0.3)
    view = u.permute(0, 2, 3, 4, 1).contiguous().permute(0, 4, 1, 2, 3).requires_grad_()
    assert torch.equal(one_sided_determinant(view, grid), one_sided_determinant(u, grid))
    assert not smallest_determinant(view, grid).requires_grad


@pytest.mark.parametrize("dim", [2, 3])
def test_inverse_error(dim):
    grid = Grid((12, 11, 10)[:dim], SPACING[:dim])
    shift = torch.zeros(2, dim, *grid.shape, dtype=torch.float64)
    shift[1, 0] = 3 * grid.spacing[0]
    mean, largest = inverse_error(shift, -shift, grid)
    assert float(mean.max()) <= float(largest.max()) < 1e-12
    mean, largest = inverse_error(shift, 0 * shift, grid)
    torch.testing.assert_close(mean, torch.tensor([0.0, 3.0], dtype=torch.float64))
    torch.testing.assert_close(largest, torch.tensor([0.0, 3.0], dtype=torch.float64))
    u = random_displacement(grid, 0.1)
    w, reached = invert(u, grid, return_error=True)
    mean, largest = inverse_error(u, w, grid)
    torch.testing.assert_close(largest, reached)
    assert float(mean) < float(largest)


def test_wrong_input_is_refused():
    grid = Grid((4, 5))
    u = torch.zeros(1, 2, 4, 5)
    for function, name in ((diagnose, "u must"), (smallest_determinant, "u must"), (one_sided_determinant, "u must")):
        with pytest.raises(InputError, match=name):
            function(u[:, :1], grid)
    with pytest.raises(InputError, match="u must have shape"):
        smallest_determinant(u[..., 1:], grid)
    with pytest.raises(InputError, match="inverse_error: w"):
        inverse_error(u, u[..., 1:], grid)
