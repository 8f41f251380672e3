"""Registration: recovers known maps, never folds, treats items alike, and says what it did."""

import math
from dataclasses import replace

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import bend, blobs, disc

from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample
from torchdeform.core.warp import compose, max_voxels, warp
from torchdeform.errors import InputError
from torchdeform.registration.deformable import register
from torchdeform.registration.settings import RegistrationSettings

QUICK = settings_of(steps=(30, 30, 20), step_length=0.5, length_scale=6.0, window=7)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("shape", "similarity"), [((64, 80), "lncc"), ((64, 80), "ssd"), ((32, 28, 36), "lncc")])
def test_a_known_map_is_found(shape, similarity, device):
    grid = Grid(shape)
    moving = blobs(shape).to(device)
    truth = bend(grid, 3.0).to(device)
    fixed = warp(moving, truth, grid)
    if similarity == "lncc":
        fixed = 40 * fixed + 11  # another brightness is no obstacle
    result = register(fixed, moving, changed(QUICK, similarity=similarity, steps=(60, 60, 30), tolerance=0.0))
    inside = (..., *[slice(5, -5)] * grid.dim)
    before = truth.square().sum(1).sqrt()[inside].mean()
    after = (result.displacement - truth).square().sum(1).sqrt()[inside].mean()
    assert before > 1
    assert after < 0.25 * before
    assert (result.similarity_after > result.similarity_before).all()


@pytest.mark.parametrize("shape", [(48, 40), (24, 20, 28)])
def test_images_that_have_nothing_in_common_do_not_make_it_fold(shape):
    greedy = settings_of(
        steps=(40, 40, 40), length_scale=2.0, elasticity=0.0, step_length=1.0, similarity="ssd", tolerance=0.0
    )
    result = register(blobs(shape, 1), blobs(shape, 2), greedy)
    assert sum(level.shortened for level in result.levels) > 0  # it had to be held back
    assert result.diagnosis.folds.item() == 0
    assert result.diagnosis.smallest.item() > 0
    assert result.diagnosis.det_min.item() > 0
    again = diagnose(result.displacement, result.grid)
    assert again.folds.item() == 0


def test_the_map_keeps_the_domain_and_its_inverse_undoes_it():
    shape = (48, 56)
    result = register(blobs(shape, 1), blobs(shape, 2), QUICK)
    grid = result.grid
    assert max_voxels(compose(result.displacement, result.inverse, grid), grid).item() < 0.01
    torch.testing.assert_close(
        max_voxels(compose(result.displacement, result.inverse, grid), grid), result.inverse_error_max
    )
    for k, axis in enumerate(grid.axes):
        for end in (0, -1):
            assert result.displacement[:, k].select(axis - 1, end).abs().max() < 1e-4


def test_identical_images_stay_where_they_are():
    image = blobs((40, 40))
    for similarity in ("lncc", "ssd"):
        result = register(image, image, changed(QUICK, similarity=similarity))
        assert result.displacement.abs().mean() < 0.02  # LNCC's floor likes a little more contrast
        assert (result.similarity_after >= result.similarity_before - 1e-6).all()


def test_similarity_never_falls_over_a_level():
    result = register(blobs((64, 64), 1), blobs((64, 64), 2), QUICK)
    levels = [torch.stack(level.similarity).flatten() for level in result.levels]
    assert all(values.max() > values[0] for values in levels)
    assert result.similarity_after.item() == pytest.approx(levels[-1].max().item(), abs=1e-5)


def test_a_batch_equals_its_items_one_by_one_with_a_hard_one_among_them():
    shape = (40, 48)
    moving = blobs(shape, 3, items=3).double()  # steps that are held back amplify rounding
    fixed = warp(moving, bend(Grid(shape), 2.0).double(), Grid(shape))
    fixed[1] = blobs(shape, 9)[0]  # nothing in common
    fixed[2] = moving[2]  # nothing to do
    together = register(fixed, moving, QUICK)
    for item in range(3):
        alone = register(fixed[item : item + 1], moving[item : item + 1], QUICK)
        torch.testing.assert_close(together.displacement[item], alone.displacement[0], rtol=0, atol=1e-3)


def test_the_same_input_gives_the_same_result_bit_for_bit():
    fixed, moving = blobs((40, 40), 1), blobs((40, 40), 2)
    first, second = (register(fixed, moving, QUICK) for _ in range(2))
    assert torch.equal(first.displacement, second.displacement)
    assert torch.equal(first.inverse, second.inverse)


@pytest.mark.parametrize("shape", [(8, 8), (8, 33), (9, 64), (8, 8, 8), (8, 20, 31)])
def test_any_size_from_eight(shape):
    result = register(blobs(shape, 1), blobs(shape, 2), changed(QUICK, steps=(5, 5, 5)))
    assert result.displacement.shape == (1, len(shape), *shape)
    assert result.diagnosis.folds.item() == 0


def test_several_channels_are_used_together():
    shape = (48, 48)
    grid, truth = Grid(shape), bend(Grid(shape), 2.0)
    moving = torch.cat([blobs(shape, 1), torch.zeros(1, 1, *shape), blobs(shape, 2)], dim=1)
    result = register(warp(moving, truth, grid), moving, QUICK)
    assert (result.displacement - truth).abs().mean() < 0.3 * truth.abs().mean()


def test_double_precision_is_kept():
    fixed, moving = blobs((32, 32), 1).double(), blobs((32, 32), 2).double()
    assert register(fixed, moving, changed(QUICK, steps=(3,))).displacement.dtype == torch.float64


def test_the_callback_sees_every_step():
    seen = []
    register(blobs((32, 32), 1), blobs((32, 32), 2), changed(QUICK, steps=(4, 3), tolerance=0.0), callback=seen.append)
    assert [(p.level, p.step) for p in seen] == [(0, i) for i in range(5)] + [(1, i) for i in range(4)]
    assert all(p.levels == 2 and p.similarity.shape == (1,) for p in seen)


def test_stiffness_against_volume_change_keeps_volumes():
    fixed, moving = blobs((48, 48), 1), blobs((48, 48), 2)
    soft, stiff = (register(fixed, moving, changed(QUICK, weight_div=w)) for w in (1.0, 100.0))
    assert stiff.diagnosis.det_log_std.item() < 0.5 * soft.diagnosis.det_log_std.item()


def test_images_are_taken_in_their_physical_place():
    shape, spacing = (40, 48), (1.5, 0.8)
    direction = ((0.8, -0.6), (0.6, 0.8))
    moving = Image(blobs((60, 56), 4), Grid((60, 56), (1.1, 0.9)), (-12.0, -9.0), direction)
    frame = Image(torch.zeros(1, 1, *shape), Grid(shape, spacing), (-8.0, -5.0), direction)
    truth = bend(frame.grid, 2.0)
    fixed = replace(frame, data=resample(moving, frame, truth, outside=None).float())
    result = register(fixed, moving, changed(QUICK, align="none"))
    assert (result.displacement - truth).abs().mean() < 0.3 * truth.abs().mean()
    torch.testing.assert_close(result.warped, resample(moving, fixed, result.displacement, outside="auto").float())


@pytest.mark.parametrize(("outside", "wanted"), [("auto", 200.0), (-7.5, -7.5)])
def test_outside_of_the_moving_image_is_its_paper_or_the_number(outside, wanted):
    data = 200 - 150 * disc((40, 44), (20.0, 24.0), 9.0)
    fixed, moving = Image(data, Grid((40, 44))), Image(data[..., 6:], Grid((40, 38)), (6.0, 0.0))
    result = register(fixed, moving, settings_of(steps=(2,), align="none", outside=outside))
    assert torch.equal(result.warped[..., :5].unique(), torch.tensor([wanted]))
    assert result.warped[..., 7:].min() < 60


@pytest.mark.parametrize(("outside", "message"), [("white", "one of auto"), (math.nan, "outside must be finite")])
def test_outside_is_a_number_or_auto(outside, message):
    with pytest.raises(InputError, match=message):
        RegistrationSettings(outside=outside)


def test_colours_are_registered_and_warped_in_colour():
    grid = Grid((40, 40))
    moving = Image(torch.cat([blobs(grid.shape, s) for s in (1, 2, 3)], dim=1), grid)
    fixed = replace(moving, data=warp(moving.data, bend(grid, 1.5), grid))
    result = register(fixed, moving, changed(QUICK, align="none"))
    assert result.warped.shape == (1, 3, *grid.shape)
    assert (result.warped - fixed.data).abs().mean() < 0.5 * (moving.data - fixed.data).abs().mean()


@pytest.mark.parametrize(
    ("fixed", "moving", "message"),
    [
        (torch.rand(1, 1, 16, 16), torch.rand(1, 1, 16, 17), "moving must have shape"),
        (torch.rand(16, 16), torch.rand(16, 16), "fixed must be a tensor"),
        (torch.rand(1, 1, 16, 16), torch.rand(2, 1, 16, 16), "must agree in batch size"),
        (torch.rand(1, 1, 16, 16), torch.full((1, 1, 16, 16), torch.nan), "NaN or infinite"),
        (torch.rand(1, 1, 16, 16), torch.ones(1, 1, 16, 16), "moving is constant"),
        (torch.rand(1, 1, 16, 16), Image(torch.rand(1, 1, 16, 16), Grid((16, 16))), "not one of each"),
        (torch.ones(1, 1, 16, 16, dtype=torch.int32), torch.rand(1, 1, 16, 16), "floating-point"),
    ],
)
def test_bad_input_is_named(fixed, moving, message):
    with pytest.raises(InputError, match=message):
        register(fixed, moving, QUICK)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("similarity", "lnc"),
        ("window", 4),
        ("window", 1),
        ("steps", ()),
        ("steps", (5, -1)),
        ("order", 3),
        ("length_scale", 0.0),
        ("weight_div", -1.0),
        ("weight_curl", math.inf),
        ("step_length", math.nan),
        ("momentum", -0.1),
        ("momentum", 1.0),
        ("tolerance", -0.1),
        ("soft_determinant", -1.0),
        ("min_determinant", 0.0),
        ("min_determinant", 1.0),
        ("points_weight", -1.0),
        ("points_weight", math.inf),
    ],
)
def test_settings_out_of_range_are_named(setting, value):
    with pytest.raises(InputError, match=setting):
        settings_of(**{setting: value})


@pytest.mark.parametrize("similarity", ["lncc", "ssd"])
def test_momentum_gets_nearer_to_a_known_map_in_as_many_steps(similarity):
    grid = Grid((32, 28, 36))
    moving, truth = blobs(grid.shape), bend(grid, 3.0)
    few = settings_of(steps=(12, 10, 8), length_scale=6.0, window=7, similarity=similarity, tolerance=0.0)
    errors = [
        (register(warp(moving, truth, grid), moving, changed(few, momentum=m)).displacement - truth).norm().item()
        for m in (0.5, 0.0)
    ]
    assert errors[0] < 0.9 * errors[1]


def test_elasticity_keeps_a_map_nearer_to_an_affine_one():
    fixed, moving = blobs((48, 56), 1), blobs((48, 56), 2)
    stiff, soft = (register(fixed, moving, changed(QUICK, elasticity=e)) for e in (0.5, 0.0))
    bends = [result.displacement.diff(n=2, dim=-1).abs().mean().item() for result in (stiff, soft)]
    assert bends[0] < 0.7 * bends[1]


@pytest.mark.parametrize("spacing", [1e-3, 2.5, 1e3])
@pytest.mark.parametrize("shape", [(48, 56), (20, 24, 18)])
def test_the_unit_of_the_spacing_does_not_matter(shape, spacing):
    """Nor near folds, where a divergence is asked for: MIND bends small images most."""
    settings = settings_of(steps=(15, 10), similarity="mind", start="identity", align="none")
    moving, found = blobs(shape, 1), []
    fixed = warp(moving, bend(Grid(shape), 4.0), Grid(shape))
    for h in (1.0, spacing):
        pair = [Image(data, Grid(shape, (h,) * len(shape))) for data in (fixed, moving)]
        found.append(register(*pair, settings))
    assert found[0].diagnosis.smallest < settings.folds.soft_determinant
    torch.testing.assert_close(found[1].displacement / spacing, found[0].displacement, rtol=0, atol=1e-2)
