"""What searches share, against plain computations."""

import pytest
import torch
from scipy.ndimage import gaussian_filter

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.registration.matching import couple, displacements, features_of, gaussian, items_of, require_pair


@pytest.mark.parametrize("shape", [(20, 25), (9, 12, 14)])
def test_gaussian_is_that_of_scipy(shape):
    field = torch.rand(1, 1, *shape, dtype=torch.float64)
    wanted = gaussian_filter(field[0, 0].numpy(), 2.0, mode="mirror", truncate=8)
    torch.testing.assert_close(gaussian(field, 2.0)[0, 0], torch.from_numpy(wanted), rtol=1e-6, atol=1e-8)


def test_displacements_are_all_within_reach():
    labels = displacements((1, 2), torch.zeros(1))
    assert {tuple(d) for d in labels.tolist()} == {(a, b) for a in range(-1, 2) for b in range(-2, 3)}


def test_coupling_takes_the_cheapest_and_lets_neighbours_decide():
    labels = torch.arange(-3.0, 4.0).unsqueeze(1)
    cost = (labels - torch.tensor([[2.0, 2.0, -3.0, 2.0]])).square()
    cost[:, 2] *= 0.01  # the third point is hardly sure
    start = torch.zeros(1, 4)
    d, s = couple(cost, labels, lambda d: d, (1e-6,), start)
    assert d.tolist() == s.tolist() == [[2.0, 2.0, -3.0, 2.0]]
    d, _ = couple(cost, labels, lambda d: d.median().expand(1, 4), (0.1, 0.1), start)
    assert d.tolist() == [[2.0, 2.0, 2.0, 2.0]]
    wanted = (cost + 0.1 * (labels - 2).square()).argmin(0)
    assert d[0].tolist() == labels[wanted, 0].tolist()


def test_features_do_not_know_the_contrast():
    grid = Grid((32, 40))
    image, coarse = torch.rand(1, 1, *grid.shape), (Grid((32, 40)), grid.with_shape((16, 20)))
    torch.testing.assert_close(features_of(image, grid, *coarse), features_of(3 - 2 * image, grid, *coarse))


def test_masks_go_with_images():
    images, grid = torch.rand(2, 1, 8, 9), Grid((8, 9))
    assert items_of(None, images) == [None, None]
    assert [tuple(mask.shape) for mask in items_of(torch.ones(1, 1, 8, 9), images)] == [(1, 1, 8, 9)] * 2
    require_pair(images, images, {"mask": None}, grid, "search")
    with pytest.raises(InputError, match="search: mask must have shape"):
        require_pair(images, images, {"mask": torch.ones(3, 1, 8, 9)}, grid, "search")
