"""Displacements as the Learn2Reg challenge wants them: between voxels, read as its evaluation reads them."""

import pytest
import torch

from torchdeform.io import write_image
from torchdeform.io.transforms import voxel_displacement, write_voxel_displacement


def _pair(make_image, dim):
    """Return a fixed and a moving image that differ in size, spacing, place and orientation."""
    shapes, spacings = ((9, 8, 7), (8, 10, 9)), ((1.5, 1.0, 0.8), (1.0, 1.2, 1.1))
    fixed = make_image(shapes[0][:dim], spacings[0][:dim], origin=(3.0, -2.0, 1.0)[:dim])
    moving = make_image(shapes[1][:dim], spacings[1][:dim], origin=(2.0, -3.0, 0.5)[:dim], tilted=True)
    return fixed, moving


@pytest.mark.parametrize("dim", [2, 3])
def test_voxel_displacement_leads_to_the_same_point_of_the_world(make_image, make_displacement, dim):
    fixed, moving = _pair(make_image, dim)
    u = make_displacement(fixed.grid, 0.1)
    nodes = fixed.grid.points(dtype=torch.float64)
    index = nodes / fixed.grid.along(fixed.grid.spacing, nodes) + voxel_displacement(u, fixed, moving)
    there = moving.to_world(index * moving.grid.along(moving.grid.spacing, index))
    assert torch.allclose(there, fixed.to_world(nodes + u), atol=1e-9)


def test_submission_is_read_as_the_challenge_reads_it(make_image, make_displacement, tmp_path):
    """Its evaluation takes arrays from nibabel and samples moving at identity + displacement with map_coordinates."""
    nibabel = pytest.importorskip("nibabel")
    import numpy as np
    from scipy.ndimage import map_coordinates

    fixed, moving = _pair(make_image, 3)
    u = make_displacement(fixed.grid, 0.05)
    write_voxel_displacement(u, fixed, moving, tmp_path / "disp_0001_0002.nii.gz")
    write_image(moving, tmp_path / "moving.nii.gz")
    displacement = nibabel.load(tmp_path / "disp_0001_0002.nii.gz").get_fdata()
    values = nibabel.load(tmp_path / "moving.nii.gz").get_fdata()
    assert displacement.shape == (*fixed.grid.shape[::-1], 3)
    identity = np.meshgrid(*map(np.arange, displacement.shape[:3]), indexing="ij")
    warped = map_coordinates(values, identity + displacement.transpose(3, 0, 1, 2), order=1, cval=0.0)
    from torchdeform.core.image import resample

    ours = resample(moving, fixed, u)[0, 0].numpy().transpose()
    inside = (
        map_coordinates(np.ones_like(values), identity + displacement.transpose(3, 0, 1, 2), order=1, cval=-9.0) > 0.99
    )
    assert inside.mean() > 0.3
    assert np.abs(warped - ours)[inside].max() < 1e-2
