"""Box sums against the slice they stand for."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.core.resampling import box_spread, box_sum, centres


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


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.sampled_from([3, 4, 7, 10, 13, 530]), min_size=2, max_size=3).filter(
        lambda shape: shape.count(530) < 2
    ),
    st.sampled_from([3, 5, 9]),
    st.integers(1, 4),
    st.integers(0, 99),
)
def test_with_a_stride_windows_are_left_out_and_the_transpose_is_one(shape, window, stride, seed):
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(1, 2, *shape, generator=generator, dtype=torch.float64)
    few = box_sum(x, window, stride)
    torch.testing.assert_close(few, centres(box_sum(x, window), stride))
    y = torch.rand(few.shape, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((few * y).sum(), (x * box_spread(y, window, stride, tuple(shape))).sum())
