"""A part is found where it was cut out, to the pixel."""

from dataclasses import replace

import pytest
import torch
from pictures import blobs

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.registration.affine.objective import MaskedImage
from torchdeform.registration.affine.parts import part_places

WHOLES = {2: (60, 72), 3: (28, 32, 30)}


@pytest.mark.parametrize("size", [1e-3, 1.0, 50.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_best_place_is_where_a_part_was_cut_out(dim, sign, size):
    first, side = (17, 40, 9)[:dim] if dim == 2 else (9, 17, 6), 16 if dim == 2 else 10
    whole = Image(blobs(WHOLES[dim], 3), Grid(WHOLES[dim], (size,) * dim))
    cut = (slice(None), slice(None), *(slice(k, k + side) for k in first))
    part = Image(sign * whole.data[cut] + 2.0, Grid((side,) * dim))
    linear = size * torch.eye(dim, dtype=torch.float64)
    (fit, place), *others = part_places(MaskedImage(part), MaskedImage(whole), linear, 3)
    expected = torch.tensor([k + (side - 1) / 2 for k in first[::-1]], dtype=torch.float64)
    assert fit == pytest.approx(1, abs=0.02)
    assert ((place / size - expected).abs() < 0.5).all()
    assert all(other < fit for other, _ in others)


def test_what_a_mask_leaves_out_does_not_count():
    whole = Image(blobs((60, 72), 3), Grid((60, 72)))
    data, weight = whole.data[:, :, 20:40, 30:54].clone(), torch.ones(1, 1, 20, 24)
    data[:, :, :8], weight[:, :, :8] = 50.0, 0.0
    part = MaskedImage(Image(data, Grid((20, 24))), weight)
    fit, place = part_places(part, MaskedImage(replace(whole)), torch.eye(2, dtype=torch.float64), 1)[0]
    assert fit == pytest.approx(1, abs=0.02)
    torch.testing.assert_close(place, torch.tensor([41.5, 29.5], dtype=torch.float64))


def test_nothing_is_seen_where_the_large_image_is_flat():
    whole = Image(torch.zeros(1, 1, 40, 40), Grid((40, 40)))
    part = Image(blobs((10, 10), 1), Grid((10, 10)))
    assert part_places(MaskedImage(part), MaskedImage(whole), torch.eye(2, dtype=torch.float64), 3) == []
