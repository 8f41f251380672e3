"""The phantoms of tissue are what they say, and the figures of the benchmark are right on maps that are known."""

import math
from importlib import import_module

import pytest
import torch

import torchdeform as td


@pytest.fixture
def benchmark(root, monkeypatch):
    pytest.importorskip("scipy")
    monkeypatch.syspath_prepend(str(root / "scripts"))
    return import_module("tissue")


@pytest.mark.parametrize("kind", ["bones", "lesion"])
def test_true_maps_do_not_fold_and_show_the_fixed_image_again(benchmark, kind):
    phantom = getattr(benchmark, kind)(2, 3)
    assert int(td.diagnose(phantom.truth, phantom.grid).folds) == 0
    before, after = (
        (image - phantom.fixed)[phantom.tissue == 0].square().mean()
        for image in (phantom.moving, td.warp(phantom.moving, phantom.truth, phantom.grid))
    )
    assert after < before / 5


def test_bones_move_rigidly_by_the_angles_named(benchmark):
    phantom = benchmark.bones(2, 3)
    figures = benchmark.bone_figures(phantom, phantom.truth)
    assert figures["residual femur"] < 1e-4
    assert figures["residual tibia"] < 1e-4
    assert figures["landmarks, max"] == 0
    gradient = torch.stack(torch.gradient(phantom.truth[0, 0].double(), dim=(0, 1)))
    for label, angle in ((1, 20), (2, -10)):
        inside = phantom.tissue[0, 0] == label
        # d(u_0)/dx_1 of a rotation is −sin; the median leaves out the border.
        assert float(gradient[1][inside].median()) == pytest.approx(-math.sin(math.radians(angle)), abs=1e-3)


def test_a_seed_is_one_phantom_and_another_is_another(benchmark):
    first, again, other = (benchmark.blocks(2, seed) for seed in (1, 1, 2))
    assert torch.equal(first.moving, again.moving)
    assert not torch.equal(first.moving, other.moving)


@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_not_rigid_is_measured(benchmark, dim):
    points = torch.rand(dim, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 20
    turn = torch.linalg.qr(torch.randn(dim, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(2)))[0]
    turn[:, 0] *= torch.linalg.det(turn)
    moved = turn @ points + 3
    assert benchmark.rigid_residual(points, moved) < 1e-12
    assert benchmark.rigid_residual(points, 1.1 * moved) > 0.5


def test_a_lesion_that_grows_is_measured(benchmark):
    phantom = benchmark.lesion(2, 3)
    middle = torch.tensor([n - 1 for n in phantom.grid.shape]).view(1, 2, 1, 1) / 2
    figures = benchmark.lesion_figures(phantom, 0.05 * (phantom.grid.points() - middle))
    assert figures["volume, %"] == pytest.approx(100 * (1.05**2 - 1), abs=1e-3)
    assert abs(benchmark.lesion_figures(phantom, phantom.truth)["volume, %"]) < 0.01


@pytest.mark.parametrize("shape", ["flat", "slanted", "curved"])
def test_blocks_slide_by_six_voxels(benchmark, shape):
    phantom = benchmark.blocks(2, 3, shape)
    assert benchmark.sliding_figures(phantom, phantom.truth)["max"] == 0
    still = benchmark.sliding_figures(phantom, torch.zeros_like(phantom.truth))
    assert still["error, mean"] == pytest.approx(3, abs=0.1)  # each block moves by half
