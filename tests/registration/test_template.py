"""Templates: exact maps with a known mean, affine parts, intensities, six warps of one image, copies, errors."""

import math
from dataclasses import replace

import pytest
import torch
from nested_settings import settings_of
from torch import Tensor

from torchdeform.core.derivatives import curl, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.flow import integrate
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine, Displacement, Transform
from torchdeform.core.warp import compose, max_voxels, voxels, warp
from torchdeform.errors import InputError
from torchdeform.registration.template import (
    AveragingSettings,
    Lazy,
    average_intensities,
    average_shape,
    build_template,
    identity_map,
    make_template,
)

GRIDS = [Grid((40, 44), (1.0, 0.9)), Grid((16, 18, 17))]
STILL = settings_of(align="none", steps=(40, 15), length_scale=(24.0, 12.0))


def picture(grid: Grid, waves: float = 1.0) -> Image:
    """A smooth image with structure everywhere, dark at the faces."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.empty(0, dtype=torch.float64))
    values = (torch.cos(waves * (7 * unit + 9 * unit.flip(1) ** 2)).sum(1, keepdim=True) + grid.dim) * 20
    fade = (torch.sin(math.pi * unit).prod(1, keepdim=True) * 3).clamp(max=1)
    return Image((values * fade).float(), grid)


def velocities(grid: Grid, count: int, size: float, seed: int = 0) -> list[Tensor]:
    """Smooth velocities that vanish at the faces and sum to 0, at most ``size`` voxels long."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.empty(0, dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    fields = []
    for _ in range(count):
        v = torch.zeros(1, grid.dim, *grid.shape, dtype=torch.float64)
        for wave in (1, 2):
            shape = torch.sin(math.pi * wave * unit).prod(1, keepdim=True)
            v += shape * torch.randn(1, grid.dim, *[1] * grid.dim, generator=generator, dtype=torch.float64) / wave
        fields.append(v)
    mean = sum(fields) / count
    longest = max(float(max_voxels(v - mean, grid)) for v in fields)
    return [(v - mean) * size / longest for v in fields]


def known(grid: Grid, count: int, size: float) -> tuple[list[Tensor], list[Tensor]]:
    """Maps from images to the template and back, with the identity for their mean as flows."""
    flows = velocities(grid, count, size)
    return [integrate(v, grid, steps=10) for v in flows], [integrate(-v, grid, steps=10) for v in flows]


def exact_maps(reference: Image, k: int, there: list[Tensor], back: list[Tensor]) -> list[Transform]:
    """The maps from image k, which lies at ``there[k]``, to all images."""
    return [Transform.from_displacement(compose(s, there[k], reference.grid), reference) for s in back]


def double(image: Image) -> Image:
    return replace(image, data=image.data.double())


def geometric_bias(maps: list[Transform], grid: Grid) -> float:
    """Root mean square of the mean log determinant and the mean curl of maps."""
    fields = [map_.flatten().field.data for map_ in maps]
    logs = sum(jacobian_determinant(u, grid).log() for u in fields) / len(fields)
    turns = sum(curl(u, grid) for u in fields) / len(fields)
    return float(torch.cat([logs, turns], dim=1).square().mean().sqrt())


@pytest.mark.parametrize("grid", GRIDS)
def test_exact_maps_lead_to_the_known_mean_from_every_reference(grid):
    there, back = known(grid, 4, 3.0)
    reference = double(picture(grid))
    for k in (0, 3):
        shape = average_shape(exact_maps(reference, k, there, back), reference)
        off = float(voxels(shape.displacement - there[k], grid).mean())
        assert off < 0.1 * float(voxels(there[k], grid).mean())  # flows average like maps to first order only
        assert shape.bias[0] > 1
        assert shape.bias[-1] <= AveragingSettings().tolerance
        assert shape.affine is None


@pytest.mark.parametrize("grid", GRIDS)
def test_maps_from_the_template_have_mean_determinant_one_and_mean_curl_zero(grid):
    there, back = known(grid, 3, 3.0)
    reference = double(picture(grid))
    maps = exact_maps(reference, 1, there, back)
    shape = average_shape(maps, reference, AveragingSettings(tolerance=0.0, corrections=5))
    recentred = [shape.recentred(map_) for map_ in maps]
    assert geometric_bias(recentred, grid) < 0.1 * geometric_bias(maps, grid)
    points = grid.points(dtype=torch.float64)[..., ::2]
    for map_, s in zip(recentred, back, strict=True):
        world = reference.to_world(points)
        want = points + s[..., ::2]
        assert float((reference.to_grid(map_.points(world)) - want).norm(dim=1).mean()) < 0.1
        assert float((map_.inverse().points(map_.points(world)) - world).norm(dim=1).mean()) < 0.05


def test_one_correction_only_when_only_one_is_allowed():
    grid = GRIDS[0]
    there, back = known(grid, 3, 3.0)
    reference = double(picture(grid))
    shape = average_shape(exact_maps(reference, 0, there, back), reference, AveragingSettings(corrections=1))
    assert len(shape.bias) == 1
    assert bool((diagnose(shape.displacement, grid).folds == 0).all())


def scaled(reference: Image, factor: float, move: float = 0.0, turn: float = 0.0) -> Transform:
    """A map from the reference's middle: scaled, turned in the plane of the first two world axes, moved."""
    dim = reference.grid.dim
    middle = reference.to_world(torch.tensor(reference.grid.extent, dtype=torch.float64).view(1, -1, 1) / 2)[0, :, 0]
    matrix = torch.eye(dim, dtype=torch.float64)
    matrix[0, 0] = matrix[1, 1] = math.cos(turn)
    matrix[1, 0], matrix[0, 1] = math.sin(turn), -math.sin(turn)
    matrix = factor * matrix
    still = identity_map(reference)
    return Transform((*still.stages, Affine(matrix, middle + move - matrix @ middle)), reference)


@pytest.mark.parametrize("grid", GRIDS)
def test_sizes_are_averaged_about_the_middle_and_the_pose_stays(grid):
    reference = double(picture(grid))
    maps = [scaled(reference, 1.0), scaled(reference, 1.44, move=3.0, turn=0.4)]
    affine = average_shape(maps, reference).affine
    assert affine is not None
    torch.testing.assert_close(affine.matrix, 1.2 * torch.eye(grid.dim, dtype=torch.float64))
    middle = reference.to_world(torch.tensor(grid.extent, dtype=torch.float64).view(1, -1, 1) / 2)
    torch.testing.assert_close(affine(middle), middle)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_mean_pose_has_the_mean_rotation_and_position(grid):
    reference = double(picture(grid))
    maps = [scaled(reference, 1.0), scaled(reference, 1.44, move=3.0, turn=0.4)]
    affine = average_shape(maps, reference, AveragingSettings(pose="mean")).affine
    want = scaled(reference, 1.2, move=1.5, turn=0.2).stages[1]
    assert isinstance(want, Affine)
    assert affine is not None
    torch.testing.assert_close(affine.matrix, want.matrix)
    torch.testing.assert_close(affine.offset, want.offset)


def ratio(found: Tensor, start: Tensor, truth: Tensor) -> float:
    """Squared difference to the truth after, over that before."""
    return float((found - truth).square().sum() / (start - truth).square().sum())


def test_six_warps_of_one_image_give_it_back_in_one_round():
    """The acceptance of the method: root-sum-square over six starts, published 1.114 after one round."""
    grid = Grid((64, 64))
    truth = picture(grid, waves=1.5)
    there, _ = known(grid, 6, 5.0)
    images = [replace(truth, data=warp(truth.data.double(), u, grid).float()) for u in there]
    ratios = []
    for start in images:
        template = build_template(images, STILL, rounds=1, reference=start)
        ratios.append(ratio(template.image.data, start.data, truth.data))
    assert math.hypot(*ratios) <= 0.27


def test_a_volume_and_two_rounds():
    grid = Grid((20, 22, 21))
    truth = picture(grid)
    there, _ = known(grid, 3, 2.0)
    images = [replace(truth, data=warp(truth.data.double(), u, grid).float()) for u in there]
    settings = settings_of(align="none", steps=(25, 10), length_scale=12.0, window=5)
    template = build_template(images, settings, rounds=2)
    assert ratio(template.image.data, images[0].data, truth.data) < 0.3
    for map_, image in zip(template.maps, images, strict=True):
        brought = map_.image(image, template.image)
        assert ratio(brought.data, image.data, truth.data) < 0.6


def test_copies_of_an_image_give_that_image():
    image = picture(GRIDS[0])
    template = build_template([image, image, image], STILL, rounds=2)
    torch.testing.assert_close(template.image.data, image.data, atol=0.05, rtol=0)
    assert template.shape.bias[0] < 0.05


def test_maps_and_images_may_be_lazy():
    grid = GRIDS[0]
    there, back = known(grid, 3, 2.0)
    reference = picture(grid)
    maps, images = exact_maps(reference, 0, there, back), [reference] * 3
    lazy = make_template(Lazy(3, lambda i: images[i]), Lazy(3, lambda i: maps[i]), reference)
    assert torch.equal(lazy.image.data, make_template(images, maps, reference).image.data)
    assert len(lazy.maps) == 3
    assert len(lazy.maps[1:]) == 2
    with pytest.raises(IndexError):
        _ = lazy.maps[3]


def test_brightness_and_contrast_do_not_matter_but_for_their_means():
    image = picture(GRIDS[0])
    one, two = (replace(image, data=image.data * gain + offset) for gain, offset in ((1.0, 0.0), (3.0, 10.0)))
    mean = average_intensities([one, two])
    torch.testing.assert_close(mean.data, image.data * 2 + 5)
    plain = average_intensities([one, two], match=False)
    torch.testing.assert_close(plain.data, image.data * 2 + 5)
    weird = replace(one, data=one.data.roll(5, dims=2))
    assert not torch.allclose(
        average_intensities([weird, two]).data, average_intensities([weird, two], match=False).data
    )


def test_each_node_is_the_mean_of_the_images_that_know_it():
    grid = Grid((8, 9))
    data = torch.full((1, 2, *grid.shape), 3.0)
    one, two = data.clone(), data + 2
    one[..., 0], one[..., 1], two[..., 0] = math.nan, math.nan, math.nan
    mean = average_intensities([Image(one, grid), Image(two, grid)], match=False).data
    assert torch.equal(mean[..., 0], torch.zeros(1, 2, 8))
    assert torch.equal(mean[..., 1], torch.full((1, 2, 8), 5.0))
    assert torch.equal(mean[..., 2], torch.full((1, 2, 8), 4.0))


def test_a_constant_image_does_not_divide_by_zero():
    grid = Grid((8, 9))
    flat = Image(torch.full((1, 1, *grid.shape), 3.0), grid)
    assert bool(average_intensities([flat, flat]).data.isfinite().all())


def test_wrong_input_is_refused():
    image = picture(GRIDS[0])
    other = picture(Grid((12, 13)))
    with pytest.raises(InputError, match="two images and one round at least, got 1 and 3"):
        build_template([image], STILL)
    with pytest.raises(InputError, match="got 2 and 0"):
        build_template([image, image], STILL, rounds=0)
    with pytest.raises(InputError, match="corrections must be at least 1"):
        AveragingSettings(corrections=0)
    with pytest.raises(InputError, match="tolerance must be a number"):
        AveragingSettings(tolerance=math.nan)
    with pytest.raises(InputError, match="pose"):
        AveragingSettings(pose="middle")  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="map 1 must be a displacement on the reference's grid"):
        average_shape([identity_map(image), identity_map(other)], image)
    with pytest.raises(InputError, match="map 0 must be a displacement"):
        average_shape([Transform((Affine.identity(2),))], image)
    with pytest.raises(InputError, match="got 0 maps"):
        average_shape([], image)
    with pytest.raises(InputError, match="agree in grid and channels"):
        average_intensities([image, other])
    with pytest.raises(InputError, match="got none"):
        average_intensities([])


def test_a_recentred_map_keeps_its_inverse_and_its_moving_space():
    image = picture(GRIDS[0])
    shape = average_shape([identity_map(image)] * 2, image)
    map_ = shape.recentred(identity_map(image))
    assert map_.moving is not None
    assert all(isinstance(stage, Displacement) and stage.known_inverse is not None for stage in map_.stages)
