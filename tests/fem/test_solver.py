"""The solvers of one system have one answer, and each is chosen by a setting."""

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.errors import ComputationError, InputError
from torchdeform.fem.fast_transform import FastTransform, TransformFactor
from torchdeform.fem.solver import PRECONDITIONERS, SolverSettings, solver_of
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers.cg import ConjugateGradient, jacobi

GRIDS = [Grid((9, 12), (0.5, 1.3)), Grid((5, 6, 7), (0.7, 1.0, 1.4))]
SYSTEMS = [DivCurlSystem(grid, Weights(0.5, 1.0, 0.02)) for grid in GRIDS]
HOW = [
    SolverSettings(method=method, preconditioner=preconditioner, rtol=1e-12)
    for method in ("cg", "assembled")
    for preconditioner in ("transform", "jacobi", "none")
]


def load_of(system: DivCurlSystem, batch: int = 3, dtype=torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    shape = (batch, system.grid.dim, *system.grid.shape)
    return torch.randn(shape, dtype=torch.float64, generator=generator).to(dtype)


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("system", SYSTEMS, ids=["2D", "3D"])
def test_all_solvers_have_one_answer(system, how):
    """With every preconditioner, and for every power: (K⁻¹ M)^(p − 1) K⁻¹ load."""
    load = load_of(system)
    factor, direct = solver_of(how, system).init(system, load), FastTransform().init(system, load)
    solution = factor.solution(load)
    assert solution.ok
    torch.testing.assert_close(solution.value, direct(load), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(factor(load, power=2), direct(load, power=2), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("how", ["transform", *HOW])
def test_a_start_saves_steps_and_changes_no_answer(how):
    """What a start says about given unknowns plays no part."""
    system = SYSTEMS[0]
    load = load_of(system)
    factor = solver_of(how, system).init(system, load)
    cold = factor.solution(load)
    again = factor.solution(load, cold.value + system.fixed())
    assert again.ok
    assert not bool((again.steps > cold.steps.clamp(max=1)).any())
    torch.testing.assert_close(again.value, cold.value, rtol=1e-9, atol=1e-9)
    near = factor.solution(load, load_of(system).flip(1) + system.fixed())
    torch.testing.assert_close(near.value, cold.value, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", ["cg", "assembled"])
@pytest.mark.parametrize("system", SYSTEMS, ids=["2D", "3D"])
def test_preconditioned_by_the_direct_solver_one_step_is_enough(system, method, dtype):
    """The direct solver is the inverse of the very matrix that is assembled."""
    load = load_of(system, dtype=dtype)
    solution = solver_of(SolverSettings(method=method), system).init(system, load).solution(load)
    assert solution.ok
    assert solution.steps.tolist() == [1] * len(load)


def test_auto_takes_the_direct_solver_where_it_is_exact():
    exact, varying = SYSTEMS[0], DivCurlSystem(GRIDS[0], Weights(torch.rand(1, 1, 8, 11) + 1))
    inside = torch.zeros(1, 2, 9, 12, dtype=torch.bool)
    inside[0, :, 4, 4] = True
    held = DivCurlSystem(GRIDS[0], Weights(), "slip", inside)
    assert isinstance(solver_of("auto", exact), FastTransform)
    assert isinstance(solver_of("auto", exact).init(exact, load_of(exact)), TransformFactor)
    for system in (varying, held):
        chosen = solver_of("auto", system)
        assert chosen == ConjugateGradient(assembled=True, preconditioner=PRECONDITIONERS["transform"])
        assert chosen.preconditioner.__self__ == FastTransform(approximate=True)
        with pytest.raises(InputError, match="transform is not exact"):
            solver_of("transform", system).init(system, load_of(exact))


@pytest.mark.parametrize("method", ["cg", "assembled"])
def test_fixed_unknowns_and_weights_that_vary(method):
    grid = GRIDS[0]
    inside = torch.zeros(1, 2, *grid.shape, dtype=torch.bool)
    inside[0, :, 3:5, 4:7] = True
    weights = Weights(torch.linspace(1, 30, 88, dtype=torch.float64).view(1, 1, 8, 11), 1.0, 0.1)
    system = DivCurlSystem(grid, weights, "slip", inside)
    load = load_of(system)
    value = solver_of(SolverSettings(method=method, rtol=1e-12), system).init(system, load)(load)
    assert not value[inside.expand_as(value)].any()
    dense = torch.linalg.solve(system.matrix().to_dense(), system.free(load).flatten(1).T).T
    torch.testing.assert_close(value.flatten(1), dense, rtol=1e-9, atol=1e-9)


def test_gradients_of_weights_go_through_the_matrix_free_operator():
    grid = Grid((5, 4))
    load, found = load_of(DivCurlSystem(grid, Weights())), {}
    for method in ("cg", "assembled"):
        weight = torch.linspace(1, 2, 12, dtype=torch.float64).view(1, 1, 4, 3).requires_grad_()
        system = DivCurlSystem(grid, Weights(weight, 1.0, 0.1))
        value = solver_of(SolverSettings(method=method, rtol=1e-13), system).init(system, load).solution(load).value
        found[method] = torch.autograd.grad(value.square().sum(), weight)[0]
    torch.testing.assert_close(found["cg"], found["assembled"], rtol=1e-8, atol=1e-8)


def test_jacobi_divides_by_the_diagonal():
    load = load_of(SYSTEMS[1])
    diagonal = SYSTEMS[1].matrix().to_dense().diagonal().view(load[0].shape)
    divided = (SYSTEMS[1].free(x) for x in (jacobi(SYSTEMS[1], load)(load), load / diagonal))
    torch.testing.assert_close(*divided, rtol=1e-12, atol=0.0)


def test_what_cannot_be_solved_is_an_error():
    system = SYSTEMS[0]
    load = load_of(system, batch=1)
    few = SolverSettings(method="cg", preconditioner="none", max_steps=2)
    with pytest.raises(ComputationError, match="raise max_steps"):
        solver_of(few, system).init(system, load)(load)
    with pytest.raises(InputError, match="did you mean 'assembled'"):
        solver_of("asembled", system)
    with pytest.raises(InputError, match=r"preconditioner must be one of .* did you mean 'jacobi'"):
        SolverSettings(preconditioner="jacoby")
    batch = DivCurlSystem(GRIDS[0], Weights(torch.rand(2, 1, 8, 11) + 1))
    with pytest.raises(InputError, match="got a batch of 2"):
        solver_of("assembled", batch).init(batch, load)
