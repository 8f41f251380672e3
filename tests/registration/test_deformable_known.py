"""Maps that are known: an image with itself stays where it is, and a pair moved by a map comes back to it."""

import math
from functools import cache

import pytest
import skimage.data
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pictures import bend, blobs
from skimage.color import rgb2gray
from skimage.transform import resize
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine, Transform
from torchdeform.pipeline.config import load_settings, preset_names
from torchdeform.registration.deformable import register

SIZE = (144, 160)
PICTURES = ("camera", "coins", "page", "brick", "astronaut", "blobs", "regions")
SLOW = settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@cache
def picture(name: str) -> Tensor:
    """A picture that scikit-image ships, or one of our own, ``(1, 1, *SIZE)``."""
    if name == "blobs":
        return blobs(SIZE, 5)
    if name == "regions":
        data = skimage.data.binary_blobs(200, rng=1).astype(float)
    else:
        data = getattr(skimage.data, name)()
    data = rgb2gray(data) if data.ndim == 3 else data
    return torch.tensor(resize(data.astype(float), SIZE, anti_aliasing=True), dtype=torch.float32)[None, None]


def points_of(grid: Grid) -> Tensor:
    """Points of the middle half."""
    sides = [torch.linspace(0.25 * side, 0.75 * side, 9, dtype=torch.float64) for side in grid.extent]
    return torch.stack(torch.meshgrid(*sides, indexing="ij")).flatten(1).unsqueeze(0)


@pytest.mark.parametrize("preset", [name for name in preset_names() if name != "reference"])
@pytest.mark.parametrize("align", ["affine", "none"])
@pytest.mark.parametrize("symmetric", [False, True])
def test_an_image_registered_to_itself_moves_no_point(preset, align, symmetric):
    """JPEG noise in a flat background, or none: no point moves by more than 0.01 voxel."""
    generator = torch.Generator().manual_seed(0)
    flat = picture("coins").clone()
    flat[..., :60] = 60 / 255 + 0.01 * torch.randn(flat[..., :60].shape, generator=generator).round()
    image = Image(255 * flat, Grid(SIZE))
    chosen = load_settings(preset, overrides={"align.kind": align, "symmetric": symmetric})
    result = register(image, image, chosen)
    world = image.to_world(image.grid.points(dtype=torch.float64)).flatten(2)
    map_ = Transform.from_displacement(result.displacement.double(), image, affine=result.affine)
    assert (map_.points(world) - world).norm(dim=1).max() <= 0.01
    assert result.similarity_after.item() >= 0.99
    assert result.verdict.kind == "good"


@given(
    name=st.sampled_from(PICTURES),
    degrees=st.floats(-25, 25),
    shift=st.tuples(st.floats(-12, 12), st.floats(-12, 12)),
    stretch=st.tuples(st.floats(0.9, 1.1), st.floats(0.9, 1.1)),
    amplitude=st.sampled_from([0.0, 3.0]),
)
@SLOW
def test_a_pair_moved_by_a_known_map_comes_back_to_it(name, degrees, shift, stretch, amplitude):
    """Shift, rotation, stretch and a smooth warp of pictures: points of the middle go where they should."""
    moving = Image(picture(name), Grid(SIZE), name="moving")
    turn = math.radians(degrees)
    linear = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]], dtype=torch.float64)
    linear = linear @ torch.diag(torch.tensor(stretch, dtype=torch.float64))
    middle = torch.tensor([(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2], dtype=torch.float64)
    affine = Affine(linear, middle + torch.tensor(shift, dtype=torch.float64) - linear @ middle)
    true = Transform.from_displacement(bend(moving.grid, amplitude).double(), moving, affine=affine)
    fixed = true.image(moving, moving, outside="auto")
    result = register(fixed, moving, load_settings("default"))
    found = Transform.from_displacement(result.displacement.double(), fixed, affine=result.affine)
    world = fixed.to_world(points_of(fixed.grid))
    assert (found.points(world) - true.points(world)).norm(dim=1).mean() < 0.5
    assert result.diagnosis.folds.item() == 0
    assert result.similarity_after >= result.similarity_before
