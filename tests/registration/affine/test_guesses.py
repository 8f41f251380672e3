"""How large things may be: what headers and contents say, and which image is the smaller one then."""

import pytest
import torch
from pictures import blobs

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.registration.affine.guesses import guessed
from torchdeform.registration.affine.objective import MaskedImage


def masked(shape: tuple[int, int], spacing: float) -> MaskedImage:
    return MaskedImage(Image(blobs(shape, 1), Grid(shape, (spacing, spacing))))


@pytest.mark.parametrize("spacing", [0.7, 1.0, 1.5])
def test_fields_of_about_one_size_leave_no_doubt(spacing):
    (guess,) = guessed(masked((40, 50), 1.0), masked((40, 50), spacing), scale=True)
    assert (guess.size, guess.part, guess.swapped) == (None, False, False)
    assert guess.sizes == (0.0, torch.inf)


@pytest.mark.parametrize("ratio", [1e-4, 0.125, 8.0, 1e4])
def test_one_content_in_other_units_has_two_sizes(ratio):
    """That of the headers, where the smaller one is a part of the larger one, and that of equal pixels."""
    headers, pixels = guessed(masked((40, 50), 1.0), masked((40, 50), ratio), scale=True)
    assert (headers.size, headers.part, headers.swapped) == (1.0, True, ratio < 1)
    assert headers.fixed.image.grid.volume < headers.moving.image.grid.volume
    assert pixels.size == pytest.approx(ratio)
    assert (pixels.part, pixels.swapped) == (False, False)


def test_a_part_without_spacing_may_have_pixels_of_the_same_size():
    found = guessed(masked((80, 90), 0.25), masked((30, 30), 1.0), scale=True)
    assert any(
        guess.size == pytest.approx(0.25) and guess.swapped and guess.part for guess in found
    )  # of the other way


def test_a_rigid_map_keeps_the_size_of_the_headers():
    (guess,) = guessed(masked((80, 90), 1.0), masked((20, 20), 1.0), scale=False)
    assert (guess.size, guess.part, guess.swapped) == (1.0, True, True)
