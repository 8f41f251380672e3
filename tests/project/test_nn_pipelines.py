"""What a training pipeline does to modules: compile, export, copy, save, spread over processes."""

import copy
import os
import pickle
import subprocess
import sys

import pytest
import torch
from torch import nn

from torchdeform import nn as layers
from torchdeform.core.grid import Grid
from torchdeform.fem import Weights

GRIDS = [Grid((16, 12), (1.0, 1.5)), Grid((8, 9, 10))]


class Pipeline(nn.Module):
    """A network, its head, and the moving image warped."""

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.network = {2: nn.Conv2d, 3: nn.Conv3d}[grid.dim](2, 4, 3, padding=1)
        self.head = layers.JacobianCurlHead(4, grid)
        nn.init.normal_(self.head.conv.weight, std=0.1)
        self.warp = layers.SpatialTransformer(grid)

    def forward(self, pair: torch.Tensor) -> torch.Tensor:
        return self.warp(pair[:, 1:], self.head(self.network(pair)))


class PredictedWeights(nn.Module):
    """A network that says what divergence, curl and strain cost in every element of the solve after it."""

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.network = {2: nn.Conv2d, 3: nn.Conv3d}[grid.dim](2, 3, 2)
        self.solve = layers.DivCurlVelocity(grid)

    def forward(self, pair: torch.Tensor) -> torch.Tensor:
        div, curl, strain = (nn.functional.softplus(self.network(pair)) + 0.1).chunk(3, dim=1)
        return self.solve(pair[:, :1] - pair[:, 1:], weights=Weights(div, curl, 0.1, strain))


def pairs(grid: Grid, items: int) -> torch.Tensor:
    return torch.rand(items, 2, *grid.shape, generator=torch.Generator().manual_seed(items))


def modules(grid: Grid) -> dict[str, tuple[nn.Module, tuple[torch.Tensor, ...]]]:
    """Return every layer of the hot path with input for it."""
    u = 0.3 * torch.rand(2, grid.dim, *grid.shape)
    image = torch.rand(2, 1, *grid.shape)
    return {
        "SpatialTransformer": (layers.SpatialTransformer(grid), (image, u)),
        "DivCurlVelocity": (layers.DivCurlVelocity(grid), (image,)),
        "FlowIntegrator": (layers.FlowIntegrator(grid), (u,)),
        "FlowIntegrator rk4": (layers.FlowIntegrator(grid, "rk4", steps=2), (u,)),
        "FlowIntegrator midpoint": (layers.FlowIntegrator(grid, "midpoint", steps=3), (u,)),
        "DivCurlVelocity cg": (layers.DivCurlVelocity(grid, "dirichlet", weight_div=2.0), (image,)),
        "DivCurlVelocity weights": (layers.DivCurlVelocity(grid, weights=stiff_inside(grid)), (image,)),
        "PredictedWeights": (PredictedWeights(grid), (pairs(grid, 2),)),
        "Pipeline": (Pipeline(grid), (pairs(grid, 2),)),
        "DeterminantLoss": (layers.DeterminantLoss(grid), (u,)),
        "DivergenceLoss": (layers.DivergenceLoss(grid), (u,)),
        "CurlLoss": (layers.CurlLoss(grid), (u,)),
        "InverseConsistencyLoss": (layers.InverseConsistencyLoss(grid), (u, -u)),
        "DiceLoss": (layers.DiceLoss(), (image, image)),
        "ssd": (layers.SimilarityLoss("ssd"), (image, image.flip(2))),
        "ncc": (layers.SimilarityLoss("ncc"), (image, image.flip(2))),
    }


def stiff_inside(grid: Grid) -> Weights:
    """Return weights that are parameters and say that the middle keeps its shape."""
    strain = torch.full((1, 1, *[n - 1 for n in grid.shape]), 0.1)
    strain[(..., *[slice(2, -2)] * grid.dim)] = 10.0
    return Weights(strain=nn.Parameter(strain))


@pytest.mark.parametrize("grid", GRIDS, ids=["2D", "3D"])
@pytest.mark.parametrize("name", modules(GRIDS[0]))
def test_compiles_to_one_graph(name, grid):
    """``fullgraph`` raises at a break; values and gradients are those of the module itself."""
    module, inputs = modules(grid)[name]
    torch.compiler.reset()
    compiled = torch.compile(copy.deepcopy(module), fullgraph=True, backend="aot_eager")
    results = []
    for run in (module, compiled):
        given = tuple(t.clone().requires_grad_() for t in inputs)
        value = run(*given)
        value.square().sum().backward()
        results.append((value.detach(), *(t.grad for t in given)))
    for own, other in zip(*results, strict=True):
        assert torch.allclose(own, other, atol=1e-5)


@pytest.mark.parametrize("grid", GRIDS, ids=["2D", "3D"])
@pytest.mark.parametrize("kind", [Pipeline, PredictedWeights])
def test_exports_for_any_batch(kind, grid):
    model = kind(grid).eval()
    program = torch.export.export(model, (pairs(grid, 2),), dynamic_shapes=({0: torch.export.Dim("B")},))
    with torch.no_grad():
        for items in (1, 2, 5):
            assert torch.allclose(program.module()(pairs(grid, items)), model(pairs(grid, items)), atol=1e-5)


@pytest.mark.parametrize("grid", GRIDS, ids=["2D", "3D"])
@pytest.mark.parametrize("kind", [Pipeline, PredictedWeights])
def test_copies_and_saved_states_are_the_same(kind, grid, tmp_path):
    model = kind(grid)
    model(pairs(grid, 1)).sum().backward()  # whatever is kept from a run must not get in the way
    torch.save(model.state_dict(), tmp_path / "state.pt")
    loaded = kind(grid)
    loaded.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model)), loaded):
        assert torch.equal(twin(pairs(grid, 2)), model(pairs(grid, 2)))


def test_every_layer_says_what_it_is():
    grid = GRIDS[0]
    for name, (module, _) in modules(grid).items():
        if name != "Pipeline":
            assert type(module).__doc__
            assert name.split()[0] in repr(module)
    assert "(16, 12)" in repr(layers.RandomDeformation(grid))
    assert "steps=20" in repr(layers.DeformableRegistration(grid))
    for name in layers.__all__:
        assert getattr(layers, name).__doc__, name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("grid", GRIDS, ids=["2D", "3D"])
@pytest.mark.parametrize("kind", [Pipeline, PredictedWeights])
def test_moves_to_a_gpu(kind, grid):
    model = kind(grid)
    here = model(pairs(grid, 2))
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # or the network's convolutions have 10 bits
        there = copy.deepcopy(model).cuda()(pairs(grid, 2).cuda())
        assert torch.allclose(there.cpu(), here, atol=1e-4)
        assert torch.equal(there, copy.deepcopy(model).cuda()(pairs(grid, 2).cuda()))


_DDP = """
import sys, torch, torch.distributed as dist
sys.path.insert(0, sys.argv[1])
from test_nn_pipelines import Pipeline, pairs, GRIDS
dist.init_process_group("gloo")
model = torch.nn.parallel.DistributedDataParallel(Pipeline(GRIDS[0]))
model(pairs(GRIDS[0], 2)[dist.get_rank()][None]).square().mean().backward()
if dist.get_rank() == 0:
    torch.save([p.grad for p in model.module.parameters()], sys.argv[2])
dist.destroy_process_group()
"""


def test_two_processes_find_the_gradient_of_the_whole_batch(root, tmp_path):
    script, result = tmp_path / "ddp.py", tmp_path / "grads.pt"
    script.write_text(_DDP, encoding="utf-8")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    environment = os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, str(script), str(root / "tests" / "project"), str(result)],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    model = Pipeline(GRIDS[0])
    model(pairs(GRIDS[0], 2)).square().mean().backward()
    for own, other in zip(model.parameters(), torch.load(result, weights_only=True), strict=True):
        assert torch.allclose(own.grad, other, atol=1e-6)
