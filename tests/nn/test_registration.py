"""Refinement raises the similarity, never folds, and can be learned through."""

import pytest
import torch
from nested_settings import settings_of
from pictures import bend, blobs, disc

from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp
from torchdeform.errors import InputError
from torchdeform.nn import DeformableRegistration, SimilarityLoss

GRIDS = [Grid((32, 28), (1.0, 1.5)), Grid((14, 16, 12), (1.0, 2.0, 1.0))]


def pair(grid: Grid, make_displacement, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    x = grid.points(dtype=dtype) / grid.along(grid.extent, torch.ones((), dtype=dtype))
    moving = torch.cos(9 * x[:, :1]) * torch.cos(7 * x[:, 1:2] + 1) / 2 + 0.5
    return warp(moving, make_displacement(grid, 0.06).to(dtype), grid), moving


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("similarity", ["lncc", "ssd", "nmi"])
def test_similarity_rises_without_folds(grid, similarity, make_displacement):
    fixed, moving = pair(grid, make_displacement)
    refine = DeformableRegistration(grid, steps=15, settings=settings_of(similarity=similarity))
    u = refine(fixed, moving)
    loss = SimilarityLoss(similarity)
    assert loss(fixed, warp(moving, u, grid)) < loss(fixed, moving)
    assert int(diagnose(u, grid).folds) == 0
    assert torch.equal(u, refine(fixed, moving))


def test_a_start_is_refined(make_displacement):
    grid = GRIDS[0]
    fixed, moving = pair(grid, make_displacement)
    start = 0.5 * make_displacement(grid, 0.06)
    loss, refine = SimilarityLoss("lncc"), DeformableRegistration(grid, steps=5)
    first, after = (loss(fixed, warp(moving, u, grid)) for u in (start, refine(fixed, moving, start)))
    assert after < first


def test_batch_equals_its_items(make_displacement):
    grid = GRIDS[0]
    fixed, moving = (torch.cat([a, b]) for a, b in [pair(grid, make_displacement)[::s] for s in (1, -1)])
    refine = DeformableRegistration(grid, steps=4)
    alone = torch.cat([refine(f[None], m[None]) for f, m in zip(fixed, moving, strict=True)])
    assert torch.allclose(refine(fixed, moving), alone, atol=1e-4)


def test_gradients_go_through_the_steps(make_displacement):
    """The start's gradient is that of finite differences along a direction."""
    grid = Grid((12, 14))
    fixed, moving = pair(grid, make_displacement, torch.float64)
    settings = settings_of(similarity="ssd", step_length=0.1)
    refine = DeformableRegistration(grid, steps=3, settings=settings)
    start = (0.4 * make_displacement(grid, 0.06).double()).requires_grad_()
    fixed, moving = fixed.requires_grad_(), moving.requires_grad_()
    value = refine(fixed, moving, start).square().sum()
    gradients = torch.autograd.grad(value, (start, fixed, moving))
    assert all(bool(g.isfinite().all()) and g.abs().max().item() > 0 for g in gradients)
    way = make_displacement(grid, 0.02).double().roll(2, 3) + 0.01
    values = [refine(fixed, moving, start + h * way).square().sum() for h in (-1e-5, 1e-5)]
    slope = (values[1] - values[0]).item() / 2e-5
    assert (gradients[0] * way).sum().item() == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("settings", [{}, {"limit": None}, {"evenness": None}])
@pytest.mark.parametrize("shape", [(20, 24), (12, 14, 10)])
def test_what_does_not_move_has_a_gradient_too(shape, settings):
    """No force in a constant background, no velocity in the corners of the box: a length of 0 has no slope."""
    grid = Grid(shape)
    ball = disc(shape, tuple(n / 2 for n in shape), min(shape) / 3).double()
    moving = (blobs(shape, 1).double() - 2) * ball
    fixed, way = warp(moving, bend(grid, 1.0).double(), grid), blobs(shape, 2).double() * ball
    refine = DeformableRegistration(grid, steps=3, settings=settings_of(similarity="ssd", step_length=0.4, **settings))

    def value(h: float | torch.Tensor) -> torch.Tensor:
        return refine(fixed, moving + h * way).square().sum()

    h = torch.zeros((), dtype=torch.float64, requires_grad=True)
    slope = torch.autograd.grad(value(h), h)[0].item()
    assert slope == pytest.approx((value(1e-6) - value(-1e-6)).item() / 2e-6, rel=1e-3)


def test_images_that_are_equal_have_gradients():
    image = blobs((16, 18)).requires_grad_()
    u = DeformableRegistration(Grid((16, 18)), steps=2, settings=settings_of(similarity="ssd"))(image.detach(), image)
    assert torch.autograd.grad(u.sum(), image)[0].isfinite().all()


def test_without_gradients_nothing_is_kept(make_displacement):
    fixed, moving = pair(GRIDS[0], make_displacement)
    with torch.no_grad():
        assert not DeformableRegistration(GRIDS[0], steps=2)(fixed, moving).requires_grad


def test_wrong_input_is_refused():
    with pytest.raises(InputError, match="steps"):
        DeformableRegistration(GRIDS[0], steps=0)
    for similarity in ("mind", {"lncc": 1.0, "mi": 1.0}):
        with pytest.raises(InputError, match="similarity"):
            DeformableRegistration(GRIDS[0], settings=settings_of(similarity=similarity))
    with pytest.raises(InputError, match="fixed must have shape"):
        DeformableRegistration(GRIDS[0])(torch.zeros(1, 1, 4, 4), torch.zeros(1, 1, 4, 4))


def test_features_and_labels_are_for_whole_registrations():
    for settings in ({"features": "mind"}, {"labels_weight": 1.0}):
        with pytest.raises(InputError, match="features and labels_weight are for register"):
            DeformableRegistration(Grid((16, 16)), settings=settings_of(**settings))
