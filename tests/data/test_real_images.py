"""What the library promises on real images: overlap, a sound map, an inverse. Skipped where the images are absent."""

from pathlib import Path

import numpy as np
import pytest
import torch
from judge import quality, to_array
from numpy.typing import ArrayLike
from pairs import SETS, Pair
from reading import images
from torch import Tensor

import torchdeform as td

pytestmark = pytest.mark.data


def sound(fixed: Tensor | td.Image, moving: Tensor | td.Image, preset: str = "default", **overrides: object):
    """Register, and check what holds on any images."""
    result = td.register(fixed, moving, td.load_settings(preset, overrides=overrides))
    assert result.diagnosis.folds.item() == 0
    assert result.diagnosis.det_min.item() > 0
    assert result.inverse_error_mean.item() < 0.05
    for level in result.levels:  # the best map is kept, so a level may gain nothing, but never lose
        assert torch.stack(level.similarity).max() >= level.similarity[0]
    assert result.similarity_after > result.similarity_before
    return result


def dice(pair: Pair, **overrides: object) -> float:
    """Mean Dice after registration."""
    fixed, moving = images(pair)
    result = sound(fixed, moving, **overrides)
    there = fixed.to_world(fixed.grid.points(dtype=torch.float64) + result.displacement)
    return quality(pair, fixed, to_array(there if result.affine is None else result.affine(there)))["dice"]


def mean_dice(data_folder: Path, name: str) -> float:
    return float(np.mean([dice(pair) for pair in SETS[name](data_folder)]))


def test_brain_slices_of_different_people(data_folder):
    assert mean_dice(data_folder, "mindboggle_2d") >= 0.51


def test_hearts_from_systole_to_diastole(data_folder):
    assert mean_dice(data_folder, "heart_2d") >= 0.93


def test_a_large_change_of_shape_is_matched_to_the_pixel(data_folder):
    skimage = pytest.importorskip("skimage")
    pictures = [skimage.io.imread(data_folder / "brain_morph_2d" / f"I_{n}.png")[..., :3] for n in ("large", "little")]
    grey = [skimage.color.rgb2gray(picture) for picture in pictures]
    fixed, moving = (_tensor(skimage.transform.resize(g, (129, 129), anti_aliasing=True)) for g in grey)
    result = sound(fixed, moving, "shape")
    left = (td.warp(moving, result.displacement, result.grid) - fixed).square().sum()
    assert left <= 0.035 * (moving - fixed).square().sum()
    assert result.diagnosis.det_min >= 0.1


def _tensor(array: ArrayLike) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))[None, None]


def test_a_volume(data_folder):
    first, *_ = SETS["mouse_brain_3d"](data_folder)
    # The finest level costs most and changes little. 0.11 before.
    assert dice(first, **{"optimiser.steps": [60, 20, 5]}) > 0.61
