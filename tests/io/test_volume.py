"""Volumes as readers find them."""

from pathlib import Path

import numpy as np
import pytest

from torchdeform.errors import InputError
from torchdeform.io.volume import Volume, require_one, squared


def _turn(seed: int) -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


@pytest.mark.parametrize("digits", [3, 4, 5, 6])
@pytest.mark.parametrize("seed", range(10))
def test_rounded_directions_become_square(seed, digits):
    """Both rotations and mirrored ones, and no entry moves further than the rounding."""
    found = squared(np.round(_turn(seed), digits), "a")
    np.testing.assert_allclose(found.T @ found, np.eye(3), atol=2e-6)
    np.testing.assert_allclose(found, _turn(seed), atol=1.5 * 10.0**-digits)


def test_square_directions_are_kept_to_the_bit():
    turn = _turn(0)
    assert squared(turn, "a") is turn


@pytest.mark.parametrize("shear", [0.01, 0.3, np.nan])
def test_sheared_axes_are_refused(shear):
    with pytest.raises(InputError, match="a has axes that are not at right angles"):
        squared(np.array([[1, shear, 0], [0, 1, 0], [0, 0, 1.0]]), "a")


def test_units_change_lengths_only():
    volume = Volume(np.zeros((2, 3, 4, 1)), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), np.eye(3))
    found = volume.in_units_of(1e-3, "µm")
    assert (found.size, found.unit) == ((4, 3, 2), "µm")
    assert found.spacing == pytest.approx((1e-3, 2e-3, 3e-3))
    assert found.origin == pytest.approx((4e-3, 5e-3, 6e-3))


@pytest.mark.parametrize("size", [(2,), (2, 3), (2, 3, 4), (2, 3, 4, 1), (2, 3, 4, 1, 1)])
def test_one_volume(size):
    require_one(Path("a.nii"), size)


@pytest.mark.parametrize(("size", "count"), [((2, 3, 4, 5), 5), ((2, 3, 4, 1, 6), 6)])
def test_a_series(size, count):
    with pytest.raises(InputError, match=rf"a\.nii is a series of {count} volumes"):
        require_one(Path("a.nii"), size)
