"""Losses are the functions they are made of; overlap, determinants and inverses have known values."""

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.warp import invert
from torchdeform.errors import InputError
from torchdeform.metrics.similarity import MEASURES
from torchdeform.nn import CurlLoss, DeterminantLoss, DiceLoss, DivergenceLoss, InverseConsistencyLoss, SimilarityLoss

GRIDS = [Grid((9, 8), (1.0, 1.5)), Grid((7, 6, 8), (1.0, 2.0, 1.0))]


@pytest.mark.parametrize("name", MEASURES)
@pytest.mark.parametrize("grid", GRIDS)
def test_a_similarity_is_best_for_the_image_itself(name, grid):
    image, other = torch.rand(2, 2, 1, *grid.shape, generator=torch.Generator().manual_seed(0)).unbind(0)
    loss = SimilarityLoss(name)
    assert loss(image, image) < loss(image, other)
    assert loss(image, other) == -MEASURES[name].function(image, other).mean()
    warped = other.clone().requires_grad_()
    loss(image, warped).backward()
    assert bool(warped.grad.isfinite().all())


@pytest.mark.parametrize("name", ["ssd", "ncc", "lncc", "nmi", "ngf", "mind"])
def test_similarity_gradcheck(name):
    images = torch.rand(2, 1, 1, 5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    options = {} if name in ("ssd", "mind") else {"intensity_range": (-0.5, 1.5)}
    loss = SimilarityLoss(name, **options)
    fixed, warped = images[0].requires_grad_(name != "ngf"), images[1].requires_grad_()  # its η counts as constant
    assert torch.autograd.gradcheck(loss, (fixed, warped), atol=1e-4)


@pytest.mark.parametrize("name", MEASURES)
def test_autocast_changes_nothing(name):
    images = torch.rand(2, 1, 1, 12, 14, generator=torch.Generator().manual_seed(0)).bfloat16()
    plain = SimilarityLoss(name)(*images.float())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = SimilarityLoss(name)(*images)
    assert inside.dtype == torch.float32
    assert torch.equal(plain, inside)


def test_options_and_masks_are_passed_on():
    images = torch.rand(2, 1, 1, 16, 16, generator=torch.Generator().manual_seed(0))
    mask = torch.zeros(1, 1, 16, 16)
    mask[..., :8] = 1
    loss = SimilarityLoss("lncc", window=5)
    assert loss(*images) != SimilarityLoss("lncc", window=9)(*images)
    assert loss(*images, mask) == -MEASURES["lncc"].function(*images, mask=mask, window=5).mean()
    assert "window=5" in repr(loss)


def test_dice():
    a = torch.zeros(1, 2, 4, 4)
    a[:, 0, :2] = 1
    assert float(DiceLoss()(a, a)) == pytest.approx(0, abs=1e-5)
    assert float(DiceLoss()(a, a.flip(2))) == pytest.approx(0.5, abs=1e-5)  # the second channel is empty in both
    x, y = torch.rand(2, 1, 2, 3, 3, dtype=torch.float64).requires_grad_().unbind(0)
    assert torch.autograd.gradcheck(DiceLoss(), (x, y))


@pytest.mark.parametrize("grid", GRIDS)
def test_determinant_loss_is_the_same_for_growing_and_shrinking(grid):
    """φ(x) = a x has J = a^D everywhere: the price is J + 1/J − 2."""
    x = grid.points(dtype=torch.float64)
    loss = DeterminantLoss(grid)
    for a in (0.5, 2.0):
        j = a**grid.dim
        assert float(loss((a - 1) * x)) == pytest.approx(j + 1 / j - 2, rel=1e-6)
    assert float(loss(torch.zeros_like(x))) == 0
    assert float(loss(-2 * x if grid.dim == 3 else torch.stack([-2 * x[:, 0], 0 * x[:, 1]], 1))) > 100  # J = −1


@pytest.mark.parametrize("grid", GRIDS)
def test_divergence_and_curl_of_linear_fields(grid):
    x = grid.points(dtype=torch.float64)
    assert float(DivergenceLoss(grid)(0.3 * x)) == pytest.approx((0.3 * grid.dim) ** 2)
    assert float(CurlLoss(grid)(0.3 * x)) == pytest.approx(0, abs=1e-12)
    turn = torch.zeros_like(x)
    turn[:, 0], turn[:, 1] = -0.2 * x[:, 1], 0.2 * x[:, 0]
    assert float(CurlLoss(grid)(turn)) == pytest.approx(0.4**2)
    assert float(DivergenceLoss(grid)(turn)) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("grid", GRIDS)
def test_inverse_consistency(grid, make_displacement):
    u = make_displacement(grid, 0.05).double()
    loss = InverseConsistencyLoss(grid)
    assert float(loss(u, invert(u, grid))) < 1e-2 * float(loss(u, torch.zeros_like(u)))
    assert float(loss(torch.zeros_like(u), torch.zeros_like(u))) == 0


@pytest.mark.parametrize("loss", [DeterminantLoss, DivergenceLoss, CurlLoss])
def test_map_losses_gradcheck(loss, make_displacement):
    for grid in (Grid((4, 5)), Grid((3, 4, 3))):
        u = make_displacement(grid, 0.05).double().requires_grad_()
        assert torch.autograd.gradcheck(loss(grid), (u,))


def test_inverse_consistency_gradcheck():
    grid = Grid((5, 4))
    u, w = (0.3 * torch.rand(2, 1, 2, 5, 4, dtype=torch.float64) + 0.05).requires_grad_().unbind(0)
    inside = torch.zeros(1, 1, 5, 4, dtype=torch.float64)
    inside[..., 1:-1, 1:-1] = 1  # points that leave Ω have a kink
    assert torch.autograd.gradcheck(lambda a, b: InverseConsistencyLoss(grid)(a * inside, b * inside), (u, w))


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="did you mean 'lncc'"):
        SimilarityLoss("lcc")
    with pytest.raises(InputError, match="smoothing"):
        DiceLoss(0.0)
    with pytest.raises(InputError, match="must agree"):
        DiceLoss()(torch.zeros(1, 1, 3, 3), torch.zeros(1, 2, 3, 3))
    for loss in (DeterminantLoss, DivergenceLoss, CurlLoss):
        with pytest.raises(InputError, match="must have shape"):
            loss(GRIDS[0])(torch.zeros(1, 2, 3, 3))
    with pytest.raises(InputError, match="must have shape"):
        InverseConsistencyLoss(GRIDS[0])(torch.zeros(1, 2, 3, 3), torch.zeros(1, 2, 3, 3))
