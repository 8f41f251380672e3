"""Operators for torch.compile and torch.export: registered as torch wants them, and safe in several threads."""

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torchdeform.nn.operators import div_curl_adjoint, div_curl_velocity, share_within_bounds

SPACING, WEIGHTS = [0.8, 1.0, 1.3], [1.0, 2.0, 0.1]


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("shape", [(5, 4), (4, 3, 5)])
def test_torch_finds_nothing_wrong_with_them(shape):
    dim, spacing = len(shape), SPACING[: len(shape)]
    data, v = random(2, 1 + dim * (dim - 1) // 2, *shape).requires_grad_(), random(2, dim, *shape).requires_grad_()
    torch.library.opcheck(torch.ops.torchdeform.div_curl_velocity, (data, spacing, WEIGHTS, "slip"))
    torch.library.opcheck(torch.ops.torchdeform.div_curl_adjoint, (v, spacing, WEIGHTS, "slip"))
    torch.library.opcheck(torch.ops.torchdeform.share_within_bounds, (v.detach(), spacing, 0.1, 4.0, 2.0))


@pytest.mark.parametrize("shape", [(5, 4), (4, 3, 5)])
def test_the_adjoint_is_the_transpose(shape):
    dim, spacing = len(shape), SPACING[: len(shape)]
    data, v = random(2, 1 + dim * (dim - 1) // 2, *shape), random(2, dim, *shape)
    there = (div_curl_velocity(data, spacing, WEIGHTS, "slip") * v).sum()
    torch.testing.assert_close((data * div_curl_adjoint(v, spacing, WEIGHTS, "slip")).sum(), there)


def test_threads_do_not_disturb_each_other():
    data = [random(1, 2, 9, 8) * k for k in range(16)]

    def solve(one: torch.Tensor) -> torch.Tensor:
        return div_curl_velocity(one, SPACING[:2], WEIGHTS, "slip")

    alone = [solve(one) for one in data]
    with ThreadPoolExecutor(4) as pool:
        for a, b in zip(alone, pool.map(solve, data), strict=True):
            torch.testing.assert_close(a, b)
