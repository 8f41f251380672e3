"""The types and devices of results are those of the inputs, whatever torch's defaults are."""

import ast
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import torchdeform as td
from torchdeform import nn as layers

GRIDS = [td.Grid((24, 20)), td.Grid((12, 14, 13))]
QUICK = replace(td.RegistrationSettings(), optimiser=replace(td.RegistrationSettings().optimiser, steps=(4, 3)))
NEAR = td.DiscreteSettings(levels=(1,), reach=(4.0,))

# Functions that make a tensor from nothing.
FACTORIES = {"zeros", "ones", "tensor", "eye", "linspace", "arange", "full", "empty", "rand", "randn", "randint"}
LAYERS = ("core", "solvers", "fem", "metrics", "deformation", "nn", "registration")


def _factory_calls(root: Path) -> Iterator[tuple[str, str, set[str | None]]]:
    for layer in LAYERS:
        for path in sorted((root / "torchdeform" / layer).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                    continue
                if isinstance(node.func.value, ast.Name) and node.func.value.id == "torch":
                    place = f"{path.name}:{node.lineno}"
                    yield place, node.func.attr, {keyword.arg for keyword in node.keywords}


def test_every_new_tensor_says_its_type_and_device(root):
    """A default of the caller's must not decide. Whole numbers of `arange` and `tensor` are the same everywhere."""
    vague = [
        (place, name)
        for place, name, given in _factory_calls(root)
        if name in FACTORIES and None not in given
        if "device" not in given or ("dtype" not in given and name not in ("arange", "tensor"))
    ]
    assert not vague


def _waves(grid: td.Grid, shift: float = 0.0) -> Tensor:
    points = grid.points() + shift
    return (torch.sin(0.5 * points).sum(1, keepdim=True) + torch.cos(0.3 * points).prod(1, keepdim=True)) / 4 + 1


def _moved_points(grid: td.Grid) -> td.Annotations:
    some = grid.points().flatten(2)[..., ::17]
    return td.Annotations(fixed_points=some, moving_points=some + 0.2)


def _affine(alignment: td.Alignment) -> Tensor:
    return torch.cat([alignment.affine.matrix.flatten(), alignment.affine.offset])


def _calls(grid: td.Grid) -> dict[str, Callable[[], Tensor]]:
    fixed, moving = _waves(grid), _waves(grid, 0.4)
    images = td.Image(fixed, grid), td.Image(moving, grid)
    labels = (fixed > 1).long()
    rigid = torch.zeros_like(fixed, dtype=torch.bool)
    rigid[..., :3] = True
    u = 0.3 * torch.sin(grid.points() / 4)
    marks = replace(QUICK, points_weight=0.1)
    weights = td.Weights(curl=0.0, zero=0.1, strain=labels[(..., *[slice(1, None)] * grid.dim)] + 0.5)
    generator = torch.Generator("cpu").manual_seed(1)
    return {
        "register": lambda: td.register(fixed, moving, QUICK).displacement,
        "register images": lambda: td.register(*images, QUICK).displacement,
        "landmarks": lambda: td.register(fixed, moving, marks, annotations=_moved_points(grid)).displacement,
        "symmetric": lambda: td.register(fixed, moving, replace(QUICK, symmetric=True)).displacement,
        "align": lambda: _affine(td.align(*images, "affine")),
        "discrete": lambda: td.discrete_start(fixed, moving, grid, settings=NEAR),
        "keypoints": lambda: td.keypoint_start(fixed, moving, grid)[0],
        "template": lambda: td.build_template(images, QUICK, rounds=1).image.data,
        "version 1": lambda: td.grid_from_initial_monitor(fixed, grid),
        "version 2": lambda: td.grid_from_target_monitor(fixed, grid, moving),
        "version 3": lambda: td.track_moving_monitor(lambda t: 1 + t * fixed, grid, [0.0, 1.0]),
        "volumes": lambda: td.simulate_volume_change(labels, {1: 0.95}, grid).value,
        "volumes, rigid": lambda: td.simulate_volume_change(labels * ~rigid, {1: 0.95}, grid, rigid_mask=rigid).value,
        "rigid label": lambda: td.hold_rigid(u, rigid, grid),
        "incompressible label": lambda: td.hold_volume(u, labels == 1, grid, still=rigid),
        "label fit": lambda: torch.cat(td.label_fit(u, rigid, grid)),
        "slip": lambda: td.from_jacobian_and_curl(fixed, td.curl(0 * u, grid), grid, boundary="slip").value,
        "average": lambda: td.average_maps([0.1 * u, -0.1 * u], grid).value,
        "monitors": lambda: td.gradient_monitor(fixed, grid) + td.curvature_monitor(fixed, grid),
        "solve": lambda: td.solve_div_curl(fixed, None, grid).value,
        "assembled": lambda: td.solve_div_curl(fixed, None, grid, solver="assembled").value,
        "inverse": lambda: td.invert(u, grid),
        "transform": lambda: td.Transform.from_displacement(u, images[0]).image(images[1]).data,
        "similarities": lambda: torch.stack([
            layers.SimilarityLoss(name)(fixed, moving) for name in ("ssd", "ncc", "lncc", "mi", "nmi", "ngf", "mind")
        ]),
        "layer": lambda: layers.DeformableRegistration(grid, steps=2)(fixed, moving),
        "weights": lambda: layers.DivCurlVelocity(grid, weights=weights)(fixed),
        "augmentation": lambda: layers.RandomDeformation(grid)(fixed, generator=generator),
    }  # fmt: skip


@pytest.fixture(params=["dtype", "device"])
def other_default(request) -> Iterator[Callable[[], None]]:
    """Return what sets another default, which must not be seen in any result; meta tensors hold no numbers at all."""
    sets = {"dtype": lambda: torch.set_default_dtype(torch.float64), "device": lambda: torch.set_default_device("meta")}
    yield sets[request.param]
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)


@pytest.mark.parametrize("name", _calls(GRIDS[0]))
@pytest.mark.parametrize("grid", GRIDS, ids=["2D", "3D"])
def test_results_do_not_follow_the_defaults(grid, name, other_default):
    torch.manual_seed(0)
    expected = _calls(grid)[name]()
    call = _calls(grid)[name]
    other_default()
    found = call()
    assert (found.dtype, found.device) == (expected.dtype, expected.device)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["register", "align", "volumes", "solve"])
def test_two_runs_give_the_same_bits(name):
    """On one device with one number of threads, as the conventions say."""
    assert torch.equal(_calls(GRIDS[0])[name](), _calls(GRIDS[0])[name]())


def test_float64_goes_through(other_default):
    """With float64 inputs all is float64, and near what float32 gives."""
    fixed, moving = (_waves(GRIDS[0], shift) for shift in (0.0, 0.4))
    expected = td.register(fixed, moving, QUICK).displacement
    wide = fixed.double(), moving.double()
    other_default()
    found = td.register(*wide, QUICK).displacement
    assert found.dtype == torch.float64
    torch.testing.assert_close(found.to(torch.float32), expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("name", ["warp", "compose", "invert", "integrate", "solve", "register", "monitor", "points"])
def test_few_bits_are_refused_in_one_sentence(name, dtype):
    grid = GRIDS[0]
    image, u = _waves(grid).to(dtype), torch.zeros(1, 2, *grid.shape, dtype=dtype)
    calls = {
        "warp": lambda: td.warp(image, u.float(), grid),
        "compose": lambda: td.compose(u, u.float(), grid),
        "invert": lambda: td.invert(u, grid),
        "integrate": lambda: td.integrate(u, grid),
        "solve": lambda: td.solve_div_curl(image, None, grid),
        "register": lambda: td.register(image, image, QUICK),
        "monitor": lambda: td.grid_from_initial_monitor(image, grid),
        "points": lambda: td.Transform((td.Affine.identity(2),)).points(u.flatten(2)),
    }
    with pytest.raises(td.InputError, match=rf"of 32 or 64 bits, got {dtype}; convert it with \.float\(\)"):
        calls[name]()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_layers_widen_few_bits(dtype):
    grid = GRIDS[0]
    image, u = _waves(grid).to(dtype), (0.4 * torch.sin(grid.points() / 4)).to(dtype)
    moved = layers.SpatialTransformer(grid)(image, u)
    assert moved.dtype == dtype
    expected = td.warp(image.float(), u.float(), grid)
    torch.testing.assert_close(moved.float(), expected, rtol=0, atol=2 * math.ulp(1.0) + torch.finfo(dtype).eps * 2)
    assert layers.FlowIntegrator(grid)(u).isfinite().all()
    assert layers.DivCurlVelocity(grid)(image).dtype == torch.float32
