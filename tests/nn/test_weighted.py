"""The solve with weights that are tensors: brute force, derivatives in the weights, a batch of them, errors."""

import copy
import math

import pytest
import torch
from brute_force import Brute
from torch import Tensor, nn

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.grid import Grid
from torchdeform.errors import ComputationError, InputError
from torchdeform.fem import Weights, solve_div_curl
from torchdeform.fem.boundary import fixed_unknowns
from torchdeform.nn import DivCurlVelocity
from torchdeform.solvers.cg import ConjugateGradient

GRIDS = [Grid((5, 4), (1.0, 1.5)), Grid((4, 3, 3), (0.8, 1.0, 1.3))]
BOUNDARIES = ["slip", "dirichlet", "no_slip_tangential"]
NAMES = ("div", "curl", "zero", "strain")


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def some_weights(grid: Grid, items: int = 2) -> list[Tensor]:
    """Return weights by element up to 20 times apart: div and curl are looked at in the centres too."""
    elements = [n - 1 for n in grid.shape]
    return [0.2 * 20 ** torch.rand(items, 1, *elements, dtype=torch.float64) for _ in NAMES]


def some_data(grid: Grid, items: int = 2) -> list[Tensor]:
    return [torch.randn(items, c, *grid.shape, dtype=torch.float64) for c in (1, len(CURL_PAIRS[grid.dim]))]


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("grid", GRIDS)
def test_each_item_is_that_of_dense_algebra(grid, boundary):
    weights, (div, curl) = some_weights(grid), some_data(grid)
    found = DivCurlVelocity(grid, boundary)(div, curl, Weights(*weights))
    oracle, free = Brute(grid.shape, grid.spacing, points=2), ~fixed_unknowns(boundary, grid).flatten()
    for item in range(2):
        rows = oracle.div_curl(*(w[item, 0].numpy() for w in weights))
        load = oracle.load(rows, torch.cat([div[item], curl[item]]), grid.dim)
        wanted = torch.zeros_like(load)
        wanted[free] = torch.linalg.solve(oracle.matrix(rows, grid.dim)[free][:, free], load[free])
        torch.testing.assert_close(found[item].flatten(), wanted, rtol=0, atol=1e-8)


@pytest.mark.parametrize("boundary", ["slip", "dirichlet"])
@pytest.mark.parametrize("grid", GRIDS)
def test_gradcheck(grid, boundary):
    """Of the first and of the second order, for a batch of weights and data."""
    inputs = [t.requires_grad_() for t in (*some_data(grid), *some_weights(grid))]
    check_gradients(DivCurlVelocity(grid, boundary), inputs)


@pytest.mark.parametrize(("items", "batch"), [(1, 2), (2, 1)])
def test_gradcheck_of_one_for_all(items, batch):
    """One set of weights for all data, one set of data for all weights."""
    inputs = [t.requires_grad_() for t in (*some_data(GRIDS[0], batch), *some_weights(GRIDS[0], items))]
    check_gradients(DivCurlVelocity(GRIDS[0]), inputs)


def check_gradients(solve: DivCurlVelocity, inputs: list[Tensor]) -> None:
    def velocity(div: Tensor, curl: Tensor, *weights: Tensor) -> Tensor:
        return solve(div, curl, weights=Weights(*weights))

    assert torch.autograd.gradcheck(velocity, inputs, fast_mode=True)
    assert torch.autograd.gradgradcheck(velocity, inputs, fast_mode=True)


def test_one_number_that_is_a_tensor_has_its_gradient():
    grid = GRIDS[0]
    div, curl = some_data(grid)
    weights = [torch.tensor(w, dtype=torch.float64, requires_grad=True) for w in (2.0, 0.5, 0.1, 0.3)]
    assert torch.autograd.gradcheck(lambda *w: DivCurlVelocity(grid)(div, curl, Weights(*w)), weights, fast_mode=True)


@pytest.mark.parametrize("grid", GRIDS)
def test_ways_to_say_the_same(grid):
    """Numbers, tensors of the layer, tensors of the call, and the function."""
    div, curl = some_data(grid)
    numbers = {"div": 0.5, "curl": 3.0, "zero": 0.2, "strain": 0.7}
    elements = [n - 1 for n in grid.shape]
    maps = Weights(**{name: torch.full((1, 1, *elements), w, dtype=torch.float64) for name, w in numbers.items()})
    short = DivCurlVelocity(grid, **{f"weight_{name}": w for name, w in numbers.items()})
    wanted = solve_div_curl(div, curl, grid, weights=Weights(**numbers)).value
    for v in (
        short(div, curl),
        DivCurlVelocity(grid, weights=Weights(**numbers))(div, curl),
        DivCurlVelocity(grid)(div, curl, Weights(**numbers)),
        DivCurlVelocity(grid, weights=maps)(div, curl),
        DivCurlVelocity(grid)(div, curl, weights=maps),
        short(div, curl, weights=maps),
    ):
        torch.testing.assert_close(v, wanted, rtol=0, atol=1e-8)


def test_a_layer_made_of_predicted_weights_hands_gradients_on():
    """Made anew for each prediction, as within a loss; under `torch.func` too."""
    grid, (div, curl) = GRIDS[0], some_data(GRIDS[0])
    raw = torch.randn(2, 1, 4, 3, dtype=torch.float64)

    def energy(raw: Tensor) -> Tensor:
        return DivCurlVelocity(grid, weights=Weights(strain=raw.exp()))(div, curl).square().sum()

    assert torch.autograd.gradcheck(energy, raw.clone().requires_grad_(), fast_mode=True)
    (wanted,) = torch.autograd.grad(energy(leaf := raw.clone().requires_grad_()), leaf)
    torch.testing.assert_close(torch.func.grad(energy)(raw), wanted)
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(energy))(raw[None])[0], wanted)


def test_where_strain_is_dear_the_velocity_keeps_shapes():
    """Of a source beside it, a block in which divergence and strain are dear turns and moves, but is not bent."""
    grid = Grid((25, 25))
    block = torch.zeros(1, 1, 24, 24)
    block[..., 8:16, 10:18] = 1.0
    dear = Weights(div=1 + 1000 * block, curl=1 - block + 1e-3, strain=1000 * block)
    div = torch.exp(-((grid.points() - torch.tensor([6.0, 5.0]).view(1, 2, 1, 1)) ** 2).sum(1, keepdim=True) / 8)
    bent = [bending(v[..., 8:17, 10:19]) for v in (DivCurlVelocity(grid)(div), DivCurlVelocity(grid)(div, None, dear))]
    assert bent[1] < 0.02 * bent[0]


def bending(v: Tensor) -> float:
    """Return what is left of a velocity ``(1, 2, *S)`` besides a rigid motion, of its mean size."""
    axes = torch.meshgrid(*(torch.arange(n, dtype=v.dtype) for n in v.shape[2:]), indexing="ij")
    one, zero = torch.ones_like(axes[0]), torch.zeros_like(axes[0])
    rigid = torch.stack([torch.stack(m) for m in ((one, zero), (zero, one), (-axes[1], axes[0]))]).flatten(1).T
    flat = v.flatten()
    left = flat - rigid @ torch.linalg.lstsq(rigid, flat[:, None]).solution[:, 0]
    return float(left.norm() / flat.norm())


def test_parameters_are_learned_saved_and_moved():
    grid, (div, curl) = GRIDS[0], some_data(GRIDS[0])
    stiffness = nn.Parameter(torch.ones(1, 1, 4, 3))
    layer = DivCurlVelocity(grid, weights=Weights(curl=torch.full((1, 1, 4, 3), 0.5), strain=stiffness))
    assert dict(layer.named_parameters()) == {"weight_strain": stiffness}
    assert set(layer.state_dict()) == {"weight_strain", "weight_curl"}
    assert layer.weights.div == 1.0
    assert "weight_strain=tensor(1, 1, 4, 3)" in repr(layer)
    wanted = DivCurlVelocity(grid, weight_curl=0.5, weight_strain=3.0)(div, curl)
    optimizer, losses = torch.optim.Adam(layer.parameters(), 0.1), []
    for _ in range(10):
        loss = (layer(div, curl) - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.5 * losses[0]
    other = DivCurlVelocity(grid, weights=Weights(curl=torch.ones(1, 1, 4, 3), strain=torch.ones(1, 1, 4, 3)))
    other.load_state_dict(layer.state_dict())
    assert torch.equal(other(div, curl), layer(div, curl))
    assert torch.equal(copy.deepcopy(layer)(div, curl), layer(div, curl))
    assert layer.double().weights.strain.dtype == torch.float64


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_solved_in_single(dtype):
    grid, (div, curl) = GRIDS[0], some_data(GRIDS[0])
    weights = Weights(strain=some_weights(grid)[0].to(dtype))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        v = DivCurlVelocity(grid)(div.to(dtype), curl.to(dtype), weights)
    assert v.dtype == torch.float32
    wide = Weights(strain=weights.tensors[0].float())
    assert torch.equal(v, DivCurlVelocity(grid)(div.to(dtype).float(), curl.to(dtype).float(), wide))


def test_what_is_not_finite_stays_in_its_item():
    """As for a scaler of mixed precision, which wants to see infinite gradients, not an error."""
    grid, (div, curl) = GRIDS[0], some_data(GRIDS[0])
    weights = Weights(*some_weights(grid))
    sound = DivCurlVelocity(grid)(div, curl, weights)
    div[0, 0, 1, 1] = math.nan
    v = DivCurlVelocity(grid)(div, curl, weights)
    assert v[0].isnan().any()
    torch.testing.assert_close(v[1], sound[1])


@pytest.mark.parametrize("grid", GRIDS)
def test_torch_finds_nothing_wrong_with_the_operator(grid):
    data = torch.cat(some_data(grid), dim=1).requires_grad_()
    tensors = [w.requires_grad_() for w in some_weights(grid)[:2]]
    arguments = data, tensors, [0.0, 0.0, 0.1, 0.2], [0, 1], list(grid.spacing), "slip", "cg", False
    torch.library.opcheck(torch.ops.torchdeform.weighted_velocity, arguments)


GRID = GRIDS[0]


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (Weights(strain=torch.full((1, 1, 4, 3), -1.0)), "strain must be finite and at least 0, got -1"),
        (Weights(div=torch.zeros(1, 1, 4, 3)), "div must be finite and positive, got 0"),
        (Weights(curl=torch.full((1, 1, 4, 3), math.nan)), "curl must be finite and at least 0, got nan"),
        (Weights(zero=torch.full((1, 1, 4, 3), math.inf)), "zero must be finite and at least 0, got inf"),
        (Weights(curl=torch.zeros(1, 1, 4, 3)), "curl must be finite and positive where strain is 0"),
        (Weights(strain=torch.ones(1, 1, 5, 4)), r"strain must be a number or have shape \(B, 1, 4, 3\)"),
        (torch.ones(1, 1, 4, 3), r"weights must be Weights\(div=.., curl=..\), of numbers or tensors, got Tensor"),
    ],
)
def test_wrong_weights_are_refused(weights, message):
    """Of the layer, and of the call; under autograd too."""
    with pytest.raises(InputError, match=message):
        DivCurlVelocity(GRID, weights=weights)
    with pytest.raises(InputError, match=message):
        DivCurlVelocity(GRID)(torch.zeros(1, 1, 5, 4, requires_grad=True), weights=weights)


def test_wrong_uses_are_refused(monkeypatch):
    maps = Weights(strain=torch.ones(3, 1, 4, 3))
    with pytest.raises(InputError, match="weights are given twice; give weights, or weight_div and its like"):
        DivCurlVelocity(GRID, weights=maps, weight_div=2.0)
    with pytest.raises(InputError, match="take solver='auto'"):
        DivCurlVelocity(GRID, weights=maps, solver="transform")
    with pytest.raises(InputError, match="transform is not exact"):
        DivCurlVelocity(GRID, solver="transform")(torch.zeros(1, 1, 5, 4), weights=maps)
    with pytest.raises(InputError, match=r"batch sizes must agree or be 1, got \[2, 3\]"):
        DivCurlVelocity(GRID)(torch.zeros(2, 1, 5, 4), weights=maps)
    monkeypatch.setattr("torchdeform.nn.weighted.solver_of", lambda *_: ConjugateGradient(max_steps=1))
    with pytest.raises(ComputationError, match="max_steps"):
        DivCurlVelocity(GRID)(torch.rand(1, 1, 5, 4), weights=maps)
