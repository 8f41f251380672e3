"""The noise of images: known noise is found, structure is not noise."""

import pytest
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.metrics.correlation import contrast, window_moments
from torchdeform.metrics.noise import noise_share


def waves(shape: tuple[int, ...], items: int = 1) -> Tensor:
    """Long waves between 0 and 1, ``(items, 1, *shape)``."""
    points = Grid(shape).points(dtype=torch.float32)
    return (0.5 + 0.5 * torch.sin(0.1 * points.sum(1, keepdim=True))).repeat(items, *[1] * (len(shape) + 1))


@pytest.mark.parametrize("shape", [(120, 130), (40, 44, 42)])
def test_the_share_of_white_noise_is_that_of_its_variance(shape):
    sigma = 0.02
    smooth = waves(shape, 2)
    noisy = smooth + sigma * torch.randn(2, 1, *shape, generator=torch.manual_seed(0))
    variance = window_moments(noisy, 9)[1]
    wanted = (sigma**2 / variance * contrast(variance)).mean() / contrast(variance).mean()
    torch.testing.assert_close(noise_share(noisy), wanted.expand(2), rtol=0.1, atol=0)
    assert (noise_share(smooth) < 0.02).all()


def test_white_noise_is_all_noise():
    image = 0.5 + 0.1 * torch.randn(1, 1, 90, 90, generator=torch.manual_seed(1))
    assert noise_share(image).item() == pytest.approx(1.0, abs=0.05)


def test_what_is_masked_out_and_other_items_have_no_influence():
    smooth = waves((80, 90))
    noise = 0.1 * torch.randn(1, 1, 80, 90, generator=torch.manual_seed(2))
    mask = torch.zeros_like(smooth)
    mask[..., :40] = 1
    alone = noise_share(smooth, mask)
    noise[..., :41] = 0  # the first difference looks at both its nodes
    torch.testing.assert_close(noise_share(smooth + noise, mask), alone)
    both = noise_share(torch.cat([smooth, smooth + noise]))
    torch.testing.assert_close(both[:1], noise_share(smooth))
    assert both[1] > 2 * both[0]


def test_flat_images_have_none():
    assert noise_share(torch.full((1, 2, 20, 20), 0.3)).tolist() == [0.0]
