"""What the library promises on real images: overlap, a sound map, an inverse. Skipped where the images are absent."""

from pathlib import Path

import pytest
import torch
from registration import SETS, Case, judge

import torchdeform as td

pytestmark = pytest.mark.data


def outcome(case: Case, preset: str, **overrides: object) -> dict[str, float]:
    result = td.register(case.fixed, case.moving, td.load_settings(preset, overrides=overrides))
    assert result.diagnosis.folds.item() == 0
    assert result.diagnosis.det_min.item() > 0
    assert result.inverse_error_mean.item() < 0.05
    for level in result.levels:  # the best map is kept, so a level may gain nothing, but never lose
        assert torch.stack(level.similarity).max() >= level.similarity[0]
    assert result.similarity_after > result.similarity_before
    return judge(case, result.displacement)


def mean_dice(data_folder: Path, name: str) -> float:
    preset, cases = SETS[name]
    scores = [outcome(case, preset)["dice"] for case in cases(data_folder / name)]
    return sum(scores) / len(scores)


def test_brain_slices_of_different_people(data_folder):
    assert mean_dice(data_folder, "mindboggle_2d") >= 0.51


def test_hearts_from_systole_to_diastole(data_folder):
    assert mean_dice(data_folder, "heart_2d") >= 0.93


def test_a_large_change_of_shape_is_matched_to_the_pixel(data_folder):
    preset, cases = SETS["brain_morph_2d"]
    case = next(cases(data_folder / "brain_morph_2d"))
    found = outcome(case, preset)
    assert found["ratio"] <= 0.035
    assert found["determinant"] >= 0.1


def test_a_volume(data_folder):
    preset, cases = SETS["mouse_brain_3d"]
    case = next(cases(data_folder / "mouse_brain_3d"))
    found = outcome(case, preset, **{"optimiser.steps": [60, 20, 5]})  # the finest level costs most and changes little
    assert found["dice"] > found["before"] + 0.5
