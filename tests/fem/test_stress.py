"""Elements that are dearer than the others by any factor: few steps, the answer of a dense solve."""

import pytest
import torch
from torch import Tensor

from torchdeform.core.fold_free import neighbour_mean
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.solver import SolverSettings, solver_of
from torchdeform.fem.stress import StressGuess, suits
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights, weights_of_labels
from torchdeform.solvers.base import Status

SOFT = Weights(0.5, 1.0, 0.02)
DEAR = {
    "shape": Weights(5e3, 1.0, 0.02, 1e4),
    "volume": Weights(5e3, 1.0, 0.02),
    "turn": Weights(0.5, 1e4, 0.02),
    "all": Weights(5e3, 1e4, 0.02, 1e4),
}


def inside(grid: Grid, where: str) -> Tensor:
    """A ball, two of them, half of the box, or what is outside of a ball."""
    x = grid.points(dtype=torch.float64) / torch.tensor(grid.extent).view(1, -1, *[1] * grid.dim)

    def ball(middle: float, radius: float) -> Tensor:
        return ((x - middle) ** 2).sum(1, keepdim=True) < radius**2

    return {
        "ball": ball(0.45, 0.22),
        "two": ball(0.35, 0.15) | ball(0.65, 0.18),
        "half": x[:, :1] < 0.5,
        "most": ~ball(0.5, 0.3),
    }[where]


def system_of(grid: Grid, kind: str, where: str = "ball", dtype=torch.float64) -> DivCurlSystem:
    weights = weights_of_labels(inside(grid, where).long(), {1: DEAR[kind]}, SOFT, grid)
    return DivCurlSystem(grid, weights.to(torch.zeros(1, dtype=dtype)))


def smooth_load(system: DivCurlSystem, batch: int = 1, dtype=torch.float64) -> Tensor:
    force = torch.randn(batch, system.grid.dim, *system.grid.shape, dtype=torch.float64)
    for _ in range(3):
        force = neighbour_mean(force)
    return system.load(force=force.to(dtype))


def dense_solution(system: DivCurlSystem, load: Tensor) -> Tensor:
    return torch.linalg.solve(system.matrix().to_dense(), system.free(load).flatten(1).T).T.view_as(load)


@pytest.mark.parametrize("kind", DEAR)
@pytest.mark.parametrize("grid", [Grid((9, 12), (0.5, 1.3)), Grid((5, 4, 6), (0.7, 1.0, 1.4)), Grid((7, 2, 6))])
def test_it_solves_what_a_dense_solver_solves(grid, kind):
    system = system_of(grid, kind, "half")
    load = smooth_load(system, 2)
    for method in ("auto", "stress", "cg"):
        solution = solver_of(SolverSettings(method=method, rtol=1e-9), system).init(system, load).solution(load)
        assert solution.ok
        torch.testing.assert_close(solution.value, dense_solution(system, load), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("kind", DEAR)
def test_an_item_without_dear_elements_is_solved_beside_one_that_has_some(kind):
    grid = Grid((9, 12))
    labels = torch.cat([inside(grid, "ball"), torch.zeros(1, 1, *grid.shape, dtype=torch.bool)]).long()
    weights = weights_of_labels(labels, {1: DEAR[kind]}, SOFT, grid).to(torch.zeros(1, dtype=torch.float64))
    system = DivCurlSystem(grid, weights)
    load = smooth_load(system, 2)
    found = solver_of(SolverSettings(method="stress", rtol=1e-9), system).init(system, load).solution(load)
    assert found.ok
    for item, own in ((0, system_of(grid, kind)), (1, DivCurlSystem(grid, SOFT))):
        one = slice(item, item + 1)
        torch.testing.assert_close(found.value[one], dense_solution(own, load[one]), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "shape", "most"),
    [
        ("volume", (65, 65), 45),
        ("turn", (65, 65), 45),
        ("shape", (65, 65), 80),
        ("all", (65, 65), 40),
        ("volume", (17, 18, 15), 70),
        ("all", (17, 18, 15), 100),
    ],
)
@pytest.mark.parametrize("where", ["ball", "two", "half"])
def test_a_factor_of_ten_thousand_takes_few_steps(kind, shape, where, most):
    system = system_of(Grid(shape), kind, where)
    load = smooth_load(system)
    assert suits(system)
    solution = solver_of(SolverSettings(rtol=1e-6), system).init(system, load).solution(load)
    assert solution.ok
    assert float(solution.residual) <= 1e-6
    assert int(solution.steps) <= most


def test_a_larger_factor_takes_no_more_steps():
    grid, steps = Grid((33, 33)), []
    for price in (1e3, 1e4, 1e6):
        weights = weights_of_labels(inside(grid, "two").long(), {1: Weights(price, 1.0, 0.02, price)}, SOFT, grid)
        system = DivCurlSystem(grid, weights.to(torch.zeros(1).double()))
        load = smooth_load(system)
        found = solver_of(SolverSettings(rtol=1e-3), system).init(system, load).solution(load)
        assert found.ok
        steps.append(int(found.steps))
    assert max(steps) <= 1.5 * min(steps), steps


def test_each_item_of_a_batch_may_have_weights_of_its_own():
    grid = Grid((12, 11))
    alone = [system_of(grid, "shape", where) for where in ("ball", "half")]
    both = (torch.cat(pair) for pair in zip(*(s.weights.tensors for s in alone), strict=True))
    system = DivCurlSystem(grid, alone[0].weights.with_tensors(tuple(both)))
    load = smooth_load(system, 2)
    together = solver_of(SolverSettings(rtol=1e-10), system).init(system, load).solution(load)
    assert together.ok
    for i, single in enumerate(alone):
        torch.testing.assert_close(
            together.value[i : i + 1], dense_solution(single, load[i : i + 1]), rtol=1e-7, atol=1e-9
        )


@pytest.mark.parametrize("kind", DEAR)
def test_float32_comes_as_near_as_rounding_lets_it(kind):
    grid = Grid((33, 30))
    system, single = system_of(grid, kind), system_of(grid, kind, dtype=torch.float32)
    load = smooth_load(system)
    found = solver_of(SolverSettings(rtol=1e-2), single).init(single, load.float()).solution(load.float())
    assert found.status[0] in (Status.CONVERGED, Status.ROUNDING)
    off, exact = found.value.double() - dense_solution(system, load), dense_solution(system, load)
    cost, whole = ((v * system.apply(v)).sum() for v in (off, exact))
    assert float(cost) < 1e-2 * float(whole)


def test_a_start_that_is_near_saves_steps():
    system = system_of(Grid((17, 19)), "shape")
    load = smooth_load(system)
    factor = solver_of(SolverSettings(rtol=1e-6), system).init(system, load)
    cold = factor.solution(load)
    warm = factor.solution(load * 1.01, cold.value)
    assert int(warm.steps) < int(cold.steps)
    assert int(factor.solution(load, cold.value).steps) == 0


def test_gradients_are_those_of_the_assembled_matrix():
    grid, found = Grid((8, 7)), {}
    weights = system_of(grid, "shape").weights
    load = smooth_load(system_of(grid, "shape"))
    for method in ("stress", "assembled"):
        tensors = tuple(w.clone().requires_grad_() for w in weights.tensors)
        force = load.clone().requires_grad_()
        system = DivCurlSystem(grid, weights.with_tensors(tensors))
        value = solver_of(SolverSettings(method=method, rtol=1e-12), system).init(system, load).solution(force).value
        found[method] = torch.autograd.grad(value.square().sum(), (force, *tensors))
    for one, other in zip(*found.values(), strict=True):
        scale = float(other.abs().max())
        torch.testing.assert_close(one / scale, other / scale, rtol=0, atol=1e-7)


def test_what_does_not_suit_is_told_and_solved_otherwise():
    grid = Grid((9, 9))
    cheaper = weights_of_labels(inside(grid, "ball").long(), {1: Weights(5e3, 0.0, 0.02, 1e4)}, SOFT, grid)
    mild = weights_of_labels(inside(grid, "ball").long(), {1: Weights(2.0, 1.0, 0.02)}, SOFT, grid)
    free = DivCurlSystem(grid, system_of(grid, "shape").weights, "free")
    for system in (DivCurlSystem(grid, cheaper), DivCurlSystem(grid, mild), DivCurlSystem(grid, SOFT), free):
        assert not suits(system)
        with pytest.raises(InputError, match="stress is for weights of which some are far dearer"):
            solver_of("stress", system)
    assert solver_of("auto", system_of(grid, "shape")).guess is StressGuess
    assert solver_of("auto", free).guess is None
