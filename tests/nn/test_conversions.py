"""Fields of other libraries: the same image comes out of their samplers and ours."""

import warnings

import numpy as np
import pytest
import torch

from torchdeform import nn as layers
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.warp import warp
from torchdeform.errors import InputError

GRIDS = [Grid((13, 17), (1.0, 1.5)), Grid((9, 11, 10), (2.0, 1.0, 1.5))]
ROUND_TRIPS = [
    (layers.to_voxels, layers.from_voxels, {}),
    (layers.to_grid_sample, layers.from_grid_sample, {}),
    (layers.to_grid_sample, layers.from_grid_sample, {"displacement": True}),
    (layers.to_itk, layers.from_itk, {}),
]


@pytest.fixture(params=GRIDS, ids=["2D", "3D"])
def grid(request) -> Grid:
    return request.param


@pytest.fixture
def field(grid, make_displacement):
    return make_displacement(grid, 0.1)


@pytest.fixture
def image(grid):
    return torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("there", "back", "options"), ROUND_TRIPS)
def test_there_and_back(there, back, options, grid, field):
    assert torch.allclose(back(there(field, grid, **options), grid, **options), field, atol=1e-5)


def test_grid_sample(grid, field, image):
    positions = layers.to_grid_sample(field, grid)
    theirs = torch.nn.functional.grid_sample(image, positions, padding_mode="border", align_corners=True)
    assert torch.allclose(theirs, warp(image, field, grid), atol=1e-5)


def test_kornia_remap(make_displacement):
    """kornia's remap takes the same positions, x and y apart."""
    kornia = pytest.importorskip("kornia")
    grid = GRIDS[0]
    u, image = make_displacement(grid, 0.1), torch.rand(1, 1, *grid.shape)
    x, y = layers.to_grid_sample(u, grid).unbind(-1)
    theirs = kornia.geometry.transform.remap(
        image, x, y, padding_mode="border", align_corners=True, normalized_coordinates=True
    )
    assert torch.allclose(theirs, warp(image, u, grid), atol=1e-5)


def test_monai_warp(grid, field, image):
    blocks = pytest.importorskip("monai.networks.blocks")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = blocks.Warp("bilinear", "border")(image, layers.to_voxels(field, grid))
    assert torch.allclose(torch.as_tensor(theirs), warp(image, field, grid), atol=1e-5)


def test_voxelmorph(grid, field, image):
    """VoxelMorph continues images by 0; the field keeps Ω, so that makes no difference."""
    modules = pytest.importorskip("voxelmorph.nn.modules")
    theirs = modules.SpatialTransformer()(image, layers.to_voxels(field, grid))
    assert torch.allclose(theirs, warp(image, field, grid), atol=1e-4)


def test_voxels_are_what_they_are_called(grid):
    """The documented convention of VoxelMorph and MONAI: component k counts voxels along array axis k."""
    u = torch.ones(1, grid.dim, *grid.shape)
    for k, spacing in enumerate(grid.spacing):
        assert torch.allclose(layers.to_voxels(u, grid)[:, k], torch.tensor(1 / spacing))


def test_itk(grid, field, image, make_image):
    sitk = pytest.importorskip("SimpleITK")
    place = make_image(grid.shape, grid.spacing, tilted=True, origin=(5.0, -3.0, 2.0)[: grid.dim])
    vectors = layers.to_itk(field, grid, place.direction)
    theirs = sitk.GetImageFromArray(vectors[0].double().numpy(), isVector=True)
    moving = sitk.GetImageFromArray(image[0, 0].double().numpy())
    for itk in (theirs, moving):
        set_place(itk, place)
    resampled = sitk.Resample(moving, moving, sitk.DisplacementFieldTransform(theirs), sitk.sitkLinear, -1.0)
    found = torch.from_numpy(sitk.GetArrayFromImage(resampled)).float()
    inside = found >= 0  # at the faces ITK finds points outside by rounding
    assert inside.float().mean() > 0.5
    assert torch.allclose(found[inside], warp(image, field, grid)[0, 0][inside], atol=1e-4)
    assert torch.allclose(layers.from_itk(vectors, grid, place.direction), field, atol=1e-4)


def set_place(itk, place: Image) -> None:
    itk.SetOrigin(place.origin)
    itk.SetSpacing(place.grid.spacing[::-1])
    itk.SetDirection(np.ravel(place.direction).tolist())


@pytest.mark.parametrize("there", [layers.to_voxels, layers.from_voxels, layers.to_grid_sample, layers.to_itk])
def test_a_field_of_another_grid_is_refused(there):
    with pytest.raises(InputError, match="must have shape"):
        there(torch.zeros(1, 2, 4, 4), GRIDS[0])


@pytest.mark.parametrize("back", [layers.from_grid_sample, layers.from_itk])
def test_components_must_come_last(back):
    with pytest.raises(InputError, match="must have shape"):
        back(torch.zeros(1, 2, *GRIDS[0].shape), GRIDS[0])


def test_a_direction_of_another_size_is_refused():
    with pytest.raises(InputError, match="direction"):
        layers.to_itk(torch.zeros(1, 2, *GRIDS[0].shape), GRIDS[0], ((1.0, 0.0, 0.0),) * 3)
