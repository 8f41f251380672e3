"""The noise of images: known noise is found, structure is not noise."""

import pytest
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.metrics.noise import noise_of


def waves(shape: tuple[int, ...], items: int = 1) -> Tensor:
    """Long waves between 0 and 1, ``(items, 1, *shape)``."""
    points = Grid(shape).points(dtype=torch.float32)
    return (0.5 + 0.5 * torch.sin(0.1 * points.sum(1, keepdim=True))).repeat(items, *[1] * (len(shape) + 1))


@pytest.mark.parametrize("shape", [(120, 130), (40, 44, 42)])
@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_white_noise_is_found_on_smooth_images(shape, sigma):
    smooth = waves(shape, 2)
    noisy = smooth + sigma * torch.randn(2, 1, *shape, generator=torch.manual_seed(0))
    found = noise_of(noisy)
    torch.testing.assert_close(found.variance, torch.full((2, 1), sigma**2), rtol=0.1, atol=2e-5)
    assert (noise_of(smooth).share < 0.02).all()


def test_white_noise_is_all_noise():
    image = 0.5 + 0.1 * torch.randn(1, 1, 90, 90, generator=torch.manual_seed(1))
    assert noise_of(image).share.item() == pytest.approx(1.0, abs=0.05)


def test_what_is_masked_out_and_other_items_have_no_influence():
    smooth = waves((80, 90))
    noise = 0.1 * torch.randn(1, 1, 80, 90, generator=torch.manual_seed(2))
    mask = torch.zeros_like(smooth)
    mask[..., :40] = 1
    alone = noise_of(smooth, mask)
    noise[..., :41] = 0  # the first difference looks at both its nodes
    torch.testing.assert_close(noise_of(smooth + noise, mask).share, alone.share)
    both = noise_of(torch.cat([smooth, smooth + noise]))
    torch.testing.assert_close(both.variance[:1], noise_of(smooth).variance)
    assert both.share[1] > 2 * both.share[0]


def test_flat_images_have_no_share_that_is_not_finite():
    found = noise_of(torch.full((1, 2, 20, 20), 0.3))
    assert found.variance.shape == (1, 2)
    assert found.variance.abs().max() == found.share.abs().max() == 0
