"""The verdict on a registration: whether it went well, in words."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"
_STEADY = 0.01  # share of a value below which a change does not count
_EXTREME = 10.0  # factor of a change of volume from which on it is mentioned
_FAR = 1.0  # largest inverse consistency in voxels that is not mentioned

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Finding:
    """One reason for or against a result: ``good``, ``doubtful`` or ``bad``, and a sentence."""

    kind: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """The verdict: the kind of the worst finding, a headline, and the findings, the worst first."""

    kind: str
    headline: str
    findings: tuple[Finding, ...]


_HEADLINES = {
    GOOD: "The images fit better than before, and the map does not fold.",
    DOUBTFUL: "Look at this registration closely before you use it.",
    BAD: "Do not use this registration as it is.",
}


def judge(record: Record) -> Verdict:
    """Return the verdict from the figures of a record.

    Args:
        record: what `describe` returns, with ``warnings`` if there are any.

    Notes:
        No figure proves that the right tissue is on the right tissue. Only labels, landmarks or a look can show it.
    """
    found = [_folds(record), *_similarity(record), *_labels(record), *_landmarks(record), *_map(record)]
    found += [Finding(DOUBTFUL, f"Warning: {text}") for text in record.get("warnings", ())]
    found.sort(key=lambda finding: (BAD, DOUBTFUL, GOOD).index(finding.kind))
    return Verdict(found[0].kind, _HEADLINES[found[0].kind], tuple(found))


def _folds(record: Record) -> Finding:
    folds = record["folds"]
    if folds == 0:
        return Finding(GOOD, "The map does not fold anywhere (checked exactly, not only by central differences).")
    return Finding(BAD, f"The map folds at {folds:,} voxel{'s' if folds > 1 else ''}: it cannot be inverted there.")


def _similarity(record: Record) -> list[Finding]:
    before, after = (value(record[f"similarity_{when}"]) for when in ("before", "after"))
    if not (math.isfinite(before) and math.isfinite(after)):
        return [Finding(BAD, "The similarity is not a number: the images could not be compared.")]
    change = (after - before) / max(abs(before), abs(after), 1e-12)
    figures = f"({number(before)} → {number(after)}, higher is better)"
    worse = f"The images are less similar than before the deformation {figures}."
    same = f"The deformation hardly changed the similarity {figures}."
    return _graded(change, _STEADY, worse, same, f"The deformation made the images more similar {figures}.")


def _labels(record: Record) -> list[Finding]:
    before, after = ends(record, "dice_mean")
    figures = f"mean Dice {number(before)} → {number(after)}"
    words = (f"less than before ({figures})", f"no better than before ({figures})")
    best = f"better than before ({figures}; 1 is perfect)"
    return _graded(after - before, _STEADY, *(f"The labels overlap {word}." for word in (*words, best)))


def _landmarks(record: Record) -> list[Finding]:
    before, after = ends(record, "landmark_error_mean")
    figures = f"(mean distance {number(before)} → {number(after)} {record['unit']})"
    words = ("farther apart than", "no nearer than", "nearer than")
    return _graded(before - after, _STEADY * before, *(f"The landmarks are {word} before {figures}." for word in words))


def _graded(gain: float, steady: float, worse: str, same: str, better: str) -> list[Finding]:
    """Return what one of three sentences says about a gain; below ``steady`` it does not count, NaN has none."""
    if not math.isfinite(gain):
        return []
    if gain < -steady:
        return [Finding(BAD, worse)]
    return [Finding(DOUBTFUL, same) if gain < steady else Finding(GOOD, better)]


def _map(record: Record) -> list[Finding]:
    """Return what is unusual about the map itself."""
    found = []
    low, high, error = (value(record[key]) for key in ("determinant_min", "determinant_max", "inverse_error_max"))
    if record["folds"] == 0 and (low < 1 / _EXTREME or high > _EXTREME):
        figures = f"volume × {number(low)} to × {number(high)}"
        found.append(Finding(DOUBTFUL, f"The map changes some volumes more than tenfold ({figures})."))
    if not error < _FAR:
        text = f"Applying the map and then its inverse is off by more than one voxel (up to {number(error)} voxels)."
        found.append(Finding(DOUBTFUL, text))
    return found


def ends(record: Record, key: str) -> tuple[float, float]:
    """Return a measure of labels or landmarks at the start and at the end; NaN if unknown."""
    measures = record.get("evaluation", {})
    before, after = (value(measures.get(stage, {}).get(key)) for stage in ("before", "after"))
    return before, after


def value(figure: float | None) -> float:
    """Return a figure of a record, NaN if it is missing."""
    return math.nan if figure is None else figure


def number(figure: float | None) -> str:
    """Return a figure with three digits, a dash if it is missing."""
    if not math.isfinite(value(figure)):
        return "–"
    return f"{figure:.0f}" if abs(value(figure)) >= 1000 else f"{figure:.3g}"
