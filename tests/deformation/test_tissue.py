"""What a map does to a label, against maps whose answer is known."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.deformation.tissue import label_fit
from torchdeform.errors import InputError

GRIDS = [Grid((20, 24), (1.0, 0.8)), Grid((14, 12, 13), (1.5, 1.0, 0.7))]


def block(grid: Grid, low: int, high: int) -> Tensor:
    inside = torch.zeros(1, 1, *grid.shape, dtype=torch.bool)
    inside[(..., *[slice(low, high)] * grid.dim)] = True
    return inside


def affine(grid: Grid, matrix: Tensor) -> Tensor:
    x = grid.points(dtype=torch.float64)
    return torch.einsum("ka,ba...->bk...", matrix, x - 3) + 3.5 - x


def rotation(dim: int) -> Tensor:
    turn = Rotation.from_rotvec([0.1, 0.2, 0.5][-dim:] if dim == 3 else [0, 0, 0.5]).as_matrix()[:dim, :dim]
    return torch.from_numpy(turn)


@pytest.mark.parametrize("low", [0, 3])
@pytest.mark.parametrize("grid", GRIDS)
def test_of_a_rigid_motion_nothing_is_left(grid, low):
    fit = label_fit(affine(grid, rotation(grid.dim)), block(grid, low, 9), grid)
    assert float(fit.rigid) < 1e-10
    assert float(fit.determinant) < 1e-12
    assert float(fit.volume) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("grid", GRIDS)
def test_of_a_stretched_label_all_is_known(grid):
    matrix = rotation(grid.dim) * 1.1
    inside = block(grid, 3, 9)
    fit = label_fit(affine(grid, matrix), inside, grid)
    assert float(fit.determinant) == pytest.approx(1.1**grid.dim - 1)
    assert float(fit.volume) == pytest.approx(1.1**grid.dim)
    # The best motion is the rotation about the centre: what is left is a tenth of the way there, turned, in voxels.
    half = torch.tensor([2.5 * h for h in grid.spacing]).double()
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * grid.dim)
    away = 0.1 * (signs * half) @ rotation(grid.dim).mT / torch.tensor(grid.spacing).double()
    assert float(fit.rigid) == pytest.approx(float(away.norm(dim=1).max()))


def test_the_determinant_leaves_one_node_in_a_thousand_out():
    grid = Grid((45, 45))
    u = 0.01 * torch.randn(1, 2, 45, 45, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inside = torch.zeros(1, 1, 45, 45, dtype=torch.bool)
    inside[..., 2:-3, 2:-3] = True
    off = (jacobian_determinant(u, grid) - 1).abs()[inside].sort(descending=True).values
    assert len(off) == 1600
    assert float(label_fit(u, inside, grid).determinant) == pytest.approx(float(off[1]))


def test_items_are_looked_at_one_by_one():
    grid = GRIDS[0]
    u = torch.cat([affine(grid, rotation(2)), affine(grid, rotation(2) * 1.2)]).float()
    fit = label_fit(u, block(grid, 3, 9), grid)
    assert fit.volume.dtype == torch.float32
    np.testing.assert_allclose(fit.volume, [1, 1.44], rtol=1e-5)
    empty = torch.cat([block(grid, 3, 9), block(grid, 3, 3)])
    assert [math.isnan(v) for v in label_fit(u, empty, grid).rigid.tolist()] == [False, True]


@pytest.mark.parametrize("inside", [torch.ones(2, 2, 20, 24).bool(), torch.ones(3, 1, 20, 24).bool()])
def test_other_than_one_label_is_refused(inside):
    with pytest.raises(InputError, match="label_fit: inside must be one label of 2 items or 1"):
        label_fit(torch.zeros(2, 2, 20, 24), inside, GRIDS[0])


def test_wrong_shapes_are_refused():
    with pytest.raises(InputError, match="label_fit: u must have shape"):
        label_fit(torch.zeros(2, 3, 20, 24), block(GRIDS[0], 3, 9), GRIDS[0])
    with pytest.raises(InputError, match="label_fit: inside must be bool"):
        label_fit(torch.zeros(2, 2, 20, 24), block(GRIDS[0], 3, 9).float(), GRIDS[0])
