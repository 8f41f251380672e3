"""The solve, the flow and the head under `torch.func`: grad, jacrev and vmap give what autograd and a loop give."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.func import functional_call, grad, jacrev, vmap

import torchdeform as td
from torchdeform import nn as layers

WIDE = torch.float64
SLOW = "ignore:There is a performance drop:UserWarning"  # torch has no batched rule for one of the functions
pytestmark = pytest.mark.filterwarnings(SLOW)


def _cases(dim: int) -> dict[str, tuple[Callable[[Tensor], Tensor], Tensor]]:
    grid = td.Grid((5, 4, 3)[:dim], (1.0, 1.2, 0.9)[:dim])
    turns = 2 * dim - 3
    div, curl = torch.rand(2, 1, *grid.shape, dtype=WIDE), torch.rand(2, turns, *grid.shape, dtype=WIDE)
    features, v = torch.rand(1, 2, *grid.shape, dtype=WIDE), 0.2 * torch.rand(1, dim, *grid.shape, dtype=WIDE)
    weight = 0.5 + torch.rand(1, 1, *[n - 1 for n in grid.shape], dtype=WIDE)
    exact = {how: td.SolverSettings(method=how, rtol=1e-13) for how in ("transform", "cg", "assembled")}

    def solved(how: str) -> Callable[[Tensor], Tensor]:
        return lambda x: td.solve_div_curl(x, curl, grid, solver=exact[how]).value

    def weighted(x: Tensor) -> Tensor:
        return td.solve_div_curl(div[:1], curl[:1], grid, weights=td.Weights(div=x), solver=exact["cg"]).value

    def predicted(x: Tensor) -> Tensor:
        return layers.DivCurlVelocity(grid)(div, curl, weights=td.Weights(div=2.0, curl=0.5, zero=0.1, strain=x))

    return {
        **{how: (solved(how), div) for how in exact},
        "weights": (weighted, weight),
        "predicted weights": (predicted, weight),
        "velocity": (lambda x: layers.DivCurlVelocity(grid)(x, curl), div),
        "head": (layers.JacobianCurlHead(2, grid).double(), features),
        "flow": (lambda x: td.integrate(x, grid), v),
    }


CASES = tuple(_cases(2))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", CASES)
def test_grad_and_jacrev_are_those_of_autograd(name, dim):
    function, x = _cases(dim)[name]
    leaf = x.clone().requires_grad_()
    value = function(leaf)
    slope = torch.rand_like(value)
    (expected,) = torch.autograd.grad(value, leaf, slope)
    torch.testing.assert_close(grad(lambda y: (function(y) * slope).sum())(x), expected)
    rows = jacrev(function)(x).reshape(value.numel(), -1)
    torch.testing.assert_close((slope.flatten() @ rows).view(x.shape), expected)


@pytest.mark.parametrize("name", [name for name in CASES if name != "weights"])
def test_vmap_is_a_loop(name):
    function, x = _cases(2)[name]
    many = torch.stack([x, 0.7 * x, 1.3 * x])
    torch.testing.assert_close(vmap(function)(many), torch.stack([function(y) for y in many]))
    slopes = vmap(grad(lambda y: function(y).square().sum()))(many)
    torch.testing.assert_close(slopes, torch.stack([grad(lambda y: function(y).square().sum())(y) for y in many]))


def test_vmap_over_weights_of_the_function_is_refused():
    function, x = _cases(2)["weights"]
    with pytest.raises(td.InputError, match=r"vmap cannot run over weights here; give them as one batch"):
        vmap(function)(torch.stack([x, 2 * x]))


def test_parameters_of_the_head_have_gradients():
    head, features = _cases(2)["head"]
    names = dict(head.named_parameters())
    expected = torch.autograd.grad(head(features).square().sum(), list(names.values()))
    held = {name: p.detach() for name, p in names.items()}
    found = grad(lambda p: functional_call(head, p, (features,)).square().sum())(held)
    for name, slope in zip(names, expected, strict=True):
        torch.testing.assert_close(found[name], slope)


def test_second_derivatives_of_the_solve():
    x, curl = torch.rand(2, 1, 1, 5, 4, dtype=WIDE)
    grid = td.Grid((5, 4))

    def energy(y: Tensor) -> Tensor:
        return td.solve_div_curl(y, curl, grid).value.pow(3).sum()

    expected = torch.autograd.functional.hessian(energy, x)
    torch.testing.assert_close(jacrev(jacrev(energy))(x), expected)


def test_the_status_under_vmap_is_the_worst():
    """One of three has NaN: the status, which has no axis for it, says so."""
    grid = td.Grid((5, 4))
    many = torch.rand(3, 1, 1, *grid.shape)
    many[1, 0, 0, 2, 2] = torch.nan
    for solver in ("transform", "cg"):
        seen = []

        def solve(div: Tensor, solver: str = solver, seen: list = seen) -> Tensor:
            solution = td.solve_div_curl(div, None, grid, solver=solver)
            seen.append(solution.status)
            return solution.value

        value = vmap(solve)(many)
        assert seen == [(td.Status.NON_FINITE,)]
        assert value[[0, 2]].isfinite().all()


def test_transformations_leave_nothing_behind():
    function, x = _cases(2)["velocity"]
    before = function(x)
    grad(lambda y: function(y).sum())(x)
    assert torch.equal(function(x), before)
