"""Registration with tissue: bars turn and stay as they are, a ball keeps its volume, and what does not fit is named."""

from dataclasses import replace

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import bend, blobs
from tissues import BARS, growing_ball, kabsch_residual, turning_bars
from torch import Tensor

from torchdeform.core.diagnostics import diagnose, inverse_error
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.resampling import restrict
from torchdeform.core.warp import warp
from torchdeform.errors import InputError
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.deformable import register, resample_result

QUICK = settings_of(steps=(20, 15, 8), window=7)


def as_image(values: Tensor, spacing: float = 1.0, **place) -> Image:
    grid = Grid(tuple(values.shape[2:]), (spacing,) * (values.dim() - 2))
    return Image(values, grid, **place)


def away_from_rigid(result, labels: Tensor) -> list[float]:
    return [kabsch_residual(result.displacement[0], labels[0, 0] == number) for number in (1, 2)]


@pytest.mark.parametrize("dim", [2, 3])
def test_bars_that_turn_stay_as_they_are(dim):
    fixed, moving, labels = turning_bars(dim)
    settings = changed(QUICK, tissues=BARS)
    result = register(fixed, moving, settings, annotations=Annotations(tissue=labels))
    free = register(fixed, moving, QUICK)
    assert max(away_from_rigid(result, labels)) < 0.05 < 0.2 < max(away_from_rigid(free, labels))
    assert result.diagnosis.folds.item() == 0
    assert result.similarity_after > result.similarity_before + 0.7 * (free.similarity_after - free.similarity_before)
    assert [(one.label, one.kind, one.sliding) for one in result.tissue] == [(1, "rigid", False), (2, "rigid", False)]
    for one in result.tissue:
        assert one.nodes.tolist() == [int((labels == one.label).sum())]
        assert float(one.after.residual) < 0.05
        assert abs(float(one.after.volume) - 1) < 1e-3


@pytest.mark.parametrize("dim", [2, 3])
def test_a_ball_that_looks_larger_keeps_its_volume(dim):
    fixed, moving, labels = growing_ball(dim)
    settings = changed(QUICK, tissues={1: "incompressible"})
    (ball,) = register(fixed, moving, settings, annotations=Annotations(tissue=labels)).tissue
    (free,) = register(
        fixed, moving, changed(QUICK, tissues={1: "free"}), annotations=Annotations(tissue=labels)
    ).tissue
    assert abs(float(ball.after.volume) - 1) < 0.003
    assert float(ball.after.off) < 0.01
    assert float(free.after.volume) > 1.1


def test_without_tissue_nothing_changes():
    fixed, moving = blobs((40, 44), 1), blobs((40, 44), 2)
    plain, empty = register(fixed, moving, QUICK), register(fixed, moving, changed(QUICK, tissues={}, sliding=()))
    assert torch.equal(plain.displacement, empty.displacement)
    assert plain.tissue == empty.tissue == ()


def test_free_tissue_is_registered_as_without():
    """Only the solver differs: its least squares are solved to a share of the load."""
    fixed, moving, labels = growing_ball()
    free = register(fixed, moving, changed(QUICK, tissues={1: "free"}), annotations=Annotations(tissue=labels))
    plain = register(fixed, moving, QUICK)
    assert (free.displacement - plain.displacement).abs().mean() < 0.05


def test_images_and_tissue_may_have_grids_of_their_own():
    fixed, moving, labels = turning_bars()
    tissue = Image(labels[:, :, ::2, ::2], Grid((32, 32), (4.0, 4.0)))
    images = as_image(fixed, 2.0), as_image(moving, 2.0)
    settings = changed(QUICK, tissues=BARS, align="affine")
    result = register(*images, settings, annotations=Annotations(tissue=tissue))
    assert result.alignment is not None
    turn = result.affine.matrix.double().cpu()
    torch.testing.assert_close(turn @ turn.mT, torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-4)
    assert result.settings.align.kind == "rigid"
    assert max(float(one.after.residual) for one in result.tissue) < 0.05
    assert all(abs(int(one.nodes) - int((labels == one.label).sum())) < 60 for one in result.tissue)
    assert result.diagnosis.folds.item() == 0


@pytest.mark.parametrize("many", [1, 2])
def test_a_batch_may_share_its_tissue_or_not(many):
    fixed, moving, labels = turning_bars()
    other = labels.clone()
    other[other == 2] = 0
    tissue = torch.cat([labels, other])[:many]
    pair = torch.cat([fixed, fixed]), torch.cat([moving, moving])
    result = register(*pair, changed(QUICK, tissues=BARS), annotations=Annotations(tissue=tissue))
    residuals = [[kabsch_residual(u, labels[0, 0] == number) for number in (1, 2)] for u in result.displacement]
    assert max(residuals[0]) < 0.05
    assert residuals[1][0] < 0.05
    assert (residuals[1][1] < 0.05) == (many == 1)
    assert bool(result.tissue[1].after.residual.isnan()[1]) == (many == 2)
    assert not result.diagnosis.folds.any()


def test_tissue_that_does_not_fit_its_settings_is_named():
    fixed, moving, labels = turning_bars()
    given = Annotations(tissue=labels)
    with pytest.raises(InputError, match="the settings tissues or sliding is not given"):
        register(fixed, moving, QUICK, annotations=given)
    with pytest.raises(InputError, match=r"annotations\.tissue is not given"):
        register(fixed, moving, changed(QUICK, tissues=BARS))
    with pytest.raises(InputError, match="symmetric and tissue exclude each other"):
        register(fixed, moving, changed(QUICK, tissues=BARS, symmetric=True), annotations=given)
    with pytest.raises(InputError, match="no voxel has the label 7"):
        register(fixed, moving, changed(QUICK, tissues={7: "rigid"}), annotations=given)
    with pytest.raises(InputError, match="tissue must"):
        register(fixed, moving, changed(QUICK, tissues=BARS), annotations=Annotations(tissue=labels[..., :-1]))
    with pytest.raises(InputError, match="tissue must be an Image"):
        register(as_image(fixed), as_image(moving), changed(QUICK, tissues=BARS), annotations=given)


@pytest.mark.parametrize("kind", ["rigid", "incompressible"])
def test_on_a_finer_grid_tissue_is_kept_as_well(kind):
    fixed, moving, labels = (as_image(part) for part in (turning_bars() if kind == "rigid" else growing_ball()))
    n = fixed.grid.shape[0]
    coarse = Grid((n // 2 + 1,) * 2, ((n - 1) / (n // 2),) * 2)
    small = replace(fixed, data=restrict(fixed.data, fixed.grid, coarse), grid=coarse)
    annotations = Annotations(tissue=labels)
    settings = changed(QUICK, tissues={1: kind}, align="none")
    found = register(small, moving, settings, annotations=annotations)
    result = resample_result(found, fixed, moving, annotations)
    (one,) = result.tissue
    assert int(one.nodes) == int((labels.data == 1).sum())
    assert float(one.after.off) < 0.01
    assert kind != "rigid" or kabsch_residual(result.displacement[0], labels.data[0, 0] == 1) < 0.05
    assert result.diagnosis.folds.item() == 0
    assert float(inverse_error(result.displacement, result.inverse, fixed.grid)[1]) < 0.2


@pytest.mark.parametrize("settings", [{"tissues": {1: "rigid"}}, {"tissues": {1: "incompressible"}}, {"sliding": (1,)}])
def test_nothing_is_moved_across_a_few_slices_whatever_they_are_made_of(settings):
    shape, labels = (5, 40, 44), torch.zeros(1, 1, 5, 40, 44)
    labels[:, :, 1:4, 10:25, 10:30] = 1
    u = torch.cat([torch.zeros(1, 1, 40, 44), bend(Grid(shape[1:]), 2.0)], dim=1).unsqueeze(2).expand(1, 3, *shape)
    moving = blobs((40, 44), 1).unsqueeze(2) + 0.3 * blobs(shape, 4)
    fixed = warp(moving, u, Grid(shape))
    chosen = changed(QUICK, steps=(8, 6), **settings)
    result = register(fixed, moving, chosen, annotations=Annotations(tissue=labels))
    assert not result.displacement[:, 0].any()
    assert not result.diagnosis.folds.any()
    (one,) = result.tissue
    assert one.kind != "rigid" or float(one.after.residual) < 0.05
    assert one.kind != "incompressible" or float(one.after.off) < 0.01


def test_items_may_lack_all_that_is_dear():
    fixed, moving, labels = (torch.cat([part, part]) for part in turning_bars())
    labels[1] = 0
    result = register(fixed, moving, changed(QUICK, tissues=BARS), annotations=Annotations(tissue=labels))
    assert max(away_from_rigid(result, labels)) < 0.05
    assert not result.diagnosis.folds.any()


def test_a_start_that_bends_what_is_rigid_ends_rigid_and_without_folds():
    fixed, _, labels = turning_bars()
    start = bend(Grid((64, 64)), 4.0)
    settings = changed(QUICK, tissues=BARS, steps=(0,))
    result = register(fixed, fixed, settings, annotations=Annotations(tissue=labels), start=start)
    assert max(away_from_rigid(result, labels)) < 0.05
    assert int(diagnose(result.displacement, result.grid).folds) == 0
