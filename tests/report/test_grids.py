"""Moved grids: their lines go through the nodes, panels share a scale, volumes are cut open."""

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.report.grids import draw_cutaway, draw_plane, write_grids


def test_lines_go_through_the_nodes():
    points = Grid((4, 6), (2.0, 0.5)).points() + 0.1 * torch.rand(1, 2, 4, 6)
    axes = Figure().add_subplot()
    draw_plane(axes, points, "moved")
    lines = axes.collections[0].get_segments()
    assert len(lines) == 4 + 6
    np.testing.assert_allclose(lines[1], points[0, :, 1].flip(0).T, rtol=1e-6)
    np.testing.assert_allclose(lines[4 + 2], points[0, :, :, 2].flip(0).T, rtol=1e-6)
    bottom, top = axes.get_ylim()
    assert bottom > top  # axis 0 downwards


def test_a_volume_shows_three_faces_with_a_quarter_cut_out():
    axes = Figure().add_subplot(projection="3d")
    draw_cutaway(axes, Grid((4, 5, 7)).points(), "box")
    assert len(axes.collections[0].get_paths() or axes.collections[0]._faces) == 3 * 4 + 3 * 6 + 4 * 6


@pytest.mark.parametrize("shape", [(9, 12), (6, 7, 8)])
def test_a_file_is_drawn(tmp_path, shape):
    grid = Grid(shape)
    picture = torch.rand(1, 1, *shape) if grid.dim == 2 else None
    write_grids(tmp_path / "grids.png", {"given": grid.points(), "moved": 1.5 * grid.points()}, picture)
    drawn = read_image(tmp_path / "grids.png").data
    assert drawn.shape[3] > 1.5 * drawn.shape[2]  # panels side by side
    assert drawn[:, :3].std() > 5


@pytest.mark.parametrize("draw", [draw_plane, draw_cutaway])
def test_other_points_are_refused(draw):
    with pytest.raises(InputError, match="a grid is drawn from points"):
        draw(Figure().add_subplot(), torch.zeros(2, 2, 4, 5), "two")
