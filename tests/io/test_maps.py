"""B-splines become fields that are close to them everywhere in their domain."""

import numpy as np
import pytest
import SimpleITK as sitk

from torchdeform.errors import InputError
from torchdeform.io.maps import Linear, Spline
from torchdeform.io.volume import Volume


def spline(shape, spacing, order=3, size=1.0, seed=0):
    vectors = np.random.default_rng(seed).normal(0, size, (*shape, len(shape)))
    dim = len(shape)
    direction = np.linalg.qr(np.random.default_rng(3).normal(size=(dim, dim)))[0]
    return Spline(Volume(vectors, spacing, tuple(np.arange(dim) * 7.0 - 30), direction), order)


def itk_of(one):
    mesh = one.coefficients
    images = [sitk.GetImageFromArray(np.ascontiguousarray(mesh.values[..., k])) for k in range(len(mesh.size))]
    for image in images:
        image.SetOrigin(mesh.origin)
        image.SetSpacing(mesh.spacing)
        image.SetDirection(mesh.direction.ravel().tolist())
    return sitk.BSplineTransform(images, one.order)


def linear(field, index):
    """Return the field at an index (x, y, z) by multilinear interpolation."""
    image = sitk.GetImageFromArray(field.values, isVector=True)
    return np.array(image.EvaluateAtContinuousIndex(index.tolist(), sitk.sitkLinear))


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(
    ("shape", "spacing"), [((9, 7), (6.0, 9.0)), ((6, 7, 5), (8.0, 12.0, 10.0)), ((8, 9), (0.02, 0.03))]
)
def test_the_field_is_within_the_bound_of_itks_spline(shape, spacing, order):
    size = 0.1 * min(spacing)
    one = spline(shape, spacing, order, size)
    itk, field, draw = itk_of(one), one.dense("a.tfm"), np.random.default_rng(1)
    corner = np.array(field.size) - 1
    bound = min(0.02, 0.01 * min(spacing))
    errors = []
    for _ in range(300):
        index = draw.uniform(0, 1, len(shape)) * corner
        point = field.origin + field.direction @ (np.array(field.spacing) * index)
        errors.append(np.linalg.norm(point + linear(field, index) - itk.TransformPoint(point.tolist())))
    assert max(errors) < bound
    assert max(errors) > 1e-3 * bound or order == 1  # and not finer than asked for


def test_the_domain_is_that_of_itk():
    """Just inside its corners the spline is there, just outside it is not."""
    one = spline((6, 7), (8.0, 12.0))
    itk, field = itk_of(one), one.dense("a.tfm")
    size = np.array(field.size) - 1
    for corner in np.ndindex(2, 2):
        inwards = np.where(np.array(corner) == 1, -1, 1)
        for share, there in ((1e-3, True), (-1e-3, False)):
            point = field.origin + field.direction @ (np.array(field.spacing) * (corner * size + share * inwards))
            assert (np.linalg.norm(np.array(itk.TransformPoint(point.tolist())) - point) > 1e-3) == there


def test_a_rough_spline_is_as_fine_as_a_cell_asks_for(monkeypatch):
    one = spline((9, 9, 9), (10.0,) * 3, size=2.0)
    fine = one.dense("a.tfm").values.size
    monkeypatch.setattr("torchdeform.io.maps._NODES", fine // 3 - 1)
    assert one.dense("a.tfm").values.size < fine
    monkeypatch.setattr("torchdeform.io.maps._NODES", 1000)
    with pytest.raises(InputError, match=r"a\.tfm holds a B-spline that is too rough for a field; sample it on the"):
        one.dense("a.tfm")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_numbers_that_make_no_field(value):
    one = spline((6, 7), (8.0, 12.0))
    one.coefficients.values[2, 3, 0] = value
    with pytest.raises(InputError, match=r"a\.tfm holds a B-spline"):
        one.dense("a.tfm")


@pytest.mark.parametrize(("shape", "order"), [((3, 7), 3), ((7, 2), 2), ((7, 7), 0)])
def test_too_few_coefficients_or_steps(shape, order):
    with pytest.raises(InputError, match=r"is stepped, has no domain"):
        spline(shape, (8.0, 12.0), order).dense("a.tfm")


def test_a_rotation_about_a_point_leaves_it():
    centre, turn = np.array([3.0, 4.0]), np.array([[0.0, -1.0], [1.0, 0.0]])
    found = Linear.about(centre, turn, np.array([0.5, 0.0]))
    np.testing.assert_allclose(found.matrix @ centre + found.offset, (3.5, 4.0))
