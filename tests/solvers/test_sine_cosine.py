"""The transforms against scipy's and against their definition, and what follows from symmetry."""

import pytest
import scipy.fft
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.errors import InputError
from torchdeform.solvers import sine_cosine as transforms
from torchdeform.solvers.sine_cosine import KINDS, inverse_transform, separable_transform, transform

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=["product", "fft"])
def way(request, monkeypatch) -> str:
    """Force one of the two ways to compute a sum."""
    monkeypatch.setattr(transforms, "DENSE_LIMIT", {"product": 10**6, "fft": 0}[request.param])
    return request.param


@pytest.mark.parametrize("dim", [0, 1, 2, -1])
@pytest.mark.parametrize("size", [2, 3, 8, 33])
def test_cosine_sums_are_half_of_scipys_dct_1_with_the_ends_doubled(way, dim, size):
    x = torch.randn([size if k == dim % 3 else 4 for k in range(3)], dtype=torch.float64)
    doubled = x.clone()
    for end in (0, -1):
        doubled.select(dim, end).mul_(2)
    want = torch.from_numpy(scipy.fft.dct(doubled.numpy(), type=1, axis=dim)) / 2
    torch.testing.assert_close(transform(x, dim, "cosine"), want, atol=1e-12, rtol=0)


@pytest.mark.parametrize("dim", [0, 1, 2, -1])
@pytest.mark.parametrize("size", [3, 8, 33])
def test_sine_sums_are_half_of_scipys_dst_1_of_the_inner_nodes(way, dim, size):
    x = torch.randn([size if k == dim % 3 else 4 for k in range(3)], dtype=torch.float64)
    inner = x.narrow(dim, 1, size - 2)
    want = torch.from_numpy(scipy.fft.dst(inner.numpy(), type=1, axis=dim)) / 2
    got = transform(x, dim, "sine")
    torch.testing.assert_close(got.narrow(dim, 1, size - 2), want, atol=1e-12, rtol=0)
    assert bool((got.select(dim, 0) == 0).all())
    assert bool((got.select(dim, -1) == 0).all())


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 40), st.sampled_from(KINDS), st.integers(0, 1), st.booleans())
def test_the_inverse_undoes_a_transform(size, kind, dim, single):
    x = torch.randn([size if k == dim else 3 for k in range(2)], dtype=torch.float32 if single else torch.float64)
    if kind == "sine":
        for end in (0, -1):
            x.select(dim, end).zero_()
    back = inverse_transform(transform(x, dim, kind), dim, kind)
    torch.testing.assert_close(back, x, atol=1e-5 if single else 1e-12, rtol=0)


def test_both_ways_agree_beyond_the_limit():
    for size in (transforms.DENSE_LIMIT, transforms.DENSE_LIMIT + 1):
        x = torch.randn(2, size, dtype=torch.float64)
        for kind in KINDS:
            matrix = transforms.dense_matrix(size, kind, x.dtype, x.device)
            torch.testing.assert_close(transform(x, 1, kind), x @ matrix, atol=1e-10, rtol=0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(5, 8), (4, 5, 6)])
def test_the_separable_transform_is_one_transform_per_axis(way, shape, dtype, device):
    kinds = (("sine", "cosine", "sine")[: len(shape)], ("cosine", "sine", "sine")[: len(shape)])
    x = torch.randn(3, 2, *shape, dtype=dtype, device=device)
    want = x.clone()
    for channel, along in enumerate(kinds):
        for axis, kind in enumerate(along):
            want[:, channel] = transform(want[:, channel].clone(), axis + 1, kind)
    tolerance = {torch.float32: 1e-4, torch.float64: 1e-12}[dtype]
    got = separable_transform(x, kinds)
    torch.testing.assert_close(got, want, atol=tolerance, rtol=0)
    out = torch.empty_like(got)
    assert separable_transform(x, kinds, out=out) is out
    assert torch.equal(out, got)


def test_a_batch_gives_its_items():
    kinds = (("sine", "cosine"), ("cosine", "sine"))
    x = torch.randn(5, 2, 37, 23)
    together = separable_transform(x, kinds)
    for one, item in zip(together, x, strict=True):
        alone = separable_transform(item[None], kinds)[0]
        size = float(item.abs().sum() / alone.abs().max())  # no entry of the matrices is larger than 1
        assert_same_to_rounding(one, alone, terms=37 + 23, condition=size)


def test_strided_input_is_taken_as_it_looks():
    kinds = (("sine", "cosine", "cosine"),) * 2
    x = torch.randn(2, 2, 4, 5, 6, dtype=torch.float64).to(memory_format=torch.channels_last_3d)
    torch.testing.assert_close(separable_transform(x, kinds), separable_transform(x.contiguous(), kinds))
    torch.testing.assert_close(transform(x.mT, 2, "sine"), transform(x.mT.contiguous(), 2, "sine"))


def test_derivatives(way):
    kinds = (("sine", "cosine"), ("cosine", "sine"))
    x = torch.randn(1, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    for function in (lambda t: separable_transform(t, kinds), lambda t: transform(t, 2, "cosine")):
        assert gradcheck(function, x)
        assert gradgradcheck(lambda t, f=function: f(t) ** 2, x)


def test_matrices_made_in_inference_mode_serve_autograd_later():
    with torch.inference_mode():
        transform(torch.randn(2, 19), 1, "cosine")
    x = torch.randn(2, 19, requires_grad=True)
    transform(x, 1, "cosine").sum().backward()
    assert x.grad is not None


def test_an_unknown_kind_is_refused():
    with pytest.raises(InputError, match="did you mean 'cosine'"):
        transform(torch.randn(4, 4), 0, "cosin")
