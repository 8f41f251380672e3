"""Velocities with a given divergence: closed forms, convergence, exact zeros at the boundary, derivatives, errors."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core.derivatives import CURL_PAIRS, curl, divergence
from torchdeform.core.grid import Grid
from torchdeform.deformation.velocity import find_velocity
from torchdeform.errors import InputError

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
WAYS = ["direct", "poisson", "div_curl"]
SIDES = (1.0, 1.5, 0.8)


def box(dim: int, cells: int) -> Grid:
    """Anisotropic cells on a box that is no cube."""
    counts = [cells + k * cells // 4 for k in range(dim)]
    return Grid(tuple(n + 1 for n in counts), tuple(side / n for side, n in zip(SIDES, counts, strict=False)))


def waves(grid: Grid) -> tuple[Tensor, Tensor]:
    """Return α = Π cos(ξ_k x_k) with ξ_k = (k + 1) π/length_k and v = ∇w, Δw = α."""
    x = grid.points(dtype=torch.float64)
    xi = [(k + 1) * math.pi / side for k, side in enumerate(grid.extent)]
    cosines = [torch.cos(xi[k] * x[:, k]) for k in range(grid.dim)]
    total = sum(value**2 for value in xi)
    parts = [
        torch.sin(xi[k] * x[:, k]) * xi[k] / total * math.prod(cosines[:k] + cosines[k + 1 :], start=1.0)
        for k in range(grid.dim)
    ]
    return math.prod(cosines[1:], start=cosines[0]).unsqueeze(1), torch.stack(parts, dim=1)


def random_alpha(grid: Grid, batch: int = 1) -> Tensor:
    return torch.randn(batch, 1, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(0))


@pytest.mark.parametrize("dim", [2, 3])
def test_poisson_is_exact_for_cosines(dim):
    alpha, v = waves(box(dim, 8))
    torch.testing.assert_close(find_velocity(alpha, box(dim, 8), "poisson"), v, atol=1e-13, rtol=1e-13)


@pytest.mark.parametrize("dim", [2, 3])
def test_div_curl_tends_to_the_gradient(dim):
    errors = []
    for cells in (10, 20, 40):
        alpha, v = waves(box(dim, cells))
        errors.append(float((find_velocity(alpha, box(dim, cells), "div_curl") - v).abs().max()))
    assert math.log2(errors[1] / errors[2]) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("dim", [2, 3])
def test_direct_is_the_construction_of_the_paper(dim):
    """Eq. (2.15) and its 3D form by hand, for α that varies along the last axis only: no integral before it is 0."""

    def exact(grid: Grid) -> tuple[Tensor, Tensor]:
        x = grid.points(dtype=torch.float64)
        t = [x[:, k] / side for k, side in enumerate(grid.extent)]
        last, side = t[-1], grid.extent[-1]
        parts, slopes = [], torch.ones_like(last)
        for k, length in enumerate(grid.extent[:-1]):
            parts.append(slopes * length * (t[k] - (1 - torch.cos(math.pi * t[k])) / 2) * torch.cos(math.pi * last))
            slopes = slopes * math.pi / 2 * torch.sin(math.pi * t[k])
        parts.append(slopes * side / math.pi * torch.sin(math.pi * last))
        return torch.cos(math.pi * last).unsqueeze(1), torch.stack(parts, dim=1)

    errors = []
    for cells in (20, 40):
        alpha, v = exact(box(dim, cells))
        errors.append(float((find_velocity(alpha, box(dim, cells), "direct") - v).abs().max()))
    assert errors[1] < 1e-3
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize("velocity", WAYS)
@pytest.mark.parametrize("dim", [2, 3])
def test_the_divergence_is_as_asked_to_second_order(dim, velocity):
    """A divergence that is no product, whose mean is not 0 and whose slopes do not vanish at the walls."""
    errors = []
    for cells in {2: (32, 64), 3: (16, 32)}[dim]:
        grid = box(dim, cells)
        x = grid.points(dtype=torch.float64)
        alpha = torch.exp(-((x - 0.4) ** 2).sum(1, keepdim=True) / 0.1) + 0.3 * x[:, :1] * x[:, 1:2]
        weights = grid.quadrature(dtype=torch.float64)
        want = alpha - (alpha * weights).sum() / grid.volume
        error = (divergence(find_velocity(alpha, grid, velocity), grid) - want) ** 2
        errors.append(math.sqrt(float((error * weights).sum())))
    assert errors[1] < 0.05
    assert math.log2(errors[0] / errors[1]) > 1.5  # the one-sided differences at the walls take half an order


def test_a_prescribed_curl_is_found_again():
    """A field that slips along the walls, from its divergence and curl."""
    for dim in (2, 3):
        errors = []
        for cells in (12, 24):
            grid = box(dim, cells)
            x = grid.points(dtype=torch.float64).requires_grad_()
            unit = [x[:, k] * math.pi / side for k, side in enumerate(grid.extent)]
            parts = [torch.sin(unit[k]) * torch.cos(unit[k - 1] + k) for k in range(dim)]
            slopes = [torch.autograd.grad(p.sum(), x, retain_graph=True)[0] for p in parts]
            alpha = sum(slopes[k][:, k] for k in range(dim))
            beta = torch.stack([slopes[b][:, a] - slopes[a][:, b] for a, b in CURL_PAIRS[dim]], dim=1)
            v = find_velocity(alpha.unsqueeze(1), grid, curl=beta)
            errors.append(float((v - torch.stack(parts, dim=1)).detach().abs().max()))
        assert errors[1] < 0.01
        assert errors[0] / errors[1] > 3
        assert float(curl(v.detach(), grid).abs().max()) > 1


@settings(deadline=None, max_examples=25)
@given(
    shape=st.lists(st.integers(2, 9), min_size=2, max_size=3),
    spacing=st.lists(st.floats(0.2, 5.0), min_size=3, max_size=3),
    velocity=st.sampled_from(WAYS),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    level=st.floats(-10, 10),
)
def test_nothing_crosses_the_walls_and_constants_do_not_matter(shape, spacing, velocity, dtype, level):
    grid = Grid(tuple(shape), tuple(spacing[: len(shape)]))
    alpha = random_alpha(grid, 2).to(dtype)
    v = find_velocity(alpha, grid, velocity)
    for k in range(grid.dim):
        for end in (0, -1):
            assert v[:, k].select(k + 1, end).abs().max() == 0
    close = {"atol": 1e-3 if dtype == torch.float32 else 1e-10, "rtol": 0}
    torch.testing.assert_close(find_velocity(alpha + level, grid, velocity), v, **close)


@pytest.mark.parametrize("velocity", WAYS)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_batch_equals_its_items(dim, velocity):
    grid = box(dim, 7)
    alpha = random_alpha(grid, 3) * torch.tensor([1.0, 1e6, 0.0]).view(3, *[1] * (dim + 1))
    terms, condition = terms_of_a_solve(grid), condition_of_a_solve(grid)
    for item, together in zip(alpha, find_velocity(alpha, grid, velocity), strict=True):
        assert_same_to_rounding(together, find_velocity(item[None], grid, velocity)[0], terms, condition)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("velocity", WAYS)
def test_type_and_device_stay(velocity, device):
    grid = box(3, 6)
    exact = find_velocity(random_alpha(grid), grid, velocity)
    v = find_velocity(random_alpha(grid).to(device, torch.float32), grid, velocity)
    assert (v.dtype, v.device.type) == (torch.float32, device)
    torch.testing.assert_close(v.cpu().double(), exact, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("velocity", WAYS)
def test_gradients(velocity):
    grid = Grid((4, 3, 3), (0.5, 1.0, 0.7))
    alpha = random_alpha(grid).requires_grad_()
    assert gradcheck(lambda a: find_velocity(a, grid, velocity), alpha, fast_mode=True)
    assert gradgradcheck(lambda a: find_velocity(a, grid, velocity) ** 2, alpha, fast_mode=True)


def test_gradients_in_the_curl():
    grid = Grid((4, 5), (0.5, 1.0))
    alpha = random_alpha(grid, 2)
    beta = torch.randn(1, 1, 4, 5, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda b: find_velocity(alpha, grid, curl=b), beta)


def test_wrong_input_is_refused():
    grid = Grid((4, 5))
    alpha = torch.zeros(1, 1, 4, 5)
    with pytest.raises(InputError, match="velocity must be one of direct, poisson, div_curl, got 'poison'; did you"):
        find_velocity(alpha, grid, "poison")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"find_velocity: div must have shape \(B, 1, 4, 5\)"):
        find_velocity(alpha[..., 1:], grid)
    with pytest.raises(InputError, match=r"div must be a floating-point tensor of 32 or 64 bits, got torch\.float16"):
        find_velocity(alpha.half(), grid)
    with pytest.raises(InputError, match="velocity 'direct' leaves the curl free; take velocity='div_curl'"):
        find_velocity(alpha, grid, "direct", curl=alpha)
    with pytest.raises(InputError, match="curl must be finite"):
        find_velocity(alpha, grid, curl=alpha + math.inf)
    with pytest.raises(InputError, match="solve_div_curl: curl must have shape"):
        find_velocity(alpha, grid, curl=torch.zeros(1, 3, 4, 5))
