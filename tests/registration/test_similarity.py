"""Similarities against a brute-force window loop, and their derivatives against autograd's view of the same formula."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.registration.similarity import (
    LNCC_FLOOR,
    LocalCrossCorrelation,
    MeanSquaredDifference,
    box_sum,
    make_similarity,
    scale_intensities,
)

SHAPES = [(9, 12), (8, 9, 10)]


def brute_force_lncc(fixed: Tensor, warped: Tensor, window: int) -> Tensor:
    """The definition, window by window; differentiable by autograd."""
    reach, shape = window // 2, fixed.shape[2:]
    values = []
    for node in itertools.product(*map(range, shape)):
        cut = (slice(None), slice(None), *(slice(max(0, i - reach), i + reach + 1) for i in node))
        f, w = fixed[cut].flatten(2), warped[cut].flatten(2)
        f, w = f - f.mean(2, keepdim=True), w - w.mean(2, keepdim=True)
        variances = (f.square().mean(2) + LNCC_FLOOR) * (w.square().mean(2) + LNCC_FLOOR)
        values.append((f * w).mean(2).square() / variances)
    return torch.stack(values).mean(dim=(0, 2))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("window", [3, 5])
def test_lncc_and_its_derivative_are_those_of_the_definition(shape, window):
    torch.manual_seed(0)
    fixed, warped = torch.rand(2, 2, 2, *shape, dtype=torch.float64)
    warped.requires_grad_(True)
    expected = brute_force_lncc(fixed, warped, window)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    value, derivative = LocalCrossCorrelation(fixed, window).evaluate(warped.detach())
    torch.testing.assert_close(value, expected.detach(), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(derivative, slope * warped[0].numel(), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("shape", SHAPES)
def test_mean_squared_difference_and_its_derivative(shape):
    torch.manual_seed(1)
    fixed, warped = torch.rand(2, 3, 1, *shape, dtype=torch.float64)
    warped.requires_grad_(True)
    expected = -(fixed - warped).square().flatten(1).mean(1)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    value, derivative = MeanSquaredDifference(fixed).evaluate(warped.detach())
    torch.testing.assert_close(value, expected.detach())
    torch.testing.assert_close(derivative, slope * warped[0].numel())


def test_lncc_is_one_for_a_linear_change_of_brightness_and_blind_to_its_sign():
    torch.manual_seed(2)
    fixed = torch.rand(1, 1, 40, 40, dtype=torch.float64)
    for scale, shift in ((2.0, 0.3), (-1.0, 1.0)):
        value, derivative = LocalCrossCorrelation(fixed, 7).evaluate(scale * fixed + shift)
        assert value.item() == pytest.approx(1.0, abs=1e-3)
        assert derivative.abs().max() < 1e-1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ["lncc", "ssd"])
def test_flat_images_give_finite_numbers(name, dtype):
    flat = torch.full((1, 1, 16, 16), 0.7, dtype=dtype)
    half = flat.clone()
    half[..., :8] = 0.0
    for fixed, warped in itertools.product((flat, half), repeat=2):
        value, derivative = make_similarity(name, fixed, 5).evaluate(warped)
        assert value.isfinite().all()
        assert derivative.isfinite().all()
        if name == "lncc":
            assert 0 <= value.item() <= 1


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(3, 14), min_size=2, max_size=3), st.sampled_from([3, 5, 7, 9]), st.integers(0, 99))
def test_box_sum_counts_the_window_and_is_self_adjoint(shape, window, seed):
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.rand(2, 1, 2, *shape, generator=generator, dtype=torch.float64)
    node = tuple(int(torch.randint(n, (), generator=generator)) for n in shape)
    cut = (..., *(slice(max(0, i - window // 2), i + window // 2 + 1) for i in node))
    torch.testing.assert_close(box_sum(x, window)[(..., *node)], x[cut].flatten(2).sum(2))
    torch.testing.assert_close((box_sum(x, window) * y).sum(), (x * box_sum(y, window)).sum())


def test_box_sum_is_the_same_on_long_axes():
    x = torch.rand(1, 1, 600, 20, dtype=torch.float64)
    torch.testing.assert_close(box_sum(x, 9)[:, :, 100:200], box_sum(x[:, :, 90:210].contiguous(), 9)[:, :, 10:110])


def test_scales_are_robust_and_item_by_item():
    torch.manual_seed(3)
    fixed = torch.rand(2, 1, 64, 64) * torch.tensor([1.0, 1000.0]).view(2, 1, 1, 1)
    fixed[0, 0, 0, 0] = 1e6
    moving = 3 * fixed + 7
    scaled = scale_intensities(fixed, moving, jointly=False)
    torch.testing.assert_close(scaled[0], scaled[1], rtol=1e-4, atol=1e-4)
    assert scaled[0].flatten(1).median(1).values.sub(0.5).abs().max() < 0.05
    joint = scale_intensities(fixed, moving, jointly=True)
    slope = (joint[1] - joint[1].mean()) / (joint[0] - joint[0].mean())
    assert slope[1].median() == pytest.approx(3, rel=0.05)
    one = scale_intensities(fixed[1:], moving[1:], jointly=True)
    assert torch.equal(one[0][0], joint[0][1])


def test_an_image_without_contrast_is_refused_but_one_bright_pixel_is_not():
    flat = torch.zeros(1, 1, 16, 16)
    with pytest.raises(InputError, match="moving is constant"):
        scale_intensities(torch.rand(1, 1, 16, 16), flat, jointly=False)
    spot = flat.clone()
    spot[..., 8, 8] = 5.0
    assert scale_intensities(spot, spot, jointly=False)[0].max() == 1
