"""Box sums against the slice they stand for."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.registration.metrics.boxes import box_sum


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
