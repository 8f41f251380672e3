"""Finite differences: exact on polynomials, of the order they claim, and true to vector calculus."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core import grid as module
from torchdeform.core.derivatives import (
    KERNELS,
    add_adjoint_derivative,
    by_slabs,
    cofactors,
    curl,
    derivative,
    determinant,
    divergence,
    jacobian,
    jacobian_determinant,
    kernel_weights,
    map_jacobian,
)
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError

ORDERS = sorted(KERNELS)
UNTIMED = settings(deadline=None, max_examples=40)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@st.composite
def grids(draw, *, least: int = 5, dims: tuple[int, ...] = (2, 3)) -> Grid:
    dim = draw(st.sampled_from(dims))
    return Grid(draw(st.tuples(*[st.integers(least, 8)] * dim)), draw(st.tuples(*[st.floats(0.1, 10)] * dim)))


def random_field(grid: Grid, channels: int, *, items: int = 1, seed: int = 0) -> Tensor:
    return torch.randn(items, channels, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(seed))


@UNTIMED
@given(grid=grids(), order=st.sampled_from(ORDERS), axis=st.integers(0, 2), seed=st.integers(0, 99))
def test_exact_on_polynomials_of_its_order(grid, order, axis, seed):
    """Also at the boundary, on any shape and spacing; the other axes enter as factors of any kind."""
    axis = axis % grid.dim
    t = grid.points(dtype=torch.float64)[:, axis : axis + 1] / grid.extent[axis]
    factor = random_field(grid, 1, seed=seed).narrow(axis + 2, 0, 1)
    weights = torch.randn(order + 1, dtype=torch.float64, generator=torch.manual_seed(seed)).tolist()
    field = factor * sum((w * t**p for p, w in enumerate(weights)), start=torch.zeros_like(t))
    slopes = sum((w * p * t ** max(p - 1, 0) for p, w in enumerate(weights)), start=torch.zeros_like(t))
    expected = factor * slopes / grid.extent[axis]
    scale = float(expected.abs().max()) + 1 / grid.extent[axis]
    assert float((derivative(field, grid, axis, order=order) - expected).abs().max()) < 1e-11 * scale


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("where", ["everywhere", "boundary"])
def test_convergence_order(order, dim, where):
    def error(nodes: int) -> float:
        grid = Grid((7, nodes, 5)[:dim], (0.2, 1 / (nodes - 1), 0.3)[:dim])
        x = grid.points(dtype=torch.float64)
        field = torch.sin(3 * x[:, :1] + 1) * torch.cos(2 * x[:, 1:2])
        exact = -2 * torch.sin(3 * x[:, :1] + 1) * torch.sin(2 * x[:, 1:2])
        wrong = (derivative(field, grid, 1, order=order) - exact).abs()
        return float((wrong if where == "everywhere" else wrong[:, :, :, [0, -1]]).max())

    assert math.log(error(65) / error(257)) / math.log(256 / 64) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("dim", [2, 3])
def test_second_order_is_numpys_gradient(dim):
    grid = Grid((5, 6, 7)[:dim], (0.5, 2.0, 1.2)[:dim])
    field = random_field(grid, 1)
    expected = np.gradient(field[0, 0].numpy(), *grid.spacing, edge_order=2)
    torch.testing.assert_close(jacobian(field, grid)[0, 0], torch.from_numpy(np.stack(expected)))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("dim", [2, 3])
def test_interior_is_a_convolution_with_the_kernel(dim, order):
    grid = Grid((9, 8, 7)[:dim], (0.5, 2.0, 1.2)[:dim])
    field, convolve = random_field(grid, 1), {2: torch.conv2d, 3: torch.conv3d}[dim]
    for axis in range(dim):
        kernel = torch.tensor(KERNELS[order][0], dtype=torch.float64) / grid.spacing[axis]
        expected = convolve(field, kernel.view(1, 1, *[-1 if k == axis else 1 for k in range(dim)]))
        edge = len(KERNELS[order][1])
        inner = derivative(field, grid, axis, order=order).narrow(axis + 2, edge, grid.shape[axis] - 2 * edge)
        torch.testing.assert_close(inner, expected)


@UNTIMED
@given(grid=grids(), order=st.sampled_from(ORDERS), seed=st.integers(0, 99))
def test_curl_of_a_gradient_and_divergence_of_a_curl_vanish(grid, order, seed):
    """To rounding, for any field: derivatives along different axes commute, at the boundary too."""
    potential = random_field(grid, 1, seed=seed)
    gradient = jacobian(potential, grid, order=order)[:, 0]
    assert float(curl(gradient, grid, order).abs().max()) < 1e-12 * float(gradient.abs().max()) / min(grid.spacing) * 10
    if grid.dim == 3:
        stream = random_field(grid, 3, seed=seed)
        rotation = curl(stream, grid, order)
        left = divergence(rotation, grid, order).abs().max()
        assert float(left) < 1e-12 * float(rotation.abs().max()) / min(grid.spacing) * 10


@UNTIMED
@given(grid=grids(), order=st.sampled_from(ORDERS), data=st.data())
def test_affine_maps(grid, order, data):
    """φ = A x has J = det A, div u = tr A − D, curl u twice the antisymmetric part, at every node."""
    dim = grid.dim
    entries = data.draw(st.lists(st.floats(-2, 2), min_size=dim * dim, max_size=dim * dim))
    matrix = torch.tensor(entries, dtype=torch.float64).view(dim, dim)
    x = grid.points(dtype=torch.float64)
    u = torch.einsum("ij,bj...->bi...", matrix, x) - x
    flat = [1] * dim
    close = {"atol": 1e-10, "rtol": 0}
    shape = (1, 1, *grid.shape)
    torch.testing.assert_close(
        jacobian_determinant(u, grid, order), torch.linalg.det(matrix).view(1, 1, *flat).expand(shape), **close
    )
    torch.testing.assert_close(
        divergence(u, grid, order), (matrix.trace() - dim).view(1, 1, *flat).expand(shape), **close
    )
    pairs = {2: [(0, 1)], 3: [(1, 2), (2, 0), (0, 1)]}[dim]
    expected = torch.stack([matrix[b, a] - matrix[a, b] for a, b in pairs]).view(1, -1, *flat)
    torch.testing.assert_close(curl(u, grid, order), expected.expand(1, -1, *grid.shape), **close)
    torch.testing.assert_close(
        map_jacobian(u, grid, order=order), matrix.view(1, dim, dim, *flat).expand(1, dim, dim, *grid.shape), **close
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_determinant_and_cofactors_against_linalg(dim):
    matrix = torch.randn(2, dim, dim, 4, 5, dtype=torch.float64, generator=torch.manual_seed(0))
    dense = matrix.permute(0, 3, 4, 1, 2)
    torch.testing.assert_close(determinant(matrix)[:, 0], torch.linalg.det(dense))
    inverse = cofactors(matrix).transpose(1, 2) / determinant(matrix).unsqueeze(1)
    torch.testing.assert_close(inverse.permute(0, 3, 4, 1, 2), torch.linalg.inv(dense))


def test_cofactors_are_the_derivative_of_the_determinant():
    matrix = torch.randn(1, 3, 3, 2, 2, dtype=torch.float64, generator=torch.manual_seed(1)).requires_grad_()
    (gradient,) = torch.autograd.grad(determinant(matrix).sum(), matrix)
    torch.testing.assert_close(gradient, cofactors(matrix).detach())


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("function", [divergence, curl, jacobian_determinant])
def test_gradients(function, dim):
    grid = Grid((5, 3, 3)[:dim], (0.5, 2.0, 1.2)[:dim])
    u = random_field(grid, dim).requires_grad_()
    assert gradcheck(lambda field: function(field, grid), (u,))
    assert gradgradcheck(lambda field: function(field, grid), (u,))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("function", [divergence, curl, jacobian_determinant])
def test_a_batch_equals_its_items(function, dtype, device):
    grid = Grid((6, 7, 5), (0.5, 2.0, 1.2))
    u = random_field(grid, 3, items=3).to(dtype=dtype, device=device)
    u[1] *= 1e3
    together = function(u, grid, 4)
    assert (together.dtype, together.device.type) == (dtype, device)
    for item, one in zip(u, together, strict=True):
        assert torch.equal(function(item[None], grid, 4)[0], one)


@pytest.mark.parametrize("shape", [(3, 6), (4, 5), (9, 4), (3, 4, 5), (13, 4, 5)])
def test_slabs_do_not_show(shape, monkeypatch):
    monkeypatch.setattr(module, "_SLAB_NODES", {"cpu": 1})
    grid = Grid(shape, (0.5, 2.0, 1.2)[: len(shape)])
    u = random_field(grid, len(shape), items=2)
    for function in (jacobian_determinant, divergence, lambda u, g: map_jacobian(u, g).flatten(1, 2)):
        assert torch.equal(by_slabs(function, u, grid), function(u, grid))


def test_two_nodes_have_one_difference():
    grid = Grid((2, 5), (0.5, 1.0))
    x, y = torch.rand(2, 1, 1, 2, 5, dtype=torch.float64)
    slope = derivative(x, grid, 0)
    torch.testing.assert_close(slope, ((x[:, :, 1:] - x[:, :, :1]) / 0.5).expand_as(x))
    transposed = torch.zeros_like(y)
    add_adjoint_derivative(transposed, y, grid, 0)
    torch.testing.assert_close((y * slope).sum(), (transposed * x).sum())


def test_wrong_input_is_refused():
    grid = Grid((3, 6))
    u = torch.zeros(1, 2, 3, 6)
    with pytest.raises(InputError, match="order 4 needs 5 nodes along axis 0"):
        divergence(u, grid, 4)
    with pytest.raises(InputError, match="order must be one of 2, 4, got 3"):
        curl(u, grid, 3)
    with pytest.raises(InputError, match="axis must be one of 0, 1, got 2"):
        derivative(u, grid, 2)
    for function in (divergence, curl, jacobian_determinant):
        with pytest.raises(InputError, match=r"must have shape \(B, 2, 3, 6\)"):
            function(u[:, :1], grid)
    with pytest.raises(InputError, match="derivative: field must have shape"):
        jacobian(u[..., :-1], grid)


@UNTIMED
@given(grids(), st.sampled_from(ORDERS), st.sampled_from([torch.float32, torch.float64]))
def test_convolutions_and_shifted_sums_are_one_derivative(grid, order, dtype):
    field = random_field(grid, 2, items=2).to(dtype)
    for axis in range(grid.dim):
        ways = [derivative(field, grid, axis, order=order, by=by) for by in ("shifts", "convolution", "auto")]
        bound = 32 * torch.finfo(dtype).eps * float(field.abs().max()) / grid.spacing[axis]
        for other in ways[1:]:
            torch.testing.assert_close(ways[0], other, rtol=0, atol=bound)


@pytest.mark.parametrize("grid", [Grid((6, 7), (0.5, 2.0)), Grid((5, 6, 7), (0.5, 2.0, 1.0))])
def test_kernels_are_weights_of_convolutions(grid):
    """What a network would do with them is the derivative at the inner nodes."""
    field = random_field(grid, 1)
    for order, axis in [(order, axis) for order in ORDERS for axis in range(grid.dim)]:
        kernel = KERNELS[order][0]
        weights = kernel_weights(kernel, axis, grid.dim, field, grid.spacing[axis])
        inner = {2: F.conv2d, 3: F.conv3d}[grid.dim](field, weights)
        margin = len(kernel) // 2
        wanted = derivative(field, grid, axis, order=order).narrow(axis + 2, margin, grid.shape[axis] - 2 * margin)
        torch.testing.assert_close(inner, wanted)
    with pytest.raises(InputError, match="did you mean 'convolution'"):
        derivative(field, grid, 0, by="convolutions")
