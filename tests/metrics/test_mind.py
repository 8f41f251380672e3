"""MIND-SSC against the definition, voxel by voxel and patch by patch, and what it must not depend on."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding

from torchdeform.errors import InputError
from torchdeform.metrics.mind import mind_ssc, neighbour_pairs

SHAPES = [(9, 12), (6, 4, 4)]


def brute_force(image: np.ndarray, radius: int, dilation: int) -> np.ndarray:
    """The definition for one channel ``S`` -> ``(K, *S)``; indices outside are moved to the nearest voxel."""
    shape = image.shape
    last = np.array(shape) - 1
    unit = np.eye(image.ndim, dtype=int)
    steps = [sign * unit[axis] for axis in range(image.ndim) for sign in (-1, 1)]
    pairs = [(p, q) for p, q in itertools.combinations(steps, 2) if np.sum((p - q) ** 2) == 2]
    distance = np.zeros((len(pairs), *shape))
    for node in itertools.product(*map(range, shape)):
        patch = itertools.product(
            *(range(max(0, i - radius), min(n, i + radius + 1)) for i, n in zip(node, shape, strict=True))
        )
        places = [np.array(y) for y in patch]
        for k, (p, q) in enumerate(pairs):
            values = [[image[tuple(np.clip(y + dilation * s, 0, last))] for s in (p, q)] for y in places]
            distance[(k, *node)] = np.mean([(a - b) ** 2 for a, b in values])
    distance -= distance.min(axis=0)
    variance = distance.mean(axis=0)
    variance = np.clip(variance, 1e-3 * variance.mean(), 1e3 * variance.mean())
    return np.exp(-distance / variance)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("radius", "dilation"), [(1, 1), (0, 2), (2, 1)])
def test_the_definition(shape, radius, dilation):
    torch.manual_seed(0)
    image = torch.rand(2, 2, *shape, dtype=torch.float64)
    found = mind_ssc(image, radius=radius, dilation=dilation)
    expected = np.stack(
        [np.concatenate([brute_force(channel, radius, dilation) for channel in item]) for item in image.numpy()]
    )
    torch.testing.assert_close(found, torch.from_numpy(expected))


def test_the_pairs_are_those_at_distance_root_two():
    assert [len(neighbour_pairs(dim)) for dim in (2, 3)] == [4, 12]
    for dim in (2, 3):
        assert {sum((a - b) ** 2 for a, b in zip(p, q, strict=True)) for p, q in neighbour_pairs(dim)} == {2}


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.integers(2, 9), min_size=2, max_size=3),
    st.floats(0.01, 100),
    st.booleans(),
    st.floats(-50, 50),
    st.integers(0, 99),
)
def test_affine_changes_of_intensity_leave_it_alone(shape, scale, inverted, shift, seed):
    image = torch.rand(1, 1, *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    found = mind_ssc(image)
    assert found.min() >= 0
    assert found.max() <= 1
    torch.testing.assert_close(mind_ssc((-scale if inverted else scale) * image + shift), found, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_it_moves_with_the_image(shape):
    image = torch.rand(1, 1, *shape, dtype=torch.float64)
    rolled = mind_ssc(image.roll(1, dims=2))
    found = mind_ssc(image)
    inner = tuple(slice(1, n - 1) for n in shape[1:])
    ratio = (rolled.log()[(..., slice(3, -2), *inner)] / found.log()[(..., slice(2, -3), *inner)]).nan_to_num(1.0)
    torch.testing.assert_close(ratio, torch.ones_like(ratio))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", SHAPES)
def test_flat_images_and_flat_halves_are_finite_with_their_gradients(shape, dtype):
    flat = torch.full((1, 1, *shape), 0.7, dtype=dtype)
    half = flat.clone()
    half[:, :, : shape[0] // 2] = 0
    for image in (flat, half, 1e-3 * half, 1e4 * half):
        found = mind_ssc(image.requires_grad_(True))
        assert found.isfinite().all()
        (slope,) = torch.autograd.grad(found.sum(), image)
        assert slope.isfinite().all()
    assert (mind_ssc(flat) == 1).all()
    assert mind_ssc(half.to(torch.float16)).dtype == torch.float32
    noise = flat * (1 + 2 * torch.finfo(dtype).eps * (torch.rand_like(flat) - 0.5))
    assert mind_ssc(noise).min() > 0.9


@pytest.mark.parametrize("shape", [(4, 5), (3, 4, 3)])
def test_the_gradient_is_that_of_finite_differences(shape):
    image = torch.rand(1, 1, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    assert torch.autograd.gradcheck(mind_ssc, image.requires_grad_(True))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_batch_equals_its_items(shape):
    image = torch.rand(3, 2, *shape) * torch.tensor([1.0, 100.0, 0.0]).view(3, *([1] * (len(shape) + 1)))
    alone = torch.cat([mind_ssc(item) for item in image.split(1)])
    # Patches of random values are a few times farther apart than their variance.
    assert_same_to_rounding(mind_ssc(image), alone, terms=3 ** len(shape), condition=10)


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        (torch.rand(1, 1, 5), {}, "must be floating-point"),
        (torch.ones(1, 1, 5, 5, dtype=torch.int32), {}, "must be floating-point"),
        (torch.rand(1, 1, 5, 5), {"radius": -1}, "radius must be at least 0"),
        (torch.rand(1, 1, 5, 5), {"dilation": 0}, "dilation at least 1"),
    ],
)
def test_bad_input_is_named(image, options, message):
    with pytest.raises(InputError, match=message):
        mind_ssc(image, **options)


@pytest.mark.parametrize("size", [1e30, 1e-30, 1e-38])
def test_the_unit_of_the_image_does_not_matter(size):
    image = torch.rand(2, 1, 9, 10)
    torch.testing.assert_close(mind_ssc(image * size), mind_ssc(image), rtol=1e-3, atol=1e-3)
