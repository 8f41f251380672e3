"""Property: whatever place an image has in the world, writing and reading keep it, and other readers agree."""

import gzip
import math
import shutil

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.io import read_image, write_image

ENDINGS = [".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr"]
TOLERANCE = {".nii": 2e-6, ".nii.gz": 2e-6}  # single precision in the header; text elsewhere


@st.composite
def images(draw):
    """Any oblique direction (also mirrored), any spacing, far origins, 2D and 3D, one channel or several."""
    dim = draw(st.sampled_from([2, 3]))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    direction, _ = np.linalg.qr(rng.normal(size=(dim, dim)))
    spacing = tuple(draw(st.floats(0.01, 20.0)) for _ in range(dim))
    origin = tuple(draw(st.floats(-2000.0, 2000.0)) for _ in range(dim))
    channels = draw(st.sampled_from([1, 2, 3]))
    data = torch.from_numpy(rng.random((1, channels, *rng.integers(2, 7, dim))).astype(np.float32))
    return Image(data, Grid(tuple(data.shape[2:]), spacing), origin, tuple(map(tuple, direction)))


@pytest.mark.parametrize("ending", ENDINGS)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(image=images())
def test_writing_and_reading_keep_the_place(tmp_path, ending, image):
    path = tmp_path / f"a{ending}"
    write_image(image, path)
    back, tolerance = read_image(path), TOLERANCE.get(ending, 1e-9)
    assert torch.equal(back.data, image.data)
    np.testing.assert_allclose(back.grid.spacing, image.grid.spacing, rtol=tolerance)
    np.testing.assert_allclose(back.origin, image.origin, rtol=tolerance, atol=1e-4 if tolerance > 1e-8 else 1e-9)
    np.testing.assert_allclose(back.direction, image.direction, atol=max(tolerance, 1e-8))


@pytest.mark.parametrize("ending", ENDINGS)
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(image=images())
def test_itk_sees_each_voxel_where_we_do(tmp_path, ending, image):
    path = tmp_path / f"a{ending}"
    write_image(image, path)
    theirs, ours = sitk.ReadImage(str(path)), read_image(path)
    world = ours.to_world(ours.grid.points(dtype=torch.float64))
    last = tuple(n - 1 for n in theirs.GetSize())
    place = world[(0, slice(None), *last[::-1])].numpy()
    expected = theirs.TransformIndexToPhysicalPoint(last)
    np.testing.assert_allclose(place, expected, atol=1e-6 * (1 + np.abs(expected).max()))


@pytest.mark.parametrize("ending", [".mha", ".nrrd", ".nii", ".tif", ".png", ".jpg"])
def test_gzip_around_any_format(tmp_path, make_image, ending):
    picture = ending in (".tif", ".png", ".jpg")
    image = make_image((20, 30), pixel_type="uint8" if picture else "float32")
    write_image(image, tmp_path / f"a{ending}")
    with gzip.open(tmp_path / f"b{ending}.gz", "wb") as packed, (tmp_path / f"a{ending}").open("rb") as plain:
        shutil.copyfileobj(plain, packed)
    plain, packed = read_image(tmp_path / f"a{ending}"), read_image(tmp_path / f"b{ending}.gz")
    assert torch.equal(plain.data, packed.data)
    assert (plain.grid, plain.origin, plain.direction) == (packed.grid, packed.origin, packed.direction)
    assert packed.name.endswith(f"b{ending}.gz")


def test_flipped_and_permuted_axes_are_kept(tmp_path):
    """The 48 ways to store a volume along the world's axes."""
    from itertools import permutations, product

    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        direction = np.zeros((3, 3))
        for column, (row, sign) in enumerate(zip(order, signs, strict=True)):
            direction[row, column] = sign
        image = Image(
            torch.rand(1, 1, 3, 4, 5), Grid((3, 4, 5), (3.0, 2.0, 1.0)), (1, 2, 3), tuple(map(tuple, direction))
        )
        for ending in (".nii", ".mha", ".nrrd"):
            write_image(image, tmp_path / f"a{ending}")
            back = read_image(tmp_path / f"a{ending}")
            np.testing.assert_allclose(back.direction, direction, atol=1e-6)
            assert math.prod(back.grid.shape) == 60
