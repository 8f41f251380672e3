"""Every measure against an independent implementation, its derivative against autograd, and what all have in common."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchdeform.core.derivatives import derivative
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.metrics.correlation import LNCC_FLOOR, LocalCrossCorrelation, lncc, ncc
from torchdeform.metrics.gradients import GradientFields, ngf
from torchdeform.metrics.information import (
    MutualInformation,
    mutual_information,
    normalised_mutual_information,
)
from torchdeform.metrics.mind import mind_ssc
from torchdeform.metrics.similarity import features, make_similarity
from torchdeform.metrics.squares import mind, ssd

SHAPES = [(11, 14), (7, 9, 8)]
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
UNIT = (0.0, 1.0)

# The functions of images, on intensities that are already between 0 and 1.
ON_UNIT: dict[str, Callable[..., Tensor]] = {
    "ssd": ssd,
    "ncc": lambda f, w, mask=None: ncc(f, w, mask=mask, span=UNIT),
    "lncc": lambda f, w, mask=None: lncc(f, w, mask=mask, window=5, span=UNIT),
    "mi": lambda f, w, mask=None: mutual_information(f, w, mask=mask, span=UNIT),
    "nmi": lambda f, w, mask=None: normalised_mutual_information(f, w, mask=mask, span=UNIT),
    "ngf": lambda f, w, mask=None: ngf(f, w, mask=mask, span=UNIT),
}
ANY: dict[str, Callable[..., Tensor]] = {
    "ssd": ssd,
    "ncc": ncc,
    "lncc": lncc,
    "mi": mutual_information,
    "nmi": normalised_mutual_information,
    "ngf": ngf,
    "mind": mind,
}
CONTRAST_FREE = ["lncc", "mi", "nmi", "ngf", "mind"]


def images(shape: tuple[int, ...], channels: int = 1, items: int = 2, seed: int = 0, low: float = 0.0) -> Tensor:
    """Two related images with values from ``low`` to 1 − ``low``, float64: ``(2, B, C, *S)``."""
    generator = torch.Generator().manual_seed(seed)
    fixed, noise = torch.rand(2, items, channels, *shape, generator=generator, dtype=torch.float64)
    pair = torch.stack([fixed, 0.7 * fixed.square() + 0.3 * noise])
    return low + (1 - 2 * low) * pair


def smooth(shape: tuple[int, ...], seed: int = 0) -> Tensor:
    """An image of waves, ``(1, 1, *S)``, from 0 to 1."""
    x = Grid(shape).points(dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros(1, 1, *shape, dtype=torch.float64)
    for _ in range(6):
        wave = torch.rand(1, len(shape), generator=generator, dtype=torch.float64).view(1, -1, *([1] * len(shape)))
        total = total + torch.sin((0.9 * wave * x).sum(1, keepdim=True) + 6 * wave[:, :1])
    return (total - total.min()) / (total.max() - total.min())


def soft_mask(shape: tuple[int, ...], items: int = 2, seed: int = 5) -> Tensor:
    """Weights between 0 and 1, a third of them 0, more to one side."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(items, 1, *shape, generator=generator, dtype=torch.float64)
    mask[..., : shape[-1] // 3] = 0
    return mask


# --- the derivative ------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("stride", [2, 3])
@pytest.mark.parametrize("shape", SHAPES)
def test_lncc_with_a_stride_has_its_derivative_too(shape, stride, masked):
    fixed, warped = images(shape, channels=2)
    mask = soft_mask(shape) if masked else None
    expected = lncc(fixed, warped.requires_grad_(True), mask=mask, window=7, stride=stride, span=UNIT)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    value, found = LocalCrossCorrelation(fixed, 7, stride).evaluate(warped.detach(), mask)
    torch.testing.assert_close(value, expected.detach(), rtol=1e-8, atol=1e-9)
    torch.testing.assert_close(found, slope * warped[0].numel(), rtol=1e-7, atol=1e-8)


def test_lncc_sees_that_its_mask_was_written_to():
    fixed, warped = images((11, 14))
    mask, other = soft_mask((11, 14)), soft_mask((11, 14), seed=6)
    similarity = LocalCrossCorrelation(fixed, 5)
    similarity.evaluate(warped, mask)
    mask.copy_(other)
    for found, expected in zip(similarity.evaluate(warped, mask), similarity.evaluate(warped, other), strict=True):
        assert torch.equal(found, expected)


def test_the_derivative_of_gradient_fields_knows_the_spacing():
    grid = Grid((7, 9, 8), (0.7, 1.1, 2.5))
    fixed, warped = images(grid.shape)
    warped.requires_grad_(True)
    expected = ngf(fixed, warped, grid=grid, edge=0.5, span=UNIT)
    (slope,) = torch.autograd.grad(expected.sum(), warped)
    value, found = GradientFields(fixed, grid, edge=0.5).evaluate(warped.detach())
    torch.testing.assert_close(value, expected.detach())
    torch.testing.assert_close(found, slope * warped[0].numel())
    by_name = make_similarity("ngf", fixed, grid=grid).evaluate(warped.detach())[0]
    assert torch.equal(by_name, GradientFields(fixed, grid).evaluate(warped.detach())[0])


# --- the value, against other implementations ----------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_ncc_is_numpys_correlation(shape):
    fixed, warped = images(shape, channels=2)
    expected = [
        np.mean([np.corrcoef(f.ravel(), w.ravel())[0, 1] for f, w in zip(*pair, strict=True)])
        for pair in zip(fixed.numpy(), warped.numpy(), strict=True)
    ]
    torch.testing.assert_close(ncc(fixed, warped), torch.tensor(expected), rtol=0, atol=1e-6)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(7, 8), (5, 6, 4)])
def test_lncc_is_a_loop_over_windows(shape, masked):
    fixed, warped = images(shape, items=1)
    weight = soft_mask(shape, items=1) if masked else torch.ones(1, 1, *shape, dtype=torch.float64)
    f, w, m = (x[0, 0].numpy() for x in (fixed, warped, weight))
    total = 0.0
    for node in itertools.product(*map(range, shape)):
        cut = tuple(slice(max(0, i - 1), i + 2) for i in node)
        if m[node] > 0:
            c = np.cov(f[cut].ravel(), w[cut].ravel(), aweights=m[cut].ravel(), ddof=0)
            total += m[node] * c[0, 1] ** 2 / ((c[0, 0] + LNCC_FLOOR) * (c[1, 1] + LNCC_FLOOR))
    found = lncc(fixed, warped, mask=weight if masked else None, window=3, span=UNIT)
    assert found.item() == pytest.approx(total / m.sum(), rel=1e-9)


def _histogram(fixed: np.ndarray, warped: np.ndarray, weight: np.ndarray, bins: int) -> np.ndarray:
    """The joint histogram, voxel by voxel, with scipy's B-splines around the middle of each bin."""
    interpolate = pytest.importorskip("scipy.interpolate")
    spline = {k: interpolate.BSpline.basis_element(np.arange(k + 2) - (k + 1) / 2, extrapolate=False) for k in (1, 3)}
    table = np.zeros((bins, bins))
    for f, w, m in zip(fixed.ravel(), warped.ravel(), weight.ravel(), strict=True):
        rows = np.nan_to_num(spline[3](w * (bins - 3) + 1 - np.arange(bins)))
        columns = np.nan_to_num(spline[1](f * (bins - 1) - np.arange(bins)))
        table += m * np.outer(rows, columns)
    return table / weight.sum()


def _entropy(p: np.ndarray) -> float:
    return -float(np.sum(p[p > 0] * np.log(p[p > 0])))


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("bins", [8, 32])
def test_mutual_information_is_that_of_a_histogram_filled_voxel_by_voxel(bins, masked):
    shape = (9, 12)
    fixed, warped = images(shape, items=1, low=0.01)
    mask = soft_mask(shape, items=1) if masked else None
    weight = np.ones(shape) if mask is None else mask[0, 0].numpy()
    table = _histogram(fixed.numpy(), warped.numpy(), weight, bins)
    joint, alone = _entropy(table), _entropy(table.sum(0)) + _entropy(table.sum(1))
    arguments = {"mask": mask, "bins": bins, "span": UNIT}
    assert mutual_information(fixed, warped, **arguments).item() == pytest.approx(alone - joint, rel=1e-9)
    assert normalised_mutual_information(fixed, warped, **arguments).item() == pytest.approx(alone / joint, rel=1e-9)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.5, 2.0), (1.0, 0.7, 3.0)])
def test_ngf_is_numpys_gradient(spacing):
    shape = (8, 9, 7)[: len(spacing)]
    fixed, warped = images(shape, items=1)
    f, w = (np.stack(np.gradient(x[0, 0].numpy(), *spacing, edge_order=2)) for x in (fixed, warped))
    square = (0.1 * np.sqrt((f**2).sum(0)).mean()) ** 2
    expected = np.mean((f * w).sum(0) ** 2 / (((f**2).sum(0) + square) * ((w**2).sum(0) + square)))
    assert ngf(fixed, warped, grid=Grid(shape, spacing), span=UNIT).item() == pytest.approx(expected, rel=1e-9)


def test_mind_is_the_mean_squared_difference_of_features():
    fixed, warped = images((9, 8, 7), channels=2)
    expected = -((mind_ssc(fixed, radius=2) - mind_ssc(warped, radius=2)) ** 2).mean(dim=(1, 2, 3, 4))
    torch.testing.assert_close(mind(fixed, warped, radius=2), expected)
    value, _ = make_similarity("mind", features("mind", fixed)).evaluate(features("mind", warped))
    torch.testing.assert_close(value, mind(fixed, warped))


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


# --- masks ---------------------------------------------------------------------------------------------------------


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


# --- what the measures see, and what not ---------------------------------------------------------------------------


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


def test_mutual_information_of_independent_images_vanishes_and_nmi_is_one():
    generator = torch.Generator().manual_seed(0)
    fixed, warped = torch.rand(2, 1, 1, 64, 64, 64, generator=generator)
    assert mutual_information(fixed, warped).item() == pytest.approx(0, abs=4e-3)
    assert normalised_mutual_information(fixed, warped).item() == pytest.approx(1, abs=2e-3)


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
        torch.testing.assert_close(one[1][0], slope[i], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", [*ON_UNIT, "mind"])
def test_the_same_input_gives_the_same_bits(name, device):
    fixed, warped = (features(name, x.float().to(device)) for x in images((33, 40), channels=2))
    first, second = (make_similarity(name, fixed).evaluate(warped) for _ in range(2))
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])


# --- flat images, few bits, large offsets --------------------------------------------------------------------------


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


def test_lncc_of_tiny_and_of_huge_intensities():
    fixed, warped = smooth((32, 32)), smooth((32, 32)).square()
    expected = lncc(fixed, warped)
    for scale in (1e-30, 1e30):
        torch.testing.assert_close(lncc((scale * fixed).float(), warped.float()).double(), expected, rtol=1e-3, atol=0)


def test_a_window_that_the_mask_hardly_touches():
    fixed, warped = images((16, 16)).float()
    mask = torch.zeros(2, 1, 16, 16)
    mask[..., 3, 4], mask[..., 10:, 10:] = 1e-12, 1
    value, slope = LocalCrossCorrelation(fixed, 5).evaluate(warped, mask)
    assert value.isfinite().all()
    assert slope.isfinite().all()
    assert slope[..., 3, 4].abs().max() < 1e-6


def test_intensities_beyond_the_span_count_in_the_last_bins():
    fixed, warped = images((20, 22))
    beyond = warped.clone()
    beyond[..., 3, :], beyond[..., 7, :] = 1.0, 0.0
    cut = MutualInformation(fixed).evaluate(beyond)
    beyond[..., 3, :], beyond[..., 7, :] = 55.0, -9.0
    value, slope = MutualInformation(fixed).evaluate(beyond)
    assert torch.equal(value, cut[0])
    assert not slope[..., [3, 7], :].any()


# --- errors --------------------------------------------------------------------------------------------------------


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


def test_too_few_bins_and_nodes_are_refused():
    fixed, warped = images((10, 12))
    with pytest.raises(InputError, match="bins must be at least 5, got 4"):
        mutual_information(fixed, warped, bins=4)
    with pytest.raises(InputError, match="bins must be at least 5, got 3"):
        MutualInformation(fixed, bins=3)
    with pytest.raises(InputError, match="needs 3 nodes"):
        ngf(fixed[..., :2], warped[..., :2])


def test_the_adjoint_is_that_of_the_derivative():
    grid = Grid((5, 3, 6), (1.0, 0.4, 2.0))
    x, y = torch.rand(2, 1, 2, *grid.shape, dtype=torch.float64)
    from torchdeform.core.derivatives import add_adjoint_derivative

    for axis in range(3):
        total = torch.zeros_like(y)
        add_adjoint_derivative(total, y, grid, axis)
        torch.testing.assert_close((derivative(x, grid, axis) * y).sum(), (x * total).sum())
