"""An image without symmetry, so that mirrored axes show."""

import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image

SHAPES = {2: (40, 52), 3: (22, 26, 30)}


def lopsided(dim: int, **how) -> Image:
    """An image that no turn takes to itself: three blobs of different weight."""
    grid = Grid(SHAPES[dim], (2.0, 1.0, 1.5)[-dim:])
    x = grid.points() / grid.along(grid.extent, grid.points())
    centres = torch.tensor([[0.25, 0.3, 0.7], [0.6, 0.75, 0.65], [0.7, 0.3, 0.25]])[:, :dim]
    data = torch.zeros(1, 1, *grid.shape)
    for centre, weight in zip(centres, (1.0, 0.5, 0.8), strict=True):
        distance = (x - centre.view(1, -1, *([1] * dim))).square().sum(1, keepdim=True)
        data = data + weight * torch.exp(-distance / 0.03)
    noise = torch.rand(data.shape, generator=torch.manual_seed(0))
    return Image(100 * data + noise, grid, **({"name": "fixed.nii"} | how))
