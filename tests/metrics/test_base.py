"""What every similarity measure promises: its derivative, masks, ranges, batches, types."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_images import ANY, CONTRAST_FREE, ON_UNIT, SHAPES, images, smooth, soft_mask
from torch import Tensor

from torchdeform.core.derivatives import derivative
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.metrics.correlation import LNCC_FLOOR, ncc
from torchdeform.metrics.information import MutualInformation, mutual_information
from torchdeform.metrics.similarity import MEASURES, features, make_similarity
from torchdeform.metrics.squares import ssd

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", ON_UNIT)
def test_class_and_function_agree_in_value_and_derivative(name, shape, masked):
    fixed, warped = images(shape, channels=2)
    mask = soft_mask(shape) if masked else None
    warped.requires_grad_(True)
    expected = ON_UNIT[name](fixed, warped, mask=mask)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    with torch.no_grad():
        value, found = make_similarity(name, fixed, 5).evaluate(warped.detach(), mask)
    torch.testing.assert_close(value, expected.detach(), rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(found, slope * warped[0].numel(), rtol=1e-7, atol=1e-8)
    assert found.abs().max() > 1e-3


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", ANY)
def test_gradcheck(name, masked):
    fixed, warped = images((5, 6), items=1, low=0.05)
    mask = soft_mask((5, 6), items=1) if masked else None
    function = ON_UNIT.get(name, ANY[name])
    warped.requires_grad_(True)
    assert torch.autograd.gradcheck(lambda w: function(fixed, w, mask=mask), (warped,))
    if name != "ngf":  # its η, from the fixed image, counts as a constant
        assert torch.autograd.gradcheck(lambda f: function(f, warped.detach(), mask=mask), (fixed.requires_grad_(),))


@pytest.mark.parametrize("name", ["ssd", "ncc", "mi", "ngf"])
def test_gradgradcheck(name):
    fixed, warped = images((4, 5), items=1, low=0.05)
    assert torch.autograd.gradgradcheck(lambda w: ON_UNIT[name](fixed, w), (warped.requires_grad_(),))


def _itk_value(setter: str, fixed: Tensor, warped: Tensor, *arguments: int) -> float:
    sitk = pytest.importorskip("SimpleITK")
    method = sitk.ImageRegistrationMethod()
    getattr(method, setter)(*arguments)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetInitialTransform(sitk.TranslationTransform(fixed.dim() - 2))
    pair = (sitk.GetImageFromArray(x[0, 0].numpy().astype(np.float32)) for x in (fixed, warped))
    return method.MetricEvaluate(*pair)


@pytest.mark.parametrize("shape", [(40, 50), (20, 24, 22)])
def test_simple_itk_agrees(shape):
    """ITK minimises; its correlation is squared; its Mattes measure puts a fixed intensity into one bin, not two."""
    fixed = smooth(shape)
    moved = [(1 - torch.roll(fixed, k, dims=-1)).square() for k in range(6)]
    correlation = [_itk_value("SetMetricAsCorrelation", fixed, w) for w in moved]
    information = [_itk_value("SetMetricAsMattesMutualInformation", fixed, w, 32) for w in moved]
    for k, w in enumerate(moved):
        assert -(ncc(fixed, w).item() ** 2) == pytest.approx(correlation[k], abs=1e-4)
        assert -mutual_information(fixed, w).item() == pytest.approx(information[k], rel=0.03, abs=0.03)
    ours = torch.cat([mutual_information(fixed, w) for w in moved])
    assert np.corrcoef(-np.array(information), ours.numpy())[0, 1] > 0.999


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", ["ssd", "ncc", "lncc", "mi", "nmi"])
def test_a_box_as_mask_is_the_image_cut_to_it(name, shape):
    fixed, warped = images(shape, channels=2)
    box = (..., *[slice(2, -1)] * len(shape))
    mask = torch.zeros(2, 1, *shape, dtype=torch.float64)
    mask[box] = 1
    value, slope = make_similarity(name, fixed, 5).evaluate(warped, mask)
    cut_value, cut_slope = make_similarity(name, fixed[box].contiguous(), 5).evaluate(warped[box].contiguous())
    torch.testing.assert_close(value, cut_value)
    torch.testing.assert_close(slope[box], cut_slope * (fixed.numel() / fixed[box].numel()))
    torch.testing.assert_close(ANY[name](fixed, warped, mask=mask), ANY[name](fixed[box], warped[box]))


@pytest.mark.parametrize("name", [*ON_UNIT, "mind"])
def test_what_lies_outside_the_mask_does_not_matter(name):
    shape = (12, 13)
    fixed, warped = (features(name, x) for x in images(shape))
    mask = soft_mask(shape)
    other = torch.where(mask > 0, warped, 1 - warped)
    similarity = make_similarity(name, fixed, 5)
    value, slope = similarity.evaluate(warped, mask)
    other_value, other_slope = similarity.evaluate(other, mask)
    torch.testing.assert_close(value, other_value, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(slope, other_slope, rtol=1e-10, atol=1e-10)
    assert not (slope * (mask == 0)).any()
    scaled_value, scaled_slope = similarity.evaluate(warped, mask / 4)
    torch.testing.assert_close(value, scaled_value, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(slope, scaled_slope, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", [*ON_UNIT, "mind"])
def test_masks_of_ones_of_booleans_and_of_nothing(name):
    shape = (12, 13)
    fixed, warped = (features(name, x.float()) for x in images(shape))
    similarity = make_similarity(name, fixed, 5)
    whole = similarity.evaluate(warped)
    for ones in (torch.ones(2, 1, *shape), torch.ones(1, 1, *shape, dtype=torch.bool)):
        for found, expected in zip(similarity.evaluate(warped, ones), whole, strict=True):
            torch.testing.assert_close(found, expected)
    value, slope = similarity.evaluate(warped, torch.zeros(2, 1, *shape))
    assert not value.any()
    assert not slope.any()
    assert not ANY[name](*images(shape), mask=torch.zeros(2, 1, *shape)).any()


@pytest.mark.parametrize("shape", [(40, 44), (20, 22, 24)])
@pytest.mark.parametrize("name", ANY)
def test_nothing_is_more_similar_than_the_image_itself(name, shape):
    fixed = smooth(shape)
    top = ANY[name](fixed, fixed).item()
    for axis, shift in itertools.product(range(2, fixed.dim()), (-2, -1, 1, 3)):
        assert ANY[name](fixed, torch.roll(fixed, shift, dims=axis)).item() < top
    assert ANY[name](fixed, fixed + 0.05 * torch.rand_like(fixed)).item() < top
    best = {"ssd": 0.0, "ncc": 1.0, "lncc": 1.0, "mind": 0.0}
    if name in best:
        assert top == pytest.approx(best[name], abs=0.01)


@pytest.mark.parametrize("name", CONTRAST_FREE)
def test_a_reversed_contrast_changes_nothing(name):
    fixed, warped = images((16, 18))
    torch.testing.assert_close(ANY[name](fixed, 5 - 3 * warped), ANY[name](fixed, warped))
    torch.testing.assert_close(ncc(fixed, 5 - 3 * warped), -ncc(fixed, warped), rtol=1e-5, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.integers(3, 9), min_size=2, max_size=3),
    st.integers(1, 3),
    st.sampled_from([torch.float32, torch.float64]),
    st.integers(0, 99),
    st.floats(-3, 3),
)
def test_values_keep_to_their_range(shape, channels, dtype, seed, exponent):
    """Whatever the unit of the intensities; and all values but those of ssd do not depend on it."""
    pair = images(tuple(shape), channels, seed=seed).to(dtype)
    scaled = 10**exponent * pair
    ranges = {"ncc": (-1, 1), "lncc": (0, 1), "mi": (0, math.log(32)), "nmi": (1, 2), "ngf": (0, 1), "mind": (-1, 0)}
    for name, (low, high) in ranges.items():
        value = ANY[name](*scaled)
        assert value.dtype == dtype
        assert ((value >= low - 1e-5) & (value <= high + 1e-5)).all(), name
        torch.testing.assert_close(value, ANY[name](*pair), rtol=1e-2, atol=1e-3)
    assert (ssd(*scaled) <= 0).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", [*ON_UNIT, "mind"])
def test_a_batch_equals_its_items(name, masked, device):
    shape = (10, 9, 11)
    fixed, warped = images(shape, channels=2, items=3).float().to(device)
    fixed[1], warped[2] = 0.5, 0.5  # flat ones among them
    fixed, warped = features(name, fixed), features(name, warped)
    mask = soft_mask(shape, items=3).float().to(device) if masked else None
    value, slope = make_similarity(name, fixed, 5).evaluate(warped, mask)
    for i in range(3):
        alone = make_similarity(name, fixed[i : i + 1], 5)
        one = alone.evaluate(warped[i : i + 1], None if mask is None else mask[i : i + 1])
        torch.testing.assert_close(one[0][0], value[i], rtol=1e-5, atol=1e-6)
        if name == "lncc" and i == 2:  # the covariance with a flat moving image is rounding, and so is its sign
            continue
        # What a flat image may gain is rounding of the sums over its windows, by the floor of their variance.
        noise = 5**3 * torch.finfo(slope.dtype).eps * 0.5**2 / LNCC_FLOOR if name == "lncc" and i else 1e-5
        torch.testing.assert_close(one[1][0], slope[i], rtol=1e-4, atol=noise)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", [*ON_UNIT, "mind"])
def test_the_same_input_gives_the_same_bits(name, device):
    fixed, warped = (features(name, x.float().to(device)) for x in images((33, 40), channels=2))
    first, second = (make_similarity(name, fixed).evaluate(warped) for _ in range(2))
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("name", ANY)
def test_flat_images_and_few_bits_stay_finite(name, dtype):
    shape = (16, 18)
    flat = torch.full((1, 1, *shape), 0.7, dtype=dtype)
    half = flat.clone()
    half[..., :8] = 0
    rough = images(shape, items=1)[0].to(dtype)
    full = torch.promote_types(dtype, torch.float32)
    for fixed, warped in itertools.product((flat, half, rough), repeat=2):
        variable = warped.clone().requires_grad_(True)
        value = ANY[name](fixed, variable)
        value.sum().backward()
        assert value.dtype == full
        assert variable.grad is not None
        assert variable.grad.dtype == dtype
        assert variable.grad.isfinite().all()
        analytic = make_similarity(name, features(name, fixed), 5).evaluate(features(name, warped))
        for x in (value, *analytic):
            assert x.dtype == full
            assert x.isfinite().all()


@pytest.mark.parametrize("name", ANY)
def test_half_precision_is_computed_in_float32(name):
    fixed, warped = images((24, 26)).half()
    expected = ANY[name](fixed.double(), warped.double())
    torch.testing.assert_close(ANY[name](fixed, warped).double(), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("name", ["ncc", "lncc", "mi", "nmi", "ngf", "mind"])
def test_a_large_offset_costs_no_digits_but_those_of_the_input(name):
    offset = 1e4
    fixed, warped = ((100 * x).float() + offset for x in images((24, 26)))
    expected = ANY[name](fixed.double(), warped.double())
    torch.testing.assert_close(ANY[name](fixed, warped).double(), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ANY)
def test_masks_of_another_shape_are_refused(name):
    fixed, warped = images((10, 12))
    for shape in ((2, 1, 12, 10), (2, 2, 10, 12), (3, 1, 10, 12), (10, 12)):
        with pytest.raises(InputError, match=r"mask must have shape \(2, 1, 10, 12\)"):
            ANY[name](fixed, warped, mask=torch.ones(shape))


def test_images_that_do_not_go_together_are_refused():
    fixed, warped = images((10, 12))
    for function in ANY.values():
        with pytest.raises(InputError, match="must have one shape"):
            function(fixed, warped[..., 1:])
        with pytest.raises(InputError, match="must have one shape"):
            function(fixed[0, 0], warped[0, 0])
        with pytest.raises(InputError, match="floating-point"):
            function(fixed.int(), warped.int())


def test_too_few_bins_are_refused():
    fixed, warped = images((10, 12))
    with pytest.raises(InputError, match="bins must be at least 5, got 4"):
        mutual_information(fixed, warped, bins=4)
    with pytest.raises(InputError, match="bins must be at least 5, got 3"):
        MutualInformation(fixed, bins=3)


def test_the_adjoint_is_that_of_the_derivative():
    grid = Grid((5, 3, 6), (1.0, 0.4, 2.0))
    x, y = torch.rand(2, 1, 2, *grid.shape, dtype=torch.float64)
    from torchdeform.core.derivatives import add_adjoint_derivative

    for axis in range(3):
        total = torch.zeros_like(y)
        add_adjoint_derivative(total, y, grid, axis)
        torch.testing.assert_close((derivative(x, grid, axis) * y).sum(), (x * total).sum())


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", MEASURES)
def test_a_batch_without_an_item_has_no_similarity(name, shape):
    nothing = torch.rand(0, 2, *shape, requires_grad=True)
    value = MEASURES[name].function(nothing, nothing, mask=torch.ones(0, 1, *shape))
    assert value.shape == (0,)
    value.sum().backward()
    assert nothing.grad.shape == nothing.shape
