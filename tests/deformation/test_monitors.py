"""Monitor functions: values by hand, means and ranges kept, units that do not matter, batches, derivatives, errors."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core.grid import Grid
from torchdeform.deformation.monitors import (
    MonitorSettings,
    ball_monitor,
    box_monitor,
    curvature_monitor,
    density_monitor,
    gradient_monitor,
    label_monitor,
    line_monitor,
    mean_value,
    normalise_monitor,
    ring_monitor,
    smooth,
)
from torchdeform.errors import InputError

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
WIDE = MonitorSettings(f_min=0.1, f_max=2.0, dtype=torch.float64)
GRIDS = [Grid((41, 31), (0.5, 1.0)), Grid((21, 16, 31), (1.0, 2.0, 0.5))]


def middle(grid: Grid) -> list[float]:
    return [grid.spacing[k] * (n // 2) for k, n in enumerate(grid.shape)]


def nearest(f: Tensor, grid: Grid, point: list[float]) -> float:
    node = tuple(round(p / h) for p, h in zip(point, grid.spacing, strict=True))
    return float(f[0, 0][node])


def from_middle(grid: Grid) -> Tensor:
    return grid.points(dtype=torch.float64) - torch.tensor(middle(grid)).double().view(1, -1, *[1] * grid.dim)


def shapes(grid: Grid, options: MonitorSettings = WIDE) -> dict[str, Tensor]:
    low, high = ([m + side * e for m, e in zip(middle(grid), (2, 3, 4), strict=False)] for side in (-1, 1))
    return {
        "ring": ring_monitor(grid, middle(grid), 5.0, 1.0, options),
        "ball": ball_monitor(grid, middle(grid), 5.0, 1.0, options),
        "box": box_monitor(grid, low, high, 0.5, options),
        "line": line_monitor(grid, low, high, 1.0, options),
    }


@pytest.mark.parametrize("grid", GRIDS)
def test_shapes_have_the_values_of_their_formulas(grid):
    offset = from_middle(grid)
    r = (offset**2).sum(1, keepdim=True).sqrt()
    found = shapes(grid)
    torch.testing.assert_close(found["ring"], 2 - 1.9 * torch.exp(-((r - 5) ** 2)))
    torch.testing.assert_close(found["ball"], 2 - 1.9 * (1 + torch.tanh(5 - r)) / 2)
    edge = torch.tensor([2.0, 3.0, 4.0][: grid.dim]).double().view(1, -1, *[1] * grid.dim)
    inside = (1 + torch.tanh((offset + edge) / 0.5)) * (1 + torch.tanh((edge - offset) / 0.5)) / 4
    torch.testing.assert_close(found["box"], 2 - 1.9 * inside.prod(1, keepdim=True))


@pytest.mark.parametrize("grid", GRIDS)
def test_the_line_is_seen_from_all_its_points(grid):
    """The distance to a segment is the least distance to its points."""
    ends = [torch.tensor(v).double() for v in ([4.0, 6.0, 3.0][: grid.dim], [15.0, 20.0, 9.0][: grid.dim])]
    x = grid.points(dtype=torch.float64)
    path = torch.linspace(0, 1, 801, dtype=torch.float64)
    places = [(ends[0] + t * (ends[1] - ends[0])).view(1, -1, *[1] * grid.dim) for t in path]
    least = torch.stack([((x - p) ** 2).sum(1, keepdim=True) for p in places]).amin(0)
    f = line_monitor(grid, ends[0], ends[1], 2.0, WIDE)
    torch.testing.assert_close(f, 2 - 1.9 * torch.exp(-least / 4), atol=1e-3, rtol=0)
    point = line_monitor(grid, ends[0], ends[0], 2.0, WIDE)  # a line without length is its end
    away = ((x - places[0]) ** 2).sum(1, keepdim=True)
    torch.testing.assert_close(point, 2 - 1.9 * torch.exp(-away / 4))


@pytest.mark.parametrize("grid", GRIDS)
def test_every_shape_is_smallest_where_it_is(grid):
    for name, f in shapes(grid).items():
        assert f.shape == (1, 1, *grid.shape)
        assert f.dtype == torch.float64
        assert 0.1 <= float(f.min()) < 0.2, name
        assert float(f.max()) == pytest.approx(2.0, abs=1e-3), name
        assert (nearest(f, grid, middle(grid)) > 1.9) == (name == "ring")


@pytest.mark.parametrize("grid", GRIDS)
def test_batched_arguments_give_a_batch(grid):
    centres = torch.tensor([[3.0, 4.0, 5.0], [8.0, 9.0, 7.0]]).double()[:, : grid.dim]
    radii, widths = torch.tensor([2.0, 3.0]), torch.tensor([0.5, 1.5])
    for build in (ring_monitor, ball_monitor):
        together = build(grid, centres, radii, widths, WIDE)
        alone = [build(grid, centres[i], float(radii[i]), float(widths[i]), WIDE) for i in range(2)]
        assert_same_to_rounding(together, torch.cat(alone), terms=16)
    for build in (box_monitor, line_monitor):
        together = build(grid, centres, centres + 3, widths, WIDE)
        alone = [build(grid, centres[i], centres[i] + 3, float(widths[i]), WIDE) for i in range(2)]
        assert_same_to_rounding(together, torch.cat(alone), terms=16)


@pytest.mark.parametrize("device", DEVICES)
def test_type_and_device_are_the_ones_asked_for(device):
    grid = Grid((9, 8))
    f = ring_monitor(grid, (4.0, 4.0), 2.0, 1.0, MonitorSettings(device=device))
    assert (f.dtype, f.device.type) == (torch.float32, device)
    image = torch.rand(2, 3, 9, 8, dtype=torch.float64, device=device)
    for build in (gradient_monitor, curvature_monitor):
        f = build(image, grid)
        assert (f.shape, f.dtype, f.device.type) == ((2, 1, 9, 8), torch.float64, device)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_gradient_monitor_of_a_blob_is_its_formula(grid):
    """I = exp(−r²/2s²) has |∇I| = r/s² I; the unit of I does not matter."""
    r2, s = (from_middle(grid) ** 2).sum(1, keepdim=True), 6.0
    image = torch.exp(-r2 / (2 * s**2))
    square = r2 / s**4 * image**2
    mean = (square * grid.quadrature(dtype=torch.float64)).sum() / grid.volume
    expected = 0.1 + 1.9 / (1 + square / mean)
    f = gradient_monitor(image, grid, WIDE)
    assert float((f - expected).abs().mean()) < 0.03
    torch.testing.assert_close(gradient_monitor(1000 * image + 5, grid, WIDE), f)
    twice = gradient_monitor(torch.cat([image, image], dim=1), grid, WIDE)
    torch.testing.assert_close(twice, f)


@pytest.mark.parametrize("grid", GRIDS)
def test_the_curvature_monitor_sees_bends_only(grid):
    """A ramp does not bend; a parabola does, most at its vertex; the unit of I does not matter."""
    x = grid.points(dtype=torch.float64)[:, :1]
    torch.testing.assert_close(curvature_monitor(3 * x + 1, grid, WIDE), torch.full_like(x, 2.0))
    bent = curvature_monitor((x - grid.extent[0] / 2) ** 2, grid, WIDE)
    line = bent[0, 0].flatten(1)[:, 0]
    assert int(line.argmin()) == grid.shape[0] // 2
    assert float(line[1]) > 1.5
    torch.testing.assert_close(curvature_monitor(-7 * (x - grid.extent[0] / 2) ** 2, grid, WIDE), bent)


def test_a_flat_image_asks_for_nothing():
    grid = Grid((6, 5))
    for build in (gradient_monitor, curvature_monitor):
        assert torch.equal(build(torch.full((1, 1, 6, 5), 7.0), grid), torch.ones(1, 1, 6, 5))


def test_smoothing_happens_before_differentiating():
    grid, image = Grid((20, 20)), torch.rand(1, 1, 20, 20, dtype=torch.float64)
    options = MonitorSettings(smoothing=2.0)
    assert torch.equal(gradient_monitor(image, grid, options), gradient_monitor(smooth(image, grid, 2.0), grid))
    ring = ring_monitor(grid, (9.0, 9.0), 5.0, 1.0, options)
    assert torch.equal(ring, smooth(ring_monitor(grid, (9.0, 9.0), 5.0, 1.0), grid, 2.0))


@pytest.mark.parametrize("grid", [Grid((33, 41), (0.5, 1.0)), Grid((25, 21, 31), (1.0, 2.0, 0.5))])
def test_smoothing_a_point_gives_a_gaussian_of_that_width(grid):
    """Its second moments are σ² along every axis, its values nearly those of the continuous one."""
    sigma, point = 2.0, torch.zeros(1, 1, *grid.shape, dtype=torch.float64)
    point[(0, 0, *(n // 2 for n in grid.shape))] = 1 / grid.cell_volume
    found, offset = smooth(point, grid, sigma), from_middle(grid)
    weights = grid.quadrature(dtype=torch.float64)
    assert float((found * weights).sum()) == pytest.approx(1, abs=1e-12)
    for k in range(grid.dim):
        moment = float((found * weights * offset[:, k : k + 1] ** 2).sum())
        assert moment == pytest.approx(sigma**2, rel=0.02)
    gauss = torch.exp(-(offset**2).sum(1, keepdim=True) / (2 * sigma**2)) / (2 * math.pi * sigma**2) ** (grid.dim / 2)
    assert float((found - gauss).abs().max()) < 0.25 * float(gauss.max())


@settings(deadline=None, max_examples=25)
@given(
    shape=st.lists(st.integers(2, 9), min_size=2, max_size=3),
    spacing=st.floats(0.2, 5.0),
    sigma=st.floats(0, 20),
    seed=st.integers(0, 99),
)
def test_smoothing_keeps_mean_and_range(shape, spacing, sigma, seed):
    grid = Grid(tuple(shape), (spacing,) * len(shape))
    field = torch.rand(2, 1, *shape, dtype=torch.float64, generator=torch.manual_seed(seed))
    found = smooth(field, grid, sigma)
    torch.testing.assert_close(mean_value(found, grid), mean_value(field, grid))
    assert float(found.min()) > float(field.min()) - 1e-12
    assert float(found.max()) < float(field.max()) + 1e-12


@settings(deadline=None, max_examples=25)
@given(
    shape=st.lists(st.integers(2, 9), min_size=2, max_size=3),
    spacing=st.floats(0.2, 5.0),
    scale=st.floats(1e-3, 1e3),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_normalised_monitors_have_the_mean_they_need(shape, spacing, scale, dtype):
    grid = Grid(tuple(shape), (spacing,) * len(shape))
    f = (scale * (torch.rand(3, 1, *shape, generator=torch.manual_seed(0)) + 0.1)).to(dtype)
    ones = torch.ones(3, 1, *[1] * grid.dim, dtype=dtype)
    plain, reciprocal = normalise_monitor(f, grid), normalise_monitor(f, grid, "reciprocal_mean")
    torch.testing.assert_close(mean_value(plain, grid), ones)
    torch.testing.assert_close(mean_value(1 / reciprocal, grid), ones)
    torch.testing.assert_close(plain * f[:, :, :1] / plain[:, :, :1], f)  # only the scale changes


@pytest.mark.parametrize("smoothing", [0.0, 1.5])
def test_labels_get_their_volumes(smoothing):
    """∫ f over all is |Ω|; without smoothing each region has its factor, so ∫ f over it is its new volume."""
    grid = Grid((20, 22, 18), (1.0, 0.5, 2.0))
    labels = torch.zeros(2, 1, *grid.shape, dtype=torch.int32)
    labels[0, 0, 4:9, 5:12, 3:7], labels[1, 0, 2:6, 5:12, 3:7] = 7, 7
    labels[:, 0, 12:16, 5:12, 8:14] = 17
    f = label_monitor(labels, {7: 0.8, 17: 1.25}, grid, smoothing)
    torch.testing.assert_close(mean_value(f, grid), torch.ones(2, 1, 1, 1, 1))
    weights = grid.quadrature()
    for label, factor in ((7, 0.8), (17, 1.25)):
        region = labels == label
        ratio = (f * weights * region).sum((1, 2, 3, 4)) / (weights * region).sum((1, 2, 3, 4))
        torch.testing.assert_close(ratio, torch.full((2,), factor), atol=1e-6 + 0.15 * (smoothing > 0), rtol=0)
    assert (f.dtype, label_monitor(labels.double(), {7: 0.8}, grid).dtype) == (torch.float32, torch.float64)


def test_a_density_is_turned_upside_down_and_kept_in_bounds():
    grid = Grid((4, 5))
    density = torch.ones(1, 1, 4, 5)
    density[0, 0, 1, 2], density[0, 0, 2, 2] = 100.0, 0.0
    f = density_monitor(density, grid, MonitorSettings(f_min=0.1, f_max=10.0))
    mean = float(mean_value(density, grid))
    assert float(f[0, 0, 1, 2]) == pytest.approx(max(mean / 100, 0.1))
    assert float(f[0, 0, 2, 2]) == 10.0
    assert float(f[0, 0, 0, 0]) == pytest.approx(mean)


def test_gradients():
    grid = Grid((4, 5), (1.0, 0.7))
    centre = torch.tensor([[1.1, 1.3], [0.4, 2.0]], dtype=torch.float64, requires_grad=True)
    size, width = (torch.tensor([a, b], dtype=torch.float64, requires_grad=True) for a, b in ((1.0, 1.5), (0.5, 0.8)))
    assert gradcheck(lambda c, r, w: ring_monitor(grid, c, r, w, WIDE), (centre, size, width))
    assert gradcheck(lambda c, r, w: ball_monitor(grid, c, r, w, WIDE), (centre, size, width))
    assert gradcheck(lambda c, w: box_monitor(grid, c, c + 1, w, WIDE), (centre, width))
    assert gradcheck(lambda c, w: line_monitor(grid, c, 2 * c, w, WIDE), (centre, width))
    image = torch.rand(2, 2, 4, 5, dtype=torch.float64, generator=torch.manual_seed(0)).requires_grad_()
    options = MonitorSettings(smoothing=0.5, f_min=0.01, f_max=100.0)
    assert gradcheck(lambda i: gradient_monitor(i, grid, options), image)
    assert gradcheck(lambda i: curvature_monitor(i, grid, options), image)
    assert gradcheck(lambda i: density_monitor(i[:, :1] + 0.1, grid, options), image)
    for kind in ("mean", "reciprocal_mean"):
        assert gradcheck(lambda i, kind=kind: normalise_monitor(i[:, :1] + 0.1, grid, kind), image)


@pytest.mark.parametrize(
    "wrong", [{"f_min": 0.0}, {"f_min": 2.0}, {"f_max": math.inf}, {"f_min": math.nan}, {"f_min": -1.0}]
)
def test_settings_refuse_a_range_that_folds(wrong):
    with pytest.raises(InputError, match="need 0 < f_min <= f_max"):
        MonitorSettings(**wrong)


def test_wrong_input_is_refused():
    grid = Grid((4, 5))
    f = torch.ones(1, 1, 4, 5)
    for sigma in (-1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="smoothing must be finite and not negative"):
            MonitorSettings(smoothing=sigma)
        with pytest.raises(InputError, match="sigma must be finite and not negative"):
            smooth(f, grid, sigma)
    with pytest.raises(InputError, match="kind must be one of mean, reciprocal_mean, got 'reciprocal'; did you mean"):
        normalise_monitor(f, grid, "reciprocal")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="normalise_monitor: f must be positive, got 0"):
        normalise_monitor(0 * f, grid)
    with pytest.raises(InputError, match="normalise_monitor: f must be finite"):
        normalise_monitor(f / 0, grid)
    with pytest.raises(InputError, match="normalise_monitor: f must have shape"):
        normalise_monitor(f[..., 1:], grid)
    with pytest.raises(InputError, match=r"a point must be 2 numbers or a tensor \(B, 2\), got shape \(3,\)"):
        ring_monitor(grid, (1.0, 2.0, 3.0), 1.0, 1.0)
    with pytest.raises(InputError, match=r"radius must be a number or a tensor \(B,\), got shape \(1, 1\)"):
        ball_monitor(grid, (1.0, 2.0), torch.ones(1, 1), 1.0)
    for build in (ring_monitor, ball_monitor):
        with pytest.raises(InputError, match="width must be positive, got -1"):
            build(grid, (1.0, 2.0), 1.0, -1.0)
    for build in (box_monitor, line_monitor):
        with pytest.raises(InputError, match="width must be positive, got 0"):
            build(grid, (1.0, 2.0), (2.0, 3.0), 0.0)
    for build in (gradient_monitor, curvature_monitor):
        with pytest.raises(InputError, match="_monitor: image must be finite"):
            build(f * math.nan, grid)


def test_wrong_densities_and_labels_are_refused():
    grid = Grid((4, 5))
    ones = torch.ones(1, 1, 4, 5)
    for wrong in (-ones, 0 * ones, ones * math.inf):
        with pytest.raises(InputError, match="density must be finite, nowhere negative and not zero everywhere"):
            density_monitor(wrong, grid)
    labels = torch.zeros(1, 1, 4, 5, dtype=torch.int64)
    labels[0, 0, 1:3, 1:3] = 1
    for factors in ({}, {1: 0.0}, {1: -1.0}, {1: math.inf}):
        with pytest.raises(InputError, match="factors must be positive and finite, one or more"):
            label_monitor(labels, factors, grid)
    with pytest.raises(InputError, match="label 3 does not occur"):
        label_monitor(labels, {3: 1.1}, grid)
    with pytest.raises(InputError, match="leave the rest of the domain no volume"):
        label_monitor(labels, {1: 9.0}, grid)
    with pytest.raises(InputError, match=r"labels fill the domain, and the factors would make its volume 1\.\d+ times"):
        label_monitor(labels, {0: 1.1, 1: 0.9}, grid)
    with pytest.raises(InputError, match="the labels fill item 1 of the batch, so nothing takes up the slack"):
        label_monitor(torch.cat([labels, torch.ones_like(labels)]), {1: 0.9}, grid)
    with pytest.raises(InputError, match="label_monitor: labels must have shape"):
        label_monitor(labels[0], {1: 1.1}, grid)


@pytest.mark.parametrize("monitor", [gradient_monitor, curvature_monitor, density_monitor, normalise_monitor])
@pytest.mark.parametrize("size", [1e30, 1e-30])
def test_the_unit_of_an_image_does_not_matter(monitor, size):
    grid = Grid((12, 14))
    image = torch.rand(2, 1, *grid.shape) + 0.5
    expected = monitor(image, grid) * (size if monitor is normalise_monitor else 1)
    found = monitor(image * size, grid)
    if monitor is normalise_monitor:
        expected = expected / size
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)
