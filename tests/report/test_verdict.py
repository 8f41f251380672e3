"""The headline: it says good only where nothing speaks against it, and names what does."""

import math

import pytest

from torchdeform.report.verdict import BAD, DOUBTFUL, GOOD, judge, number

FINE = {
    "unit": "mm",
    "folds": 0,
    "similarity_before": 0.2,
    "similarity_after": 0.6,
    "determinant_min": 0.4,
    "determinant_max": 2.0,
    "inverse_error_max": 0.1,
}


def _measured(key: str, before: float, after: float) -> dict[str, object]:
    return {"evaluation": {"before": {key: before}, "after": {key: after}}}


@pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        ({}, GOOD, "more similar"),
        ({"folds": 1}, BAD, "folds at 1 voxel:"),
        ({"folds": 2345}, BAD, "folds at 2,345 voxels"),
        ({"similarity_after": 0.1}, BAD, "less similar"),
        ({"similarity_after": math.nan}, BAD, "not a number"),
        ({"similarity_after": None}, BAD, "not a number"),
        ({"similarity_after": 0.2005}, DOUBTFUL, "hardly changed"),
        ({"similarity_before": -0.5, "similarity_after": -0.1}, GOOD, "-0.5 → -0.1"),
        ({"similarity_before": -0.1, "similarity_after": -0.5}, BAD, "less similar"),
        ({"determinant_max": 11.0}, DOUBTFUL, "more than tenfold"),
        ({"determinant_min": 0.05}, DOUBTFUL, "more than tenfold"),
        ({"inverse_error_max": 1.5}, DOUBTFUL, "up to 1.5 voxels"),
        ({"inverse_error_max": None}, DOUBTFUL, "up to – voxels"),
        ({"warnings": ("a thing is odd",)}, DOUBTFUL, "Warning: a thing is odd"),
        (_measured("dice_mean", 0.5, 0.7), GOOD, "overlap better"),
        (_measured("dice_mean", 0.5, 0.505), DOUBTFUL, "no better"),
        (_measured("dice_mean", 0.5, 0.4), BAD, "overlap less"),
        (_measured("dice_mean", 0.5, math.nan), GOOD, "more similar"),
        (_measured("landmark_error_mean", 9.0, 2.0), GOOD, "nearer than before"),
        (_measured("landmark_error_mean", 9.0, 9.0), DOUBTFUL, "no nearer"),
        (_measured("landmark_error_mean", 2.0, 9.0), BAD, "farther apart"),
    ],
)
def test_the_verdict_is_the_worst_finding(change, kind, words):
    verdict = judge(FINE | change)
    assert verdict.kind == kind
    assert any(words in finding.text for finding in verdict.findings)
    order = [(BAD, DOUBTFUL, GOOD).index(finding.kind) for finding in verdict.findings]
    assert order == sorted(order)


def test_numbers_are_short():
    assert [number(v) for v in (0.12345, 12345.6, 0.0, None, math.inf)] == ["0.123", "12346", "0", "–", "–"]
