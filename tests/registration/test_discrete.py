"""The discrete start on motion that is known, many times larger than what moves."""

import math

import pytest
import torch
from pictures import swell
from torch import Tensor

import torchdeform as td
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.warp import voxels, warp
from torchdeform.errors import InputError
from torchdeform.registration.discrete import DiscreteSettings, discrete_start

# Shape, spacing, and a reach for a motion of 12 voxels.
CASES = [
    pytest.param((96, 112), (1.0, 1.0), id="2D"),
    pytest.param((48, 44, 52), (1.0, 1.0, 1.0), id="3D"),
    pytest.param((30, 52, 48), (2.5, 1.4, 1.4), id="thick slices"),
]
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
QUICK = DiscreteSettings(reach=(14.0, 4.0))


def spots(grid: Grid, seed: int = 0) -> Tensor:
    """Return thin structures, noise of wavelengths around 6 voxels: 12 voxels away are others that look much alike."""
    noise = torch.randn(1, 1, *grid.shape, generator=torch.Generator().manual_seed(seed))
    axes = [torch.fft.fftfreq(n) for n in grid.shape]
    frequency = torch.stack(torch.meshgrid(*axes, indexing="ij")).square().sum(0).sqrt()
    ring = torch.exp(-(((frequency - 0.16) / 0.05) ** 2))
    image = torch.fft.ifftn(torch.fft.fftn(noise, dim=grid.axes) * ring, dim=grid.axes).real
    return image / image.std()


def moved_pair(shape: tuple[int, ...], spacing: tuple[float, ...], largest: float = 12.0, seed: int = 0):
    """Return fixed, moving, grid and the displacement: fixed(x) = moving(x + u(x))."""
    grid = Grid(shape, spacing)
    moving, u = spots(grid, seed), swell(grid, largest)
    return warp(moving, u, grid), moving, grid, u


def mean_error(u: Tensor, truth: Tensor, grid: Grid) -> float:
    """Mean distance in voxels of the finest spacing, two nodes from the faces."""
    inner = (..., *(slice(2, -2) for _ in grid.shape))
    return float((u - truth)[inner].square().sum(1).sqrt().mean() / min(grid.spacing))


@pytest.mark.parametrize(("shape", "spacing"), CASES)
def test_thin_structures_are_found_far_away_without_a_fold(shape, spacing):
    fixed, moving, grid, truth = moved_pair(shape, spacing)
    u = discrete_start(fixed, moving, grid, settings=QUICK)
    assert mean_error(u, truth, grid) < 0.4 * mean_error(torch.zeros_like(truth), truth, grid)
    found = diagnose(u, grid)
    assert found.folds.item() == 0
    assert found.smallest.item() >= QUICK.min_determinant


def test_registration_alone_stays_in_a_wrong_place_and_succeeds_after_the_start():
    fixed, moving, grid, truth = moved_pair((96, 112), (1.0, 1.0))
    alone = td.register(fixed, moving)
    started = td.register(fixed, moving, start=discrete_start(fixed, moving, grid, settings=QUICK))
    assert mean_error(alone.displacement, truth, grid) > 1.0
    assert mean_error(started.displacement, truth, grid) < 0.1
    assert started.diagnosis.folds.item() == 0


@pytest.mark.parametrize(("shape", "spacing"), CASES)
def test_contrast_does_not_matter(shape, spacing):
    fixed, moving, grid, _ = moved_pair(shape, spacing)
    u = discrete_start(fixed, moving, grid, settings=QUICK)
    again = discrete_start(10 - 3 * fixed, moving, grid, settings=QUICK)
    assert voxels(again - u, grid).mean() < 0.05


@pytest.mark.parametrize(("shape", "spacing"), CASES)
def test_identical_and_flat_images_stay_where_they_are(shape, spacing):
    grid = Grid(shape, spacing)
    image = spots(grid)
    assert voxels(discrete_start(image, image, grid, settings=QUICK), grid).max() < 0.1
    flat = torch.full_like(image, 0.3)
    assert voxels(discrete_start(flat, flat, grid, settings=QUICK), grid).max() < 0.1
    assert discrete_start(flat, image, grid, settings=QUICK).isfinite().all()


@pytest.mark.parametrize(("shape", "spacing"), CASES[:2])
def test_a_batch_equals_its_items_and_runs_repeat(shape, spacing):
    pairs = [moved_pair(shape, spacing, largest, seed) for seed, largest in enumerate((0.0, 12.0))]
    fixed, moving = (torch.cat([pair[i] for pair in pairs]) for i in range(2))
    grid = pairs[0][2]
    mask = torch.ones(2, 1, *shape)
    mask[1, 0, :20] = 0
    together = discrete_start(fixed, moving, grid, mask=mask, settings=QUICK)
    for k in range(2):
        items = fixed[k : k + 1], moving[k : k + 1]
        alone = discrete_start(*items, grid, mask=mask[k : k + 1], settings=QUICK)
        # Rounding only: another choice for one cell of the search would show as a good part of a voxel.
        torch.testing.assert_close(together[k : k + 1], alone, rtol=0, atol=1e-3)
        assert torch.equal(alone, discrete_start(*items, grid, mask=mask[k : k + 1], settings=QUICK))


@pytest.mark.parametrize(("shape", "spacing"), CASES[:2])
def test_what_the_mask_leaves_out_has_no_say(shape, spacing):
    fixed, moving, grid, truth = moved_pair(shape, spacing)
    mask = torch.ones_like(fixed)
    mask[:, :, : shape[0] // 3] = 0
    misleading = torch.where(mask > 0, fixed, spots(grid, seed=9))
    u = discrete_start(misleading, moving, grid, mask=mask, settings=QUICK)
    inside = (..., slice(shape[0] // 3 + 4, None), *(slice(None) for _ in shape[1:]))
    plain = discrete_start(misleading, moving, grid, settings=QUICK)
    difference = [voxels(w - truth, grid)[inside].mean() / min(spacing) for w in (u, plain)]
    assert difference[0] < 0.5 * voxels(truth, grid)[inside].mean() / min(spacing)
    assert difference[0] < difference[1]


def test_units_are_those_of_the_spacing():
    fixed, moving, grid, _ = moved_pair((64, 72), (1.0, 1.0))
    wide = Grid(grid.shape, (3.0, 3.0))
    u, scaled = (discrete_start(fixed, moving, g, settings=QUICK) for g in (grid, wide))
    torch.testing.assert_close(scaled, 3 * u, rtol=1e-3, atol=1e-2)


def test_one_direction_and_other_levels_work_as_well():
    fixed, moving, grid, truth = moved_pair((96, 112), (1.0, 1.0))
    for settings in (
        DiscreteSettings(reach=(14.0, 4.0), symmetric=False),
        DiscreteSettings(levels=(3, 2, 1), reach=(16.0, 6.0, 4.0)),
        DiscreteSettings(levels=(1,), reach=(14.0,)),
    ):
        u = discrete_start(fixed, moving, grid, settings=settings)
        assert mean_error(u, truth, grid) < 0.6 * mean_error(torch.zeros_like(truth), truth, grid)
        assert diagnose(u, grid).folds.item() == 0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_device_and_type_are_kept(device, dtype):
    grid = Grid((24, 28))
    image = spots(grid).to(device, dtype)
    u = discrete_start(image, image.roll(2, dims=3), grid, settings=QUICK)
    assert (u.dtype, u.device.type) == (dtype, device)


IMAGE = torch.rand(2, 1, 16, 18)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fixed": IMAGE[:, :, :10]}, "fixed must have shape"),
        ({"moving": IMAGE.expand(2, 2, 16, 18)}, "moving must have shape"),
        ({"moving": IMAGE[:1]}, "agree in batch size"),
        ({"moving": IMAGE.double()}, "agree in batch size"),
        ({"moving": torch.full_like(IMAGE, math.nan)}, "moving has values that are NaN or infinite"),
        ({"mask": torch.ones(2, 2, 16, 18)}, "mask must have shape"),
        ({"mask": torch.ones(3, 1, 16, 18)}, "mask must have shape"),
    ],
)
def test_bad_input_is_named(change, message):
    given = {"fixed": IMAGE, "moving": IMAGE, "mask": None} | change
    with pytest.raises(InputError, match=message):
        discrete_start(given["fixed"], given["moving"], Grid((16, 18)), mask=given["mask"])


def test_searches_that_are_too_wide_are_refused():
    image = torch.rand(1, 1, 40, 40, 40)
    with pytest.raises(InputError, match="lower reach, or search on a coarser level"):
        discrete_start(image, image, Grid((40, 40, 40)), settings=DiscreteSettings(levels=(0,), reach=(60.0,)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"levels": (), "reach": ()}, "one entry each"),
        ({"levels": (2, 1), "reach": (20.0,)}, "one entry each"),
        ({"levels": (1, 2)}, "from coarse to fine"),
        ({"levels": (1, -1)}, "must not be negative"),
        ({"reach": (20.0, 0.0)}, "reach must be positive"),
        ({"spacing": 0.5}, "spacing must be at least 1"),
        ({"smoothing": 0.0}, "smoothing must be positive"),
        ({"coupling": ()}, "at least one price"),
        ({"coupling": (0.1, -1.0)}, "coupling must be positive"),
        ({"length_scale": math.inf}, "length_scale must be positive and finite"),
        ({"min_determinant": 1.0}, "between 0 and 1"),
    ],
)
def test_settings_out_of_range_are_named(change, message):
    with pytest.raises(InputError, match=message):
        DiscreteSettings(**change)
