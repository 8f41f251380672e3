"""Single pictures: what is drawn has the values, the place and the colours that it should."""

import math

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from torchdeform import report
from torchdeform.core.derivatives import divergence, jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.report import drawing
from torchdeform.report.planes import planes_of

SHAPES = [(20, 26), (12, 15, 17)]


@pytest.fixture
def axes():
    return Figure().add_subplot()


def _shown(axes) -> np.ndarray:
    return np.asarray(axes.images[-1].get_array())


def _ball(dim: int) -> Image:
    image = torch.zeros(1, 1, *(16,) * dim)
    image[(..., *(slice(4, 12),) * dim)] = 1.0
    return Image(image, Grid((16,) * dim))


@pytest.mark.parametrize("shape", SHAPES)
def test_every_picture_is_drawn(make_image, make_result, shape):
    """With and without axes and planes; each returns the axes it drew on, which hold something."""
    fixed, moving = make_image(shape, tilted=True), make_image(tuple(n - 2 for n in shape))
    result = make_result(fixed, moving)
    u, grid = result.displacement, fixed.grid
    pictures = {
        "image": lambda **how: report.plot_image(fixed, **how),
        "overlay": lambda **how: report.plot_overlay(fixed, moving, **how),
        "checkerboard": lambda **how: report.plot_checkerboard(fixed, moving, **how),
        "difference": lambda **how: report.plot_difference(fixed, moving, **how),
        "grid": lambda **how: report.plot_grid(u, fixed, background=moving, **how),
        "grid alone": lambda **how: report.plot_grid(u, grid, **how),
        "determinant": lambda **how: report.plot_determinant(u, fixed, **how),
        "divergence": lambda **how: report.plot_divergence(u, grid, **how),
        "curl": lambda **how: report.plot_curl(u, fixed, **how),
        "inverse error": lambda **how: report.plot_inverse_error(u, result.inverse, fixed, **how),
    }
    where = {} if len(shape) == 2 else {"plane": "sagittal", "index": 3}
    for name, draw in pictures.items():
        axes = Figure().add_subplot()
        assert draw(axes=axes, **where) is axes, name
        assert axes.images or axes.collections, name
        assert draw().get_figure() is not None, name
    for draw in (
        lambda a: report.plot_volume_histogram(u, fixed, axes=a),
        lambda a: report.plot_convergence(result, axes=a),
    ):
        axes = Figure().add_subplot()
        assert draw(axes) is axes
        assert axes.patches or axes.lines


@pytest.mark.parametrize("dim", [2, 3])
def test_maps_show_the_field_itself(make_displacement, axes, dim):
    grid = Grid((9, 11, 13)[-dim:], (1.0, 2.0, 0.5)[-dim:])
    u = make_displacement(grid, 0.1)
    plane = planes_of(Image(torch.zeros(1, 1, *grid.shape), grid))[0]
    report.plot_divergence(u, grid, axes=axes)
    expected = plane.cut(divergence(u, grid), [plane.middle])[0, 0]
    np.testing.assert_allclose(_shown(axes), expected, rtol=1e-6)
    report.plot_determinant(u, grid, limit=4.0, axes=axes)
    expected = plane.cut(jacobian_determinant(u, grid).log(), [plane.middle])[0, 0]
    np.testing.assert_allclose(_shown(axes), expected, rtol=1e-5, atol=1e-6)
    assert axes.images[-1].get_clim() == pytest.approx((-math.log(4), math.log(4)))


@pytest.mark.parametrize("dim", [2, 3])
def test_two_images_are_told_apart(axes, dim):
    """A ball against itself differs nowhere and is white; against nothing it is blue."""
    ball = _ball(dim)
    report.plot_difference(ball, ball, axes=axes)
    assert _shown(axes).max() == 0
    report.plot_overlay(ball, ball, axes=axes)
    np.testing.assert_allclose(_shown(axes)[8, 8], 1.0)
    other = Image(ball.data.roll(8, -1), ball.grid)
    report.plot_overlay(ball, other, axes=axes)
    np.testing.assert_allclose(_shown(axes)[8, 6], drawing.BLUE)
    np.testing.assert_allclose(_shown(axes)[8, 14], drawing.ORANGE)
    report.plot_checkerboard(ball, Image(1 - ball.data, ball.grid), tiles=2, axes=axes)
    assert _shown(axes)[6, 6] == 1 and _shown(axes)[6, 10] == 0  # noqa: PT018


def test_a_grid_is_drawn_where_the_map_takes_it():
    """A shift by two nodes along axis 0 moves all lines down by two."""
    grid = Grid((8, 10), (2.0, 1.0))
    u = torch.zeros(1, 2, 8, 10)
    u[:, 0] = 4.0
    plane = planes_of(Image(torch.zeros(1, 1, 8, 10), grid))[0]
    lines = drawing.moved_lines(plane, u[0], 10)
    assert sorted({float(line[0, 1]) for line in lines if np.ptp(line[:, 1]) == 0}) == [2.0 + k for k in range(8)]
    assert {len(line) for line in lines} == {8, 10}


@pytest.mark.parametrize(
    ("draw", "message"),
    [
        (lambda image, u: report.plot_image(image, plane="front"), "plane must be one of axial"),
        (lambda image, u: report.plot_image(image, index=99), "there is no slice 99"),
        (lambda image, u: report.plot_checkerboard(image, image, tiles=1), "at least 2 tiles"),
        (lambda image, u: report.plot_difference(image, image, limit=0.0), "must be positive"),
        (lambda image, u: report.plot_determinant(u, image, limit=1.0), "must be above 1"),
        (lambda image, u: report.plot_grid(u[:, :1], image), "plot_grid: u"),
        (lambda image, u: report.plot_inverse_error(u, u[:, :1], image), "plot_inverse_error: inverse"),
        (lambda image, u: report.plot_overlay(image, _ball(2)), "3D"),
    ],
)
def test_wrong_input_is_named(make_image, make_displacement, draw, message):
    image = make_image((8, 9, 10))
    with pytest.raises(InputError, match=message):
        draw(image, make_displacement(image.grid, 0.05))


def test_an_item_that_is_not_there_is_refused(make_image, make_result):
    fixed = make_image((12, 14))
    with pytest.raises(InputError, match="there is no item 1"):
        report.plot_convergence(make_result(fixed, fixed), item=1)
