"""Random maps keep their bounds, go the same way for all they carry, and are known backwards."""

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.core.derivatives import curl
from torchdeform.core.diagnostics import diagnose, inverse_error
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.nn import RandomDeformation

GRIDS = [Grid((48, 40), (1.0, 1.5)), Grid((20, 16, 18), (1.0, 2.0, 1.0))]


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@settings(max_examples=25, deadline=None)
@given(
    shape=st.lists(st.integers(5, 24), min_size=2, max_size=3),
    high=st.floats(1.05, 8),
    low=st.floats(0.05, 0.95),
    turn=st.floats(0, 2),
    nodes=st.integers(2, 12),
    seed=st.integers(0, 2**31),
)
def test_bounds_always_hold(shape, high, low, turn, nodes, seed):
    grid = Grid(tuple(shape))
    deform = RandomDeformation(grid, determinant=(low, high), curl=turn, nodes=nodes)
    u = deform.draw(3, generator=seeded(seed)).displacement
    found = diagnose(u, grid)
    assert found.folds.tolist() == [0, 0, 0]
    assert float(found.smallest.min()) >= low * (1 - 1e-5)
    assert float(found.det_max.max()) <= high * (1 + 1e-5)
    assert float(curl(u, grid).abs().max()) <= turn * (1 + 1e-5) + 1e-6


@pytest.mark.parametrize("grid", GRIDS)
def test_maps_are_not_trivial_and_differ(grid):
    u = RandomDeformation(grid).draw(4, generator=seeded()).displacement
    assert float(u.abs().flatten(1).amax(1).min()) > 0.2
    assert not torch.equal(u[0], u[1])
    assert torch.equal(u, RandomDeformation(grid).draw(4, generator=seeded()).displacement)


@pytest.mark.parametrize("grid", GRIDS)
def test_image_label_and_points_go_together(grid):
    """A blob's brightest place and a point in its middle end up together."""
    deform = RandomDeformation(grid)
    middle = torch.tensor([side * 0.45 for side in grid.extent]).view(1, grid.dim, 1)
    distance = (grid.points() - middle.view(1, grid.dim, *[1] * grid.dim)).square().sum(1, keepdim=True)
    blob = torch.exp(-distance / 20).expand(2, -1, *grid.shape)
    labels = (distance < 16).long().expand(2, -1, *grid.shape)
    image, label, points = deform(blob, labels, middle.expand(2, -1, -1), generator=seeded(1))
    for item in range(2):
        weight = label[item, 0].double()
        centre = (grid.points()[0] * weight).flatten(1).sum(1) / weight.sum()
        assert torch.allclose(centre.float(), points[item, :, 0], atol=1.5 * max(grid.spacing))
        place = (image[item, 0] == image[item].max()).nonzero()[0] * torch.tensor(grid.spacing)
        assert torch.allclose(place, points[item, :, 0], atol=1.5 * max(grid.spacing))


@pytest.mark.parametrize("grid", GRIDS)
def test_inverse(grid):
    maps = RandomDeformation(grid).draw(2, generator=seeded())
    assert float(inverse_error(maps.displacement, maps.inverse, grid)[1].max()) < 1e-2
    assert maps.inverse is maps.inverse


def test_the_same_map_twice():
    deform = RandomDeformation(GRIDS[0])
    image = torch.rand(2, 1, *GRIDS[0].shape)
    maps = deform.draw(2, like=image)
    assert torch.equal(deform(image, maps=maps), deform(image, maps=maps))
    assert torch.equal(deform(image, generator=seeded(5)), copy.deepcopy(deform)(image, generator=seeded(5)))


def test_probability():
    deform = RandomDeformation(GRIDS[0], probability=0.5)
    u = deform.draw(40, generator=seeded()).displacement
    still = int((u.abs().flatten(1).amax(1) == 0).sum())
    assert 8 < still < 32
    none = RandomDeformation(GRIDS[0], probability=0.0)
    image = torch.rand(1, 1, *GRIDS[0].shape)
    assert torch.allclose(none(image), image, atol=1e-4)


def test_gradients_reach_the_image_and_types_stay():
    deform = RandomDeformation(GRIDS[0])
    image = torch.rand(1, 1, *GRIDS[0].shape, dtype=torch.float64).requires_grad_()
    deform(image).sum().backward()
    assert float(image.grad.abs().max()) > 0
    assert deform.draw(1, like=image).displacement.dtype == torch.float64
    assert deform(image.detach().half()).dtype == torch.float16


def test_wrong_input_is_refused():
    for options in ({"determinant": (1.2, 2.0)}, {"curl": -1.0}, {"nodes": 1}, {"probability": 2.0}):
        with pytest.raises(InputError, match="RandomDeformation"):
            RandomDeformation(GRIDS[0], **options)
