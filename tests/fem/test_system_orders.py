"""Manufactured solutions with strain: the error falls with the square of the spacing, however far weights are apart."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.solver import SolverSettings, solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights

# w_div, w_curl, w_zero, w_strain.
CASES = [
    (1.0, 1.0, 0.1, 1.0),
    (1e4, 1.0, 0.0, 0.0),
    (1.0, 1e4, 0.0, 0.0),
    (1.0, 1.0, 0.0, 1e4),
    (1e4, 0.0, 1.0, 1e4),
    (1e4, 0.0, 1.0, 1.0),
]


def waves(x: Tensor) -> Tensor:
    """Nothing flows through the faces of the unit box, and nothing pulls along them."""
    parts = []
    for k in range(x.shape[1]):
        along = [torch.cos(math.pi * (1 + (a + k) % 2) * x[:, a]) for a in range(x.shape[1]) if a != k]
        parts.append((1 + 0.5 * k) * torch.sin(math.pi * x[:, k]) * math.prod(along[1:], start=along[0]))
    return torch.stack(parts, dim=1)


def eddy(x: Tensor) -> Tensor:
    """A field without divergence, of the same kind."""
    first = torch.sin(math.pi * x[:, 0]) * torch.cos(math.pi * x[:, 1])
    second = -torch.cos(math.pi * x[:, 0]) * torch.sin(math.pi * x[:, 1])
    deep = [torch.cos(math.pi * x[:, a]) for a in range(2, x.shape[1])]
    fields = [first, second, *(torch.zeros_like(first) for _ in deep)]
    return torch.stack([f * math.prod(deep[1:], start=deep[0]) if deep else f for f in fields], dim=1)


def uneven(x: Tensor) -> Tensor:
    """By how much all weights vary over the box."""
    return 1 + 0.5 * torch.cos(math.pi * x[:, :1]) * torch.cos(2 * math.pi * x[:, -1:])


def even(x: Tensor) -> Tensor:
    return torch.ones_like(x[:, :1])


def slopes(values: Tensor, x: Tensor) -> list[Tensor]:
    """∂_a of each channel, one ``(B, D, *S)`` per channel."""
    return [torch.autograd.grad(values[:, k].sum(), x, create_graph=True)[0] for k in range(values.shape[1])]


def force_of(field: Callable, factor: Callable, weights: tuple[float, ...], x: Tensor) -> Tensor:
    """−∇·(w_div div v I + w_strain dev sym ∇v + w_curl (∇v − ∇vᵀ)) + w_zero v, by differentiation of the formulas."""
    div_weight, curl_weight, zero, strain = weights
    v, w = field(x), factor(x)
    gradient = torch.stack(slopes(v, x), dim=1)  # (B, k, a, *S)
    turned = gradient.transpose(1, 2)
    div = torch.stack([gradient[:, k, k] for k in range(x.shape[1])]).sum(0)
    unit = torch.eye(x.shape[1], dtype=x.dtype).view(1, x.shape[1], x.shape[1], *[1] * x.shape[1])
    spread = div[:, None, None] * unit
    stress = div_weight * spread + curl_weight * (gradient - turned)
    stress = (stress + strain * ((gradient + turned) / 2 - spread / x.shape[1])) * w.unsqueeze(1)
    pull = [sum(s[:, a] for a, s in enumerate(slopes(stress[:, k], x))) for k in range(x.shape[1])]
    return (zero * w * v - torch.stack(pull, dim=1)).detach()


def error(field: Callable, factor: Callable, weights: tuple[float, ...], dim: int, cells: int) -> float:
    shape = (cells,) * (dim - 1) + (3 * cells // 2,)
    grid = Grid(tuple(n + 1 for n in shape), tuple(1 / n for n in shape))
    x = grid.points(dtype=torch.float64).requires_grad_()
    middle = Grid(shape, grid.spacing).points(dtype=torch.float64) + 0.5 * torch.tensor(grid.spacing).double().view(
        1, dim, *[1] * dim
    )
    by_element = factor(middle)
    given = weights if factor is even else [w * by_element if w else w for w in weights]
    system = DivCurlSystem(grid, Weights(*given))
    load = system.load(force=force_of(field, factor, weights, x))
    solution = solver_of(SolverSettings(rtol=1e-8), system).init(system, load).solution(load)
    assert solution.ok
    off = solution.value - field(x.detach())
    return math.sqrt(float((off.square() * grid.quadrature(dtype=off.dtype)).sum()))


@pytest.mark.parametrize(("dim", "cells"), [(2, (32, 64)), (3, (8, 16))])
@pytest.mark.parametrize("factor", [even, uneven])
@pytest.mark.parametrize("weights", CASES)
@pytest.mark.parametrize("field", [waves, eddy])
def test_the_error_falls_with_the_square_of_the_spacing(field, weights, factor, dim, cells):
    coarse, fine = (error(field, factor, weights, dim, n) for n in cells)
    assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.1), (coarse, fine)
