"""The verdict: good only where nothing speaks against it, and the reasons are named with their numbers."""

import math
from dataclasses import replace

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.metrics.evaluation import Evaluation, Measures
from torchdeform.registration.tissue import TissueFit, TissueOutcome
from torchdeform.registration.verdict import BAD, GOOD, LOOK, judge, number

GRID = Grid((40, 50))
NONE = torch.empty(1, 0, dtype=torch.float64)


def labels(*stages: tuple[list[float], float]) -> Evaluation:
    """Return the measures of stages (before, aligned, after or before, after): Dice of each label, distance of all."""
    names = tuple(range(1, 1 + len(stages[0][0])))
    found = [Measures(names, torch.tensor([dice]), torch.full((1, len(dice)), far)) for dice, far in stages]
    return Evaluation(found[0], found[1] if len(found) > 2 else None, found[-1], "label")


def landmarks(before: list[float], after: list[float]) -> Evaluation:
    ends = (Measures((), NONE, NONE, torch.tensor([distances])) for distances in (before, after))
    return Evaluation(next(ends), None, next(ends))


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({}, GOOD, "The images fit (correlation 0.5 → 0.9"),
        ({"correlation_before": 1.0, "correlation": 1.0, "information_before": 1.0, "information": 1.0}, GOOD, "fit"),
        ({"information": 0.35}, LOOK, "little in common (0.35 of"),
        ({"information": math.nan}, LOOK, "little in common (– of"),
        ({"information": 0.1, "information_before": 0.1}, LOOK, "do not fit"),  # two contrasts
        ({"information": 0.1, "structure_before": 0.1}, BAD, "do not fit"),
        ({"correlation": 0.6}, LOOK, "hardly correlates (0.6;"),
        ({"disagreement": 0.3}, LOOK, "another one is found for 30%"),
        ({"extreme_inside": 0.2, "extreme": 0.1}, LOOK, "20% of what has contrast, 10% of all voxels"),
        ({"disagreement": 0.3, "extreme_inside": 0.2, "correlation": 0.6, "structure_before": 0.1}, BAD, "do not fit"),
        ({"information_before": 0.8}, LOOK, "less alike (information 0.8 → 0.7)"),
        ({"information_before": 0.95}, BAD, "less alike (information 0.95 → 0.7)"),
        ({"covered": 0.5}, LOOK, "covers only a part of the fixed one (50%"),
        ({"absent": 0.2}, LOOK, "(20% of what has contrast, where"),
        ({"inverse_error": 0.7}, LOOK, "0.7 voxels off"),
        ({"inverse_error": math.nan}, LOOK, "– voxels off"),
        ({"turned": ("x", "y")}, BAD, "turned over along x and y"),
    ],
)
def test_the_images_and_the_map_are_judged(fine_evidence, change, kind, words):
    verdict = judge(replace(fine_evidence, **change), GRID, folds=0)
    assert verdict.kind == kind
    assert any(words in finding.text for finding in verdict.findings)
    order = [(BAD, LOOK, GOOD).index(finding.kind) for finding in verdict.findings]
    assert order == sorted(order)


@pytest.mark.parametrize(
    ("evaluation", "kind", "words"),
    [
        (labels(([0.5], 4.0), ([0.7], 3.0)), GOOD, "better than before (mean Dice 0.5 → 0.7; 1 of 1 better, 0 worse)"),
        (labels(([0.75], 4.0), ([0.755], 4.0)), GOOD, "no better than before"),
        (labels(([0.5], 4.0), ([0.4], 3.0)), BAD, "overlap less than before (mean Dice 0.5 → 0.4)"),
        (labels(([0.0], 9.0), ([0.02], 9.0)), BAD, "do not overlap"),
        (labels(([0.1], 9.0), ([0.15], 9.0)), BAD, "do not overlap"),
        (labels(([0.5], 4.0), ([math.nan], math.inf)), GOOD, "images fit"),
        (labels(([0.5, 0.6], 4.0), ([0.9, 0.5], 3.0)), LOOK, "1 worse, most of all label 2: 0.6 → 0.5"),
        (labels(([0.5, 0.6, 0.6], 4.0), ([0.9, 0.5, 0.7], 3.0)), GOOD, "2 of 3 better, 1 worse"),
        (labels(([0.5], 4.0), ([0.7], 6.0)), LOOK, "(95 % Hausdorff distance 4 → 6 px"),
        (labels(([0.75], 2.0), ([0.7], 4.0), ([0.76], 2.0)), LOOK, "alignment lowered the overlap of the labels"),
        (labels(([0.75], 2.0), ([0.7], 4.0), ([0.9], 2.0)), GOOD, "better"),
        (landmarks([2.0, 2.0, 2.0], [1.0, 0.5, 0.5]), GOOD, "mean distance 2 → 0.667 px; 0 of 3 farther apart"),
        (landmarks([1.0], [1.0]), GOOD, "no nearer"),
        (landmarks([1.0], [2.0]), BAD, "farther apart than before"),
        (landmarks([30.0], [20.0]), BAD, "far apart (mean distance 30 → 20 px): are they the same points?"),
        (landmarks([3.0, 0.0], [0.1, 1.5]), LOOK, "1 of 2 farther apart"),
    ],
)
def test_labels_and_landmarks_are_judged_one_by_one(fine_evidence, evaluation, kind, words):
    verdict = judge(fine_evidence, GRID, folds=0, evaluation=evaluation)
    assert verdict.kind == kind
    assert any(words in finding.text for finding in verdict.findings)


def test_labels_that_do_not_follow_their_images_are_of_others(fine_evidence):
    """The fine evidence: correlation 0.5 → 0.9, so the images fit much better."""
    for after, kind in ((0.45, GOOD), (0.36, LOOK), (0.32, BAD)):
        found = labels(([0.2], 4.0), ([0.3], 4.0), ([after], 4.0))
        assert judge(fine_evidence, GRID, folds=0, evaluation=found).kind == kind
        near = replace(fine_evidence, correlation_before=0.88)
        assert judge(near, GRID, folds=0, evaluation=found).kind == GOOD


def test_labels_of_another_image_do_not_stand_out_from_it(fine_evidence):
    better = labels(([0.5], 4.0), ([0.8], 3.0))
    for contrast, kind in (((0.5, 0.4), GOOD), ((0.5, 0.1), BAD), ((0.05, 0.3), BAD), ((0.15, 0.01), GOOD)):
        known = replace(fine_evidence, label_contrast=contrast)
        assert judge(known, GRID, folds=0, evaluation=better).kind == kind


def test_distances_are_in_the_unit_of_the_file(fine_evidence):
    """Coordinates are in mm also where lengths are shown in µm."""
    small = Grid((40, 50), (0.001, 0.001))
    verdict = judge(fine_evidence, small, folds=0, evaluation=landmarks([0.004], [0.002]), unit="µm")
    assert "mean distance 4 → 2 µm" in verdict.findings[-1].text


@pytest.mark.parametrize(
    ("kind", "fit", "words"),
    [
        ("rigid", (0.49, 0.3, 1.1), None),
        ("rigid", (0.812, 0.3, 1.1), "The tissue of label 7 did not stay rigid (up to 0.812 voxels off its motion)."),
        ("rigid", (math.nan, math.nan, math.nan), None),
        ("incompressible", (3.0, 0.04, 1.0), None),
        ("incompressible", (0.0, 0.062, 1.0), "did not keep its volume (the determinant is up to 6% off 1)."),
        ("stiff", (3.0, 0.5, 1.4), None),
        ("own", (3.0, 0.5, 1.4), None),
    ],
)
def test_tissue_that_is_not_what_it_was_to_be_is_a_reason_to_look(fine_evidence, kind, fit, words):
    after = TissueFit(*(torch.tensor([value], dtype=torch.float64) for value in fit))
    outcome = TissueOutcome(7, kind, False, torch.tensor([9]), after, after)
    verdict = judge(fine_evidence, GRID, folds=0, tissue=(outcome,))
    assert verdict.kind == (GOOD if words is None else LOOK)
    assert words is None or words in verdict.findings[0].text
    assert words is None or "label 7 did not" in verdict.headline


def test_folds_are_bad_and_counted(fine_evidence):
    verdict = judge(fine_evidence, GRID, folds=2345)
    assert (verdict.kind, verdict.headline) == (BAD, "Do not use this: the map folds.")
    assert verdict.findings[0].figures == {"folds": 2345}
    assert "2,345 voxels" in verdict.findings[0].text


def test_the_headline_has_the_main_reason(fine_evidence):
    verdict = judge(replace(fine_evidence, covered=0.5), GRID, folds=0)
    assert verdict.headline == "Look closely before you use this: the moving image covers only a part of the fixed one."


def test_a_warning_is_a_reason_to_look(fine_evidence):
    verdict = judge(fine_evidence, GRID, folds=0, warnings=("a.png is odd; see to it",))
    assert (verdict.kind, verdict.headline) == (LOOK, "Look closely before you use this: a.png is odd; see to it.")


def test_a_mirror_image_is_named_by_how_much_better_it_would_fit(fine_evidence):
    for mirror, kind in ((1.05, GOOD), (1.15, LOOK), (1.5, BAD)):
        assert judge(fine_evidence, GRID, folds=0, mirror=mirror).kind == kind


def test_labels_that_fit_outweigh_images_that_cannot_be_compared(fine_evidence):
    apart = {"information": 0.05, "correlation": 0.2, "information_before": 0.05, "correlation_before": 0.2}
    unlike = replace(fine_evidence, **apart, structure_before=0.1)
    better, same = (labels(([0.7], 4.0), ([end], 4.0)) for end in (0.85, 0.705))
    assert judge(unlike, GRID, folds=0).kind == BAD
    assert judge(unlike, GRID, folds=0, evaluation=better).kind == LOOK
    assert judge(unlike, GRID, folds=0, evaluation=same).kind == BAD
    assert judge(unlike, GRID, folds=1, evaluation=better).kind == BAD


def test_a_result_of_one_pair_has_a_verdict(make_image, make_result):
    image = make_image((20, 24))
    result = make_result(image, image)
    assert result.verdict.kind == GOOD
    assert replace(result, warnings=("odd",)).verdict.kind == LOOK
    with pytest.raises(InputError, match="2 pairs"):
        _ = replace(result, evidence=result.evidence * 2).verdict


def test_numbers_are_short():
    assert [number(v) for v in (0.12345, 12345.6, 0.0, None, math.inf)] == ["0.123", "12346", "0", "–", "–"]
