"""Evidence means the same for every pair: 1 for equal images, 0 for unrelated ones, lengths and shares as built in."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import invert
from torchdeform.registration.evidence import (
    Evidence,
    Views,
    gather_evidence,
    label_contrast,
    otsu,
    to_compare,
    with_labels,
)
from torchdeform.registration.problem import RegistrationProblem

SHAPES = [(60, 70), (22, 26, 24)]


def blobs(shape: tuple[int, ...], seed: int = 0, *, margin: bool = True) -> Tensor:
    """Smooth random structure between 0 and 1, with an empty margin or without."""
    generator = torch.Generator().manual_seed(seed)
    field = torch.rand(1, 1, *[max(3, n // 5) for n in shape], generator=generator)
    mode = {2: "bilinear", 3: "trilinear"}[len(shape)]
    field = torch.nn.functional.interpolate(field, size=shape, mode=mode, align_corners=True)
    inside = torch.ones(1, 1, *shape)
    for axis, n in enumerate(shape, start=2):
        place = torch.arange(n).view([-1 if k == axis else 1 for k in range(2 + len(shape))])
        inside = inside * ((place > n // 8) & (place < n - n // 8))
    return field * inside if margin else field


def evidence(fixed: Tensor, moving: Tensor, u: Tensor | None = None, **more: Tensor) -> Evidence:
    grid = Grid(tuple(fixed.shape[2:]))
    u = torch.zeros(1, grid.dim, *grid.shape) if u is None else u
    masks = {name: more.pop(name) for name in ("fixed_mask", "moving_mask") if name in more}
    problem = to_compare(RegistrationProblem(grid, fixed, moving, **masks))
    (found,) = gather_evidence(problem, u, invert(u, grid), grid, disagreement=torch.tensor([0.25]), **more)
    return found


@pytest.mark.parametrize("shape", SHAPES)
def test_equal_images_score_one_and_unrelated_ones_about_zero(shape):
    fixed, unrelated = (blobs(shape, seed, margin=False) for seed in (0, 5))
    same, other = evidence(fixed, fixed), evidence(fixed, unrelated)
    for name in ("correlation", "information", "foreground"):
        assert getattr(same, name) == pytest.approx(1, abs=1e-3) == getattr(same, f"{name}_before")
        assert getattr(other, name) < 0.7
    assert same.structure_before == pytest.approx(1)
    assert abs(other.information) < 0.2 > abs(other.structure_before)
    assert same.edges == 0 < other.edges
    assert (same.disagreement, same.covered, same.absent, same.extreme, same.turned) == (0.25, 1, 0, 0, ())


@pytest.mark.parametrize("shape", SHAPES)
def test_information_and_structure_do_not_depend_on_the_contrast(shape):
    fixed = blobs(shape)
    other = evidence(fixed, 1 - (2 * fixed - 1).square())  # not monotonic
    assert other.information > 0.5 < other.structure_before
    assert evidence(fixed, 1 - fixed).correlation == pytest.approx(1, abs=1e-3)


def test_edges_are_apart_as_far_as_the_image_was_moved():
    fixed = torch.zeros(1, 1, 80, 80)
    fixed[..., 20:60, 20:60] = 1
    grown = torch.zeros(1, 1, 80, 80)
    grown[..., 17:63, 17:63] = 1
    found = evidence(fixed, grown)
    assert found.edges_before == pytest.approx(3, abs=0.5)
    assert found.foreground_before == pytest.approx(2 * 40**2 / (40**2 + 46**2), abs=0.01)


@pytest.mark.parametrize("factor", [4.0, 1 / 4])
def test_the_share_of_extreme_volumes_is_that_of_the_region_where_they_are(factor):
    """One stripe of four is stretched or squeezed, more than threefold; elsewhere the map is rigid."""
    grid = Grid((80, 60))
    x = torch.arange(80.0)
    moved = torch.where(x < 20, x, torch.where(x < 40, 20 + factor * (x - 20), 20 + 20 * factor + (x - 40)))
    u = torch.zeros(1, 2, *grid.shape)
    u[:, 0] = (moved - x).unsqueeze(1)
    found = evidence(blobs(grid.shape), blobs(grid.shape), u)
    assert found.extreme == pytest.approx(0.25, abs=0.02)


def test_a_part_without_data_is_not_covered():
    fixed = blobs((60, 70))
    mask = torch.ones_like(fixed)
    mask[..., 35:] = 0
    assert evidence(fixed, fixed, moving_mask=mask).covered == pytest.approx(0.5, abs=0.05)
    outside = torch.zeros(1, 2, 60, 70)
    outside[:, 1] = 35  # half of the points leave the image
    assert evidence(fixed, fixed, outside).covered == pytest.approx(0.5, abs=0.05)


def test_an_image_that_was_turned_over_is_found():
    fixed = blobs((60, 70))
    assert evidence(fixed, fixed.flip(3)).turned == ("x",)
    assert evidence(fixed, fixed.flip(2, 3)).turned == ("y", "x")


def test_what_was_let_go_is_a_share_of_what_has_contrast():
    fixed = blobs((60, 70))
    half = torch.zeros_like(fixed)
    half[..., 35:] = 1
    assert evidence(fixed, fixed, absent=half).absent == pytest.approx(0.5, abs=0.05)


def test_a_wrong_inverse_is_measured_in_voxels():
    grid = Grid((60, 70), (2.0, 2.0))
    image, u = blobs(grid.shape), torch.zeros(1, 2, *grid.shape)
    problem = to_compare(RegistrationProblem(grid, image, image))
    shift = torch.full_like(u, 2.0)  # one voxel along both axes
    (found,) = gather_evidence(problem, u, shift, grid, disagreement=torch.zeros(1))
    assert found.inverse_error == pytest.approx(math.sqrt(2), rel=1e-3)


def test_items_of_a_batch_do_not_influence_each_other():
    images = [blobs((40, 44), seed) for seed in (0, 1)]
    grid = Grid((40, 44))
    u, both = torch.zeros(2, 2, *grid.shape), torch.cat(images)
    problem = to_compare(RegistrationProblem(grid, both, both.flip(0)))
    found = gather_evidence(problem, u, u, grid, disagreement=torch.tensor([0.25, 0.25]))
    assert found[0] == evidence(images[0], images[1])
    assert found[1] == evidence(images[1], images[0])


def test_images_without_anything_in_common_have_evidence():
    fixed = blobs((40, 44))
    apart = torch.zeros_like(fixed)
    apart[..., 0, 0] = 1
    found = evidence(fixed, fixed, moving_mask=apart)
    assert found.covered < 0.1
    assert found.correlation == 0
    nothing = evidence(fixed, fixed, moving_mask=torch.zeros_like(fixed))
    assert (nothing.covered, nothing.information, nothing.structure_before) == (0, 0, 0)
    assert (nothing.foreground, nothing.edges) == (0, math.inf)
    assert evidence(torch.zeros_like(fixed) + 0.5, fixed).information == pytest.approx(0, abs=1e-6)


def test_labels_explain_their_own_image():
    region = torch.zeros(1, 1, 60, 70)
    region[..., 20:35, 20:40] = 3
    image = 0.2 * blobs((60, 70)) + (region > 0)
    assert label_contrast(image, region) > 0.9
    assert label_contrast(image, region.roll(20, 3)) < 0.5
    (found,) = with_labels((evidence(image, image),), (image, image), (region, region.roll(20, 3)))
    assert found.label_contrast == (label_contrast(image, region), label_contrast(image, region.roll(20, 3)))
    assert math.isnan(label_contrast(image, torch.zeros_like(region)))


def test_otsu_parts_two_peaks():
    values = torch.cat([torch.full((300,), 0.2), torch.full((100,), 0.8)]) + 0.01 * torch.randn(400)
    assert int((values > otsu(values)).sum()) == 100


def test_pushed_images_are_rolled_with_their_weights():
    image = blobs((40, 44))
    views = replace(Views.of(RegistrationProblem(Grid((40, 44)), image, image)), moving_weight=image)
    assert all(torch.equal(pushed.moving, pushed.moving_weight) for pushed in views.pushed())
