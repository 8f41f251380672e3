"""The head's maps never fold, keep Ω, and have the determinant that was asked for."""

import copy

import pytest
import torch

from torchdeform.core.derivatives import CURL_PAIRS, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.nn import JacobianCurlHead
from torchdeform.nn.heads import flow_to_monitor, scale_to_bounds, with_mean_one

GRIDS = [Grid((24, 20), (1.0, 1.5)), Grid((12, 10, 14), (1.0, 2.0, 1.0))]


def wild_head(grid: Grid, strength: float, **options: float) -> JacobianCurlHead:
    torch.manual_seed(0)
    head = JacobianCurlHead(4, grid, **options)
    torch.nn.init.normal_(head.conv.weight, std=strength)
    return head


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("strength", [0.01, 0.3, 10.0])
@pytest.mark.parametrize("coarser", [1, 2])
def test_no_features_fold_it(grid, strength, coarser):
    head = wild_head(grid, strength, ratio=20.0, curl=5.0)
    u = head(torch.randn(3, 4, *(n // coarser for n in grid.shape)))
    found = diagnose(u, grid)
    assert found.folds.tolist() == [0, 0, 0]
    assert float(found.smallest.min()) >= head.least
    for axis, n in zip(grid.axes, grid.shape, strict=True):
        assert u.select(axis, 0)[:, axis - 2].abs().max() == 0
        assert u.select(axis, n - 1)[:, axis - 2].abs().max() == 0


@pytest.mark.parametrize("grid", GRIDS)
def test_fields_are_bounded(grid):
    head = wild_head(grid, 10.0, ratio=3.0, curl=0.7)
    f, curl = head.fields(torch.randn(2, 4, *grid.shape))
    weights = grid.quadrature() / grid.volume
    assert torch.allclose((f * weights).flatten(1).sum(1), torch.ones(2), atol=1e-5)
    low, high = f.detach().flatten(1).aminmax(dim=1)
    assert float((high / low).max()) <= 9 * (1 + 1e-5)
    assert float(curl.detach().abs().max()) <= 0.7
    assert curl.shape[1] == len(CURL_PAIRS[grid.dim])


@pytest.mark.parametrize(("shape", "dim"), [(33, 2), (65, 2), (17, 3)])
def test_determinant_is_the_monitor(shape, dim):
    """The error of J falls with the square of the spacing, as that of Version 1 does."""
    grid = Grid((shape,) * dim, (1 / (shape - 1),) * dim)
    x = grid.points(dtype=torch.float64)
    wave = torch.cos(torch.pi * x).prod(1, keepdim=True)
    f = with_mean_one(torch.exp(0.5 * wave), grid)
    curl = torch.zeros(1, len(CURL_PAIRS[dim]), *grid.shape, dtype=torch.float64)
    u = flow_to_monitor(f, curl + 0.3 * wave, grid, 8)
    error = (jacobian_determinant(u, grid) / f - 1).abs().mean()
    assert float(error) < 4 / shape**2


@pytest.mark.parametrize("grid", GRIDS)
def test_batch_equals_its_items(grid):
    head, features = wild_head(grid, 0.5).double(), torch.randn(3, 4, *grid.shape, dtype=torch.float64)
    together = head(features)
    assert torch.allclose(together, torch.cat([head(f[None]) for f in features]), atol=1e-12)
    assert torch.equal(together, head(features))


@pytest.mark.parametrize("grid", [Grid((5, 6)), Grid((3, 3, 3), (1.0, 1.2, 0.9))])
def test_gradcheck(grid):
    """In the monitor and the curl, where nothing is drawn back."""
    generator = torch.Generator().manual_seed(3)
    f = torch.exp(0.3 * torch.rand(1, 1, *grid.shape, dtype=torch.float64, generator=generator)).requires_grad_()
    curl = 0.2 * torch.rand(1, len(CURL_PAIRS[grid.dim]), *grid.shape, dtype=torch.float64, generator=generator)
    curl.requires_grad_()
    head = JacobianCurlHead(2, grid, steps=2).double()
    assert torch.autograd.gradcheck(
        lambda f, c: head.deform(with_mean_one(f, grid), c), (f, curl), atol=1e-4, fast_mode=True
    )


def test_every_parameter_gets_a_gradient():
    head = wild_head(GRIDS[0], 0.1)
    head(torch.randn(2, 4, *GRIDS[0].shape)).square().sum().backward()
    assert all(float(p.grad.abs().max()) > 0 for p in head.parameters())


def test_state_dict_and_deepcopy():
    head, features = wild_head(GRIDS[0], 0.3), torch.randn(1, 4, *GRIDS[0].shape)
    other = JacobianCurlHead(4, GRIDS[0])
    other.load_state_dict(head.state_dict())
    for twin in (other, copy.deepcopy(head)):
        assert torch.equal(twin(features), head(features))


def test_dtypes_and_autocast():
    head, features = wild_head(GRIDS[0], 0.3), torch.randn(2, 4, *GRIDS[0].shape)
    single = head(features)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough = head(features)
    assert rough.dtype == torch.float32
    assert int(diagnose(rough, GRIDS[0]).folds.sum()) == 0
    double = copy.deepcopy(head).to(torch.float64)(features.double())
    assert double.dtype == torch.float64
    assert torch.allclose(double.float(), single, atol=1e-3)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_on_a_gpu_and_back():
    head, features = wild_head(GRIDS[0], 0.3), torch.randn(2, 4, *GRIDS[0].shape)
    here = head(features)
    there = head.cuda()(features.cuda())
    assert torch.allclose(there.cpu(), here, atol=1e-3)
    assert torch.equal(head.cpu()(features), here)


def test_scale_to_bounds_finds_nearly_the_longest_share():
    """A displacement t·s·(x − m) has determinant (1 + t s)^D: with s = −2 the bound 0.25 in 2D is met at t = 1/4."""
    grid = Grid((9, 9))
    u = -2 * (grid.points(dtype=torch.float64) - 4)
    mild = 0.1 * u
    found = scale_to_bounds(torch.cat([u, mild]), grid, 0.25)
    assert torch.equal(found[1:], mild)
    share = float(found[0, 0, 0, 0] / u[0, 0, 0, 0])
    assert 0.25 - 1 / 64 <= share <= 0.25
    assert float(diagnose(found, grid).smallest[0]) >= 0.25


def test_what_is_not_finite_stays_visible():
    grid = GRIDS[0]
    u = torch.full((1, 2, *grid.shape), torch.nan)
    assert bool(scale_to_bounds(u, grid, 0.1).isnan().all())


def test_wrong_input_is_refused():
    for options in ({"ratio": 1.0}, {"curl": 0.0}, {"steps": 0}, {"least": 1.0}):
        with pytest.raises(InputError, match="JacobianCurlHead"):
            JacobianCurlHead(4, GRIDS[0], **options)
    with pytest.raises(InputError, match="features must have shape"):
        JacobianCurlHead(4, GRIDS[0])(torch.zeros(1, 3, *GRIDS[0].shape))
