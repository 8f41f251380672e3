"""Features and labels that are compared: what they are, the force they ask for, and what they find."""

import math
from dataclasses import replace

import pytest
import torch
from nested_settings import changed, settings_of
from pictures import bend, blobs, disc
from programs import network
from tissues import sliding_blocks
from torch import Tensor, nn

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample
from torchdeform.core.resampling import coarsened
from torchdeform.core.transform import Affine
from torchdeform.core.warp import compose, voxels, warp
from torchdeform.errors import InputError
from torchdeform.metrics.evaluation import dice
from torchdeform.metrics.mind import mind_ssc
from torchdeform.registration import channels as made
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.channels import count_features, run_program, with_channels
from torchdeform.registration.deformable import register
from torchdeform.registration.objective import forward_objective
from torchdeform.registration.problem import Channels, RegistrationProblem, moved
from torchdeform.registration.symmetric import symmetric_objective

QUICK = settings_of(steps=(20, 15, 10), window=7, align="none", start="identity")
SHAPES = [(60, 72), (24, 26, 28)]


def pair(shape: tuple[int, ...], amplitude: float = 3.0) -> tuple[Tensor, Tensor, Tensor, Grid]:
    """Return a bent image, the image, and the true map."""
    grid, moving = Grid(shape), blobs(shape, 1)
    u = bend(grid, amplitude)
    return warp(moving, u, grid), moving, u, grid


def quarters(shape: tuple[int, ...]) -> Tensor:
    """Return labels 1 to 4 of the quarters of a ball, 0 outside."""
    x = Grid(shape).points()
    quarter = 1 + (x[:, :1] > shape[0] / 2).float() + 2 * (x[:, 1:2] > shape[1] / 2).float()
    return quarter * disc(shape, tuple((n - 1) / 2 for n in shape), 0.38 * min(shape))


@pytest.mark.parametrize("shape", [(150, 90), (70, 40, 50)])
def test_in_tiles_a_program_gives_what_it_gives_in_one(monkeypatch, shape):
    net, images = network(len(shape), width=5), torch.cat([blobs(shape, i) for i in (1, 2)])
    monkeypatch.setattr(made, "TILE", {2: 64, 3: 48})
    seen = []

    def spied(image: Tensor) -> Tensor:
        seen.append(image.shape[2:])
        return net(image)

    found = run_program(spied, images, "net")
    assert max(max(size) for size in seen) <= 64
    assert len(seen) > 4
    with torch.no_grad():
        torch.testing.assert_close(found, net(images))


def test_pooling_falls_together_in_tiles(monkeypatch):
    monkeypatch.setattr(made, "TILE", {2: 64})
    pool = nn.Sequential(nn.AvgPool2d(8), nn.Upsample(scale_factor=8))
    image = blobs((160, 128))
    torch.testing.assert_close(run_program(pool, image, "pool"), pool(image))


def test_unit_vectors_are_compared_by_their_angle():
    """A hand-made pair of 2 channels: (3, 0) against (0, 5) is 90°, against (1, 0) 0°, against (−2, 0) 180°."""
    grid, image = Grid((6, 6)), blobs((6, 6))
    lengths = 1 + image.abs()  # which do not count
    fixed = lengths * torch.tensor([3.0, 0.0]).view(1, 2, 1, 1)
    for vector, value in (((0.0, 5.0), -1.0), ((1.0, 0.0), 0.0), ((-2.0, 0.0), -2.0)):
        moving = lengths.flip(2) * torch.tensor(vector).view(1, 2, 1, 1)
        problem = RegistrationProblem(grid, image, image, features=(fixed, moving))
        settings = settings_of(features="files").decided()
        objective = forward_objective(with_channels(problem, settings), grid, settings)
        assert not objective.more
        assert objective.similarity.evaluate()[1].item() == pytest.approx(value, abs=1e-6)


def test_labels_weigh_by_their_squared_difference_whatever_their_size():
    """By hand: label 1 is the same in both, label 2 nowhere, 3 of one image only does not count."""
    fixed, moving = torch.zeros(1, 1, 20, 20), torch.zeros(1, 1, 20, 20)
    fixed[..., 2:9, 2:9] = moving[..., 2:9, 2:9] = 1
    fixed[..., 12:14, 2:4], moving[..., 12:14, 10:12] = 2, 2
    fixed[..., 15:18, 15:18] = 3
    grid, image, settings = Grid((20, 20)), blobs((20, 20)), settings_of(labels_weight=4.0).decided()
    problem = with_channels(RegistrationProblem(grid, image, image, labels=(fixed, moving)), settings)
    (addition,) = forward_objective(problem, grid, settings).more
    value, _ = addition.evaluate(torch.zeros(1, 2, 20, 20), "auto")
    assert value.item() == pytest.approx(4.0 * (0 - 1) / 2)
    masked = replace(problem, fixed_mask=torch.ones(1, 1, 20, 20), channels=())
    masked.fixed_mask[..., 10:, :] = 0  # label 2 is masked
    masked = with_channels(replace(masked, labels=(fixed, moving)), settings)
    (addition,) = forward_objective(masked, grid, settings).more
    assert addition.evaluate(torch.zeros(1, 2, 20, 20), "auto")[0].item() == pytest.approx(0.0, abs=1e-6)


def waves(grid: Grid, *phases: float) -> Tensor:
    """Return a channel of one long wave for each phase, 0 at the faces."""
    x = grid.points(dtype=torch.float64) / grid.along(grid.extent, grid.points(dtype=torch.float64))
    fade = (16 * (x * (1 - x)).square()).prod(1, keepdim=True)
    return torch.cat([fade * torch.cos(4 * x + phase).prod(1, keepdim=True) for phase in phases], dim=1)


@pytest.mark.parametrize("shape", [(60, 68), (34, 36, 35)])
@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("coarser", [1.0, 1.4, 3.0])
def test_the_force_of_what_is_added_is_its_derivative(shape, symmetric, coarser):
    """Against differences of the value along a flow, on the grid of the map (1.7 voxels), a finer and a coarser one."""
    grid = Grid(shape, (0.5, 0.6, 0.7)[: len(shape)])
    own, coarse = coarsened(grid, coarser), coarsened(grid, 1.7)
    channels = Channels(own, waves(own, 0.0, 1.0, 2.0), waves(own, 0.3, 1.2, 1.8), "ssd", 0.7)
    image, settings = waves(grid, 0.0), settings_of(similarity="ssd", features={"intensities": 1.0, "files": 0.7})
    problem = RegistrationProblem(grid, image, image, channels=(channels,))
    (addition,) = (symmetric_objective if symmetric else forward_objective)(problem, coarse, settings).more
    u, v = 0.2 * bend(coarse, 1.0).double(), bend(coarse, 1.0).double().flip(1)
    if symmetric:
        u, v = torch.cat([u, -u]), torch.cat([v, -v])
    value, force = addition.evaluate(u, "shifts")
    step = 1e-4
    ends = [addition.evaluate(compose(u, sign * step * v, coarse), "shifts")[0] for sign in (1, -1)]
    slope = (ends[0] - ends[1])[0] / (2 * step)
    assert (force * v).sum() / math.prod(coarse.shape) == pytest.approx(slope.item(), rel=0.15)
    assert value[0] < 0


def test_mind_as_features_is_mind_as_similarity():
    fixed, moving, _, _ = pair((60, 72))
    one_level = changed(QUICK, steps=(12,))
    known = register(fixed, moving, changed(one_level, similarity="mind"))
    found = register(fixed, moving, changed(one_level, features="mind"))
    torch.testing.assert_close(found.displacement, known.displacement)
    torch.testing.assert_close(found.objective_after, known.objective_after)
    given = register(
        fixed,
        moving,
        changed(one_level, features=lambda image: mind_ssc(image), similarity={"ncc": 1.0}),
    )
    assert voxels(given.displacement - known.displacement, Grid((60, 72))).mean() < 0.5


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "how",
    [
        {"features": "mind"},
        {"features": "files", "similarity": "lncc"},
        {"similarity": {"lncc": 1.0, "ssd": 0.5}},
        {"features": {"intensities": 1.0, "files": 0.5, "mind": 2.0}},
        {"symmetric": True},
    ],
)
def test_features_find_the_motion(shape, how):
    fixed, moving, u, grid = pair(shape, 2.0)
    images = (("fixed", fixed), ("moving", moving))
    given = Annotations(
        **{f"{side}_features": torch.cat([x - 3, (x - 3).square() - 1, torch.ones_like(x)], 1) for side, x in images}
    )
    result = register(fixed, moving, changed(QUICK, **how), annotations=None if how == {"features": "mind"} else given)
    assert result.diagnosis.folds.item() == 0
    apart = voxels(result.displacement - u, grid)
    assert apart.mean() < (0.4 if len(shape) == 2 else 0.75) * voxels(u, grid).mean()
    assert result.objective_after > result.objective_before
    assert result.settings.features == how.get("features", "files")


def test_features_find_what_the_intensities_do_not_show():
    shape = (60, 72)
    _, moving, u, grid = pair(shape)
    flat = [disc(shape, (30, 36), 40) + 1e-3 * blobs(shape, seed) for seed in (5, 6)]
    given = Annotations(fixed_features=warp(moving, u, grid), moving_features=moving)
    result = register(*flat, changed(QUICK, similarity="lncc"), annotations=given)
    assert voxels(result.displacement - u, grid).mean() < 0.4 * voxels(u, grid).mean()


def test_a_batch_has_the_features_and_labels_of_its_items():
    shape = (48, 56)
    pairs = [pair(shape, amplitude)[:2] for amplitude in (1.5, 3.0)]
    fixed, moving = (torch.cat(images) for images in zip(*pairs, strict=True))
    labels = quarters(shape)
    both = torch.cat([labels, (labels == 1).float()]), torch.cat([labels, labels]).roll(2, 3)
    settings = changed(QUICK, features={"intensities": 1.0, network(2): 0.5}, labels_weight=1.0, steps=(6,))
    whole = register(fixed, moving, settings, annotations=Annotations(fixed_labels=both[0], moving_labels=both[1]))
    for k in range(2):  # the second has one of the four labels
        given = Annotations(fixed_labels=both[0][k : k + 1], moving_labels=both[1][k : k + 1])
        alone = register(fixed[k : k + 1], moving[k : k + 1], settings, annotations=given)
        torch.testing.assert_close(whole.displacement[k : k + 1], alone.displacement, rtol=0, atol=1e-3)
        torch.testing.assert_close(whole.objective_after[k : k + 1], alone.objective_after, rtol=0, atol=1e-4)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("symmetric", [False, True])
def test_labels_pull_their_regions_together(shape, symmetric):
    grid, u = Grid(shape), bend(Grid(shape), 4.0)
    labels = quarters(shape)
    fixed_labels = _nearest(labels, u, grid)
    texture = [0.02 * blobs(shape, seed) for seed in (1, 2)]  # intensities say nothing
    given = Annotations(fixed_labels=fixed_labels, moving_labels=labels)
    settings = changed(QUICK, symmetric=symmetric)
    names = (1, 2, 3, 4)
    overlap = []
    for weight in (0.0, 3.0):
        result = register(*texture, changed(settings, labels_weight=weight), annotations=given)
        assert result.diagnosis.folds.item() == 0
        overlap.append(dice(fixed_labels, _nearest(labels, result.displacement, grid), names).mean())
    assert overlap[1] > max(overlap[0], dice(fixed_labels, labels, names).mean()) + 0.02
    assert overlap[1] > (0.95 if len(shape) == 2 else 0.8)


def _nearest(labels: Tensor, u: Tensor, grid: Grid) -> Tensor:
    parts = torch.cat([warp((labels == k).float(), u, grid) for k in range(5)], dim=1)
    return parts.argmax(1, keepdim=True).float()


def test_many_labels_are_held_on_a_coarser_grid_and_compared_some_at_a_time(monkeypatch):
    shape, settings = (64, 64), settings_of(labels_weight=1.0).decided()
    x = Grid(shape).points().long()
    labels = 1 + (x[:, :1] // 16) * 4 + x[:, 1:] // 16  # 16 squares
    monkeypatch.setattr(made, "MOST_PROBABILITIES", 16 * 32**2)
    problem = RegistrationProblem(Grid(shape), blobs(shape), blobs(shape), labels=(labels, labels))
    channels = with_channels(problem, settings).channels
    assert [one.fixed.shape[1] for one in channels] == [8, 8]
    assert sum(one.weight for one in channels) == pytest.approx(1.0)
    assert all(math.prod(one.grid.shape) <= 32**2 for one in channels)
    assert with_channels(problem, settings).on(Grid((16, 16), (4.2, 4.2))).channels[0].grid.shape == (16, 16)


def test_features_and_labels_of_images_are_taken_from_their_own_grids():
    """Features and labels at half the spacing, a moving image far away: the same as on the image's own grid."""
    shape, far = (40, 48), Affine(torch.eye(2, dtype=torch.float64), torch.tensor([300.0, 200.0], dtype=torch.float64))
    fixed, moving, u, grid = pair(shape)
    labels = quarters(shape)
    images = [Image(field, grid, (0.0, 0.0), ((1.0, 0.0), (0.0, 1.0)), "image") for field in (fixed, moving)]
    fine = Grid(tuple(2 * n - 1 for n in shape), (0.5, 0.5))
    frame = replace(images[0], data=torch.zeros(1, 1, *fine.shape), grid=fine)
    settings = changed(QUICK, labels_weight=1.0, features={"intensities": 1.0, "files": 1.0})
    results = []
    for detailed in (False, True):

        def given(image: Image, field: Tensor, mode: str, detailed: bool = detailed) -> Image:
            own = replace(image, data=field)
            return replace(own, data=resample(own, frame, mode=mode), grid=fine) if detailed else own

        fields = {
            "fixed_features": given(images[0], fixed, "linear"),
            "moving_features": moved(given(images[1], moving, "linear"), far),
            "fixed_labels": given(images[0], _nearest(labels, u, grid), "nearest"),
            "moving_labels": moved(given(images[1], labels, "nearest"), far),
        }
        there = moved(images[1], far)
        results.append(register(images[0], there, settings, annotations=Annotations(**fields), affine=far))
    apart = results[0].displacement - results[1].displacement
    assert voxels(apart, grid).mean() < 0.05 < 0.3 < voxels(results[0].displacement, grid).mean()


def test_sliding_borders_glide_by_features_and_labels_too():
    fixed, moving, tissue, *_ = sliding_blocks()
    given = Annotations(
        tissue=tissue, fixed_features=fixed, moving_features=moving, fixed_labels=tissue, moving_labels=tissue
    )
    settings = settings_of(steps=(8, 6), window=7, sliding=(1,), labels_weight=0.1)
    result = register(fixed, moving, settings, annotations=given)
    assert result.diagnosis.folds.item() == 0
    assert result.objective_after > result.objective_before


def test_masked_features_and_labels_have_no_influence():
    shape = (48, 56)
    fixed, moving, _, _ = pair(shape)
    mask = torch.ones(1, 1, *shape)
    mask[..., :20] = 0
    labels, settings = quarters(shape), changed(QUICK, labels_weight=1.0)
    results = []
    for noise in (0.0, 1.0):
        torch.manual_seed(1)
        other = torch.where(mask > 0, 0.0, noise)
        given = Annotations(
            fixed_mask=mask,
            fixed_features=fixed + other * torch.randn(fixed.shape),
            moving_features=moving,
            fixed_labels=labels * (1 - other),
            moving_labels=labels,
        )
        results.append(register(fixed, moving, settings, annotations=given))
    torch.testing.assert_close(results[0].displacement, results[1].displacement, rtol=0, atol=1e-3)


def test_what_programs_do_wrong_is_said_in_a_sentence():
    image = blobs((40, 44))
    for program, problem in (
        (lambda x: x[..., 1:], r"must return \(1, K, 40, 44\)"),
        (lambda x: 3, "returns int"),
        (lambda x: x * math.nan, "NaN or infinite"),
        (lambda x: x[:, :0], "with channels"),
        (torch.fft.fft2, "returns complex numbers"),
        (network(2, inputs=3), "fails on an image of 1 channel and 2 axes of size 44×40"),
        (network(3), "fails on|must return"),
    ):
        with pytest.raises(InputError, match=problem):
            register(image, image, changed(QUICK, features=program))
        with pytest.raises(InputError, match=problem):
            count_features(changed(QUICK, features=program), image, image, Annotations())
    sizes = iter((2, 3))
    with pytest.raises(InputError, match="2 channels for one image or tile and 3 for another"):
        run_program(lambda x: x.repeat(1, next(sizes), 1, 1), torch.cat([image, image]), "net")


def test_features_without_contrast_are_refused():
    image, flat = blobs((40, 44)), torch.ones(1, 2, 40, 44)
    for how, given, problem in (
        ({"features": lambda x: 0 * x}, None, "those of <lambda> are the same in every voxel of the fixed image"),
        ({"features": {"intensities": 1.0, torch.ones_like: 1.0}}, None, "those of ones_like are the same"),
        ({}, Annotations(fixed_features=image.repeat(1, 2, 1, 1), moving_features=flat), "those of files .* moving"),
    ):
        with pytest.raises(InputError, match=problem):
            register(image, image, changed(QUICK, **how), annotations=given)


def test_a_program_may_write_into_what_it_gets():
    image = blobs((40, 44))
    kept = image.clone()
    run_program(lambda x: x.mul_(0), image, "net")
    torch.testing.assert_close(image, kept)


def test_settings_and_what_is_given_must_go_together():
    image, features = blobs((32, 32)), torch.rand(1, 3, 32, 32)
    both = Annotations(fixed_features=features, moving_features=features)
    for settings, annotations, problem in (
        ({"features": "mind"}, both, "features are given twice"),
        ({"features": "files"}, None, "features: files are channels of both images, but there are none"),
        ({"labels_weight": 1.0}, None, "labels_weight needs labels of both images"),
    ):
        with pytest.raises(InputError, match=problem):
            register(image, image, changed(QUICK, **settings), annotations=annotations)
    with pytest.raises(InputError, match="moving_features are missing"):
        Annotations(fixed_features=features)
    for other, problem in (
        (torch.rand(1, 2, 32, 32), "fixed_features has 3 channels and moving_features has 2 channels"),
        (torch.rand(1, 3, 32, 30), "moving_features must be a tensor"),
        (features * math.nan, "moving_features has values that are NaN"),
    ):
        with pytest.raises(InputError, match=problem):
            register(image, image, QUICK, annotations=Annotations(fixed_features=features, moving_features=other))
