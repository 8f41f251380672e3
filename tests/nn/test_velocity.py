"""Velocities by the solve as a layer: dense linear algebra is the oracle, of values, gradients, second derivatives."""

import copy

import pytest
import torch
from brute_force import Brute
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch import Tensor

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.diagnostics import diagnose, inverse_error
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.nn import DivCurlVelocity, FlowIntegrator

GRIDS = [Grid((5, 4), (1.0, 1.5)), Grid((4, 3, 5), (0.8, 1.0, 1.3))]
WEIGHTS = [(1.0, 1.0, 0.0), (1.0, 1.0, 0.4), (2.0, 0.5, 0.3)]
CASES = [
    (grid, boundary, weights)
    for grid in GRIDS
    for boundary in ("slip", "dirichlet")
    for weights in WEIGHTS
    if boundary == "slip" or weights[0] == weights[1]
]


def layer(grid: Grid, boundary: str, weights: tuple[float, float, float]) -> DivCurlVelocity:
    return DivCurlVelocity(grid, boundary, weight_div=weights[0], weight_curl=weights[1], weight_zero=weights[2])


def dense(grid: Grid, boundary: str, weights: tuple[float, float, float]) -> Tensor:
    """Return the matrix of (div, curl) ↦ v: the inverse of K on the free unknowns, times the matrix of the load."""
    oracle = Brute(grid.shape, grid.spacing, points=2)
    stiffness = oracle.matrix(oracle.div_curl(*weights), grid.dim)
    load = oracle.load_matrix(oracle.div_curl(*weights), 1 + len(CURL_PAIRS[grid.dim]), grid.dim)
    free = ~fixed_unknowns(boundary, grid).flatten()
    solved = torch.zeros_like(load)
    solved[free] = torch.linalg.solve(stiffness[free][:, free], load[free])
    return solved


def random_data(grid: Grid, items: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    shapes = [(items, channels, *grid.shape) for channels in (1, len(CURL_PAIRS[grid.dim]))]
    div, curl = (torch.randn(shape, dtype=torch.float64, generator=generator).requires_grad_() for shape in shapes)
    return div, curl


@pytest.mark.parametrize(("grid", "boundary", "weights"), CASES)
def test_value_gradient_and_second_derivative_are_those_of_dense_algebra(grid, boundary, weights):
    div, curl = random_data(grid)
    matrix = dense(grid, boundary, weights)
    ours = layer(grid, boundary, weights)(div, curl)
    theirs = (torch.cat([div, curl], dim=1).flatten(1) @ matrix.T).view_as(ours)
    assert torch.allclose(ours, theirs, rtol=0, atol=1e-8)
    for found, wanted in zip(derivatives(ours, div, curl), derivatives(theirs, div, curl), strict=True):
        assert torch.allclose(found, wanted, rtol=0, atol=1e-8)


def derivatives(v: Tensor, *inputs: Tensor) -> list[Tensor]:
    """Return the gradient of Σ v³ and that of the sum of its squares, a second derivative."""
    first = torch.autograd.grad(v.pow(3).sum(), inputs, create_graph=True)
    second = torch.autograd.grad(sum(g.square().sum() for g in first), inputs)
    return [*first, *second]


@pytest.mark.parametrize("grid", [Grid((4, 5)), Grid((3, 2, 3), (1.0, 0.7, 1.2))])
@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
def test_gradcheck(grid, boundary):
    inputs = random_data(grid, 1)
    solve = DivCurlVelocity(grid, boundary)
    assert torch.autograd.gradcheck(solve, inputs, fast_mode=True)
    assert torch.autograd.gradgradcheck(solve, inputs, fast_mode=True)


@pytest.mark.parametrize("grid", GRIDS)
def test_batch_equals_its_items_and_repeats_itself(grid):
    div, curl = (t.detach() for t in random_data(grid, 3))
    solve = DivCurlVelocity(grid)
    whole = solve(div, curl)
    alone = torch.cat([solve(d[None], c[None]) for d, c in zip(div, curl, strict=True)])
    assert_same_to_rounding(whole, alone, terms_of_a_solve(grid), condition_of_a_solve(grid))
    assert torch.equal(whole, solve(div, curl))
    assert torch.equal(whole, copy.deepcopy(solve)(div, curl))
    assert torch.equal(solve(div), solve(div, torch.zeros_like(curl)))


def test_dtypes_take_turns():
    """What is kept for one dtype does not disturb the other."""
    div, curl = (t.detach() for t in random_data(GRIDS[0]))
    solve = DivCurlVelocity(GRIDS[0])
    for _ in range(2):
        exact = solve(div, curl)
        rough = solve(div.float(), curl.float())
        assert (exact.dtype, rough.dtype) == (torch.float64, torch.float32)
        assert torch.allclose(exact.float(), rough, atol=1e-5)


def test_half_precision_is_solved_in_single():
    div, curl = (t.detach().bfloat16() for t in random_data(GRIDS[0]))
    solve = DivCurlVelocity(GRIDS[0])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        v = solve(div, curl)
    assert v.dtype == torch.float32
    assert torch.equal(v, solve(div.float(), curl.float()))


def test_one_layer_serves_several_threads():
    from concurrent.futures import ThreadPoolExecutor

    solve = DivCurlVelocity(GRIDS[0])
    data = [random_data(GRIDS[0], 1)[0].detach() * k for k in range(16)]
    alone = [solve(d) for d in data]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(solve, data))
    for a, b in zip(alone, together, strict=True):  # a thread of a pool may have another number of threads for products
        assert_same_to_rounding(a, b, terms_of_a_solve(GRIDS[0]), condition_of_a_solve(GRIDS[0]))


def test_wrong_input_is_refused():
    grid = GRIDS[0]
    with pytest.raises(InputError, match="boundary"):
        DivCurlVelocity(grid, "sticky")
    with pytest.raises(InputError, match="take solver='auto'"):
        DivCurlVelocity(grid, "dirichlet", weight_div=2.0, solver="transform")
    with pytest.raises(InputError, match="did you mean 'assembled'"):
        DivCurlVelocity(grid, solver="asembled")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="positive"):
        DivCurlVelocity(grid, weight_curl=0.0)
    with pytest.raises(InputError, match="div must have shape"):
        DivCurlVelocity(grid)(torch.zeros(1, 2, *grid.shape))
    with pytest.raises(InputError, match="curl must have shape"):
        DivCurlVelocity(grid)(torch.zeros(1, 1, *grid.shape), torch.zeros(1, 3, *grid.shape))
    with pytest.raises(InputError, match="method"):
        FlowIntegrator(grid, "heun")
    with pytest.raises(InputError, match="no adjoint"):
        FlowIntegrator(grid, adjoint=True)
    with pytest.raises(InputError, match="steps"):
        FlowIntegrator(grid, steps=0)


def smooth_velocity(grid: Grid, make_displacement) -> Tensor:
    return make_displacement(grid, 0.1).double()


@pytest.mark.parametrize("grid", [Grid((33, 25), (1.0, 1.5)), Grid((17, 15, 13))])
@pytest.mark.parametrize("method", ["squaring", "rk4", "dopri5"])
def test_flow_and_its_inverse(grid, method, make_displacement):
    v = smooth_velocity(grid, make_displacement)
    flow = FlowIntegrator(grid, method)
    u, w = flow(v), flow.inverse(v)
    assert int(diagnose(u, grid).folds) == 0
    assert float(inverse_error(u, w, grid)[1]) < 0.1
    assert torch.allclose(u, FlowIntegrator(grid, "rk4", steps=32)(v), atol=0.05 * float(u.abs().max()))


def test_squaring_converges_with_the_number_of_steps():
    """The flow of a uniform stretching about the middle is known: x − m ↦ eᵃ (x − m), and linear fields interpolate
    without error, so all that is left is the first order in 2⁻ⁿ."""
    grid, rate = Grid((9, 9)), -0.5
    offset = grid.points(dtype=torch.float64) - 4
    exact = (torch.exp(torch.tensor(rate, dtype=torch.float64)) - 1) * offset
    errors = [float((FlowIntegrator(grid, steps=n)(rate * offset) - exact).abs().max()) for n in (4, 5, 6)]
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.1)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("method", ["squaring", "rk4"])
def test_flow_gradcheck(method, make_displacement):
    """The velocity points inwards at the boundary, where points that are held on it have a kink."""
    grid = Grid((5, 6))
    x = grid.points(dtype=torch.float64)
    inwards = grid.along([n / 2 + 0.17 for n in grid.extent], x) - x  # towards no node: interpolation has kinks there
    v = (make_displacement(grid, 0.07).double() + 0.13 * inwards).requires_grad_()
    assert torch.autograd.gradcheck(FlowIntegrator(grid, method, steps=3), (v,))


def kept(run) -> int:
    """Return the bytes that a forward keeps for its backward."""
    storages = {}

    def keep(tensor):
        storages[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = run()
    del result
    return sum(storages.values())


@pytest.mark.parametrize("shape", [(32, 32), (12, 12, 12)])
def test_memory_is_bounded_by_the_adjoint(shape, make_displacement):
    """What is kept does not grow with the steps, and is at most a few fields."""
    grid = Grid(shape)
    v = make_displacement(grid, 0.05).requires_grad_()
    whole, adjoint = (
        [kept(lambda f=FlowIntegrator(grid, "rk4", steps=n, adjoint=a): f(v)) for n in (4, 8)] for a in (False, True)
    )
    assert whole[1] > 1.5 * whole[0]
    assert adjoint[1] == adjoint[0] < 6 * v.untyped_storage().nbytes()


def test_adjoint_gradient_is_that_of_the_steps(make_displacement):
    grid = Grid((24, 20))
    v = make_displacement(grid, 0.05).double().requires_grad_()
    plain, adjoint = (
        torch.autograd.grad(FlowIntegrator(grid, "rk4", steps=16, adjoint=a)(v).square().sum(), v)[0]
        for a in (False, True)
    )
    assert torch.allclose(plain, adjoint, rtol=0.02, atol=0.02 * float(plain.abs().max()))
