"""The verdict on a registration: whether it went well, in words, by rules that rest on evidence."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import UNITS
from torchdeform.metrics.evaluation import Evaluation
from torchdeform.registration.evidence import Evidence
from torchdeform.registration.tissue import TissueOutcome

GOOD, LOOK, BAD = "good", "look", "bad"
_ORDER = (BAD, LOOK, GOOD)
WARNED = "Warning: "  # how findings begin that repeat a warning about the input
MARKS = {GOOD: "✓", LOOK: "!", BAD: "✗"}

# Thresholds, about in the middle of the gaps between the good and the bad pairs of `scripts/benchmarks/verdict.py`. In
# brackets: the worst of the good pairs of one contrast, and the best of the pairs that show something else.
_INFORMATION = 0.48  # (0.53, 0.44)
_NO_INFORMATION = 0.25  # less than this is what unrelated pictures reach (0.14)
_CORRELATION = 0.68  # (0.74, 0.76; unrelated pictures 0.51)
_DISAGREEMENT = {2: 0.13, 3: 0.25}  # by the number of axes (0.08, 0.19; 0.21, 0.40)
_EXTREME = 0.18  # (0.13, 0.15)
_COVERED = 0.6  # (0.67; half an image 0.54)
_SIGNS = 3  # so many of the four signs that images do not belong together are enough

_LOST, _SPOILT = 0.05, 0.2  # loss of correlation or information by the deformation: look, bad
_INVERSE = 0.5  # voxels
_BENT, _SQUEEZED = 0.5, 0.05  # voxels off a rigid motion, and of the determinant off 1, in tissue that is to keep them
_ABSENT = 0.05
_STRUCTURE = 0.27  # (two contrasts of one thing 0.32; unrelated pictures 0.13, another organ 0.23)
_MIRROR, _MIRRORED = 1.1, 1.2  # merit of a mirrored alignment over the best one: look, bad (good pairs 1.05)

_SEEN, _UNSEEN = 0.2, 0.4  # contrast of labels in one image, and share of it in the other, from which on they differ
_STEADY = 0.01  # a change of Dice, or of a distance relative to it, that does not count
_WORSE = 1 / 3  # share of labels or landmarks that may get worse
_APART, _FAR = 0.2, 0.05  # mean Dice, and landmark distance over the diagonal of the image, of what is not the same
# Images are much more alike where they correlate by the first, and the second share of what was missing is gone. Labels
# whose mean Dice stays below the third, and does not gain the fourth (look) or fifth (bad) share of what it lacks,
# are of other images (own labels gained 0.15 and more, those of another person 0.11 and less).
_ALIKE, _NEARER, _OVERLAP, _FOLLOWED, _STAYED = 0.85, 0.4, 0.7, 0.12, 0.08
_PROVEN = 0.02  # gain of mean Dice, to at least 0.5, that outweighs images that are hard to compare


@dataclass(frozen=True)
class Finding:
    """One reason for or against a result.

    Attributes:
        kind: ``good``, ``look`` or ``bad``.
        text: a sentence.
        figures: the numbers behind it, by name.
    """

    kind: str
    text: str
    figures: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """The verdict on one pair.

    Attributes:
        kind: that of the worst finding: ``good``, ``look`` (look closely before you use it) or ``bad`` (do not use it).
        headline: one sentence with the main reason.
        findings: the worst first.
    """

    kind: str
    headline: str
    findings: tuple[Finding, ...]


# Said of labels that were in the cost.
_PULLED = ", no independent measure, as the labels were in the cost"

_HEADLINES = {
    GOOD: "The images fit, and the map does not fold.",
    LOOK: "Look closely before you use this: {}.",
    BAD: "Do not use this: {}.",
}


def judge(
    evidence: Evidence,
    grid: Grid,
    *,
    folds: int,
    evaluation: Evaluation | None = None,
    mirror: float = 0.0,
    warnings: Sequence[str] = (),
    unit: str = "px",
    tissue: Sequence[TissueOutcome] = (),
    labels_pulled: bool = False,
) -> Verdict:
    """Return the verdict on one pair.

    Args:
        evidence: from the images and the map.
        grid: the fixed grid.
        folds: voxels where the map folds.
        evaluation: what labels and landmarks say, of one item.
        mirror: merit of the best mirrored alignment over that of the best one, 0 if unknown.
        warnings: sentences about what looks wrong with the input.
        unit: what lengths are shown in, one of `UNITS`.
        tissue: how labels of tissue were kept, of one item.
        labels_pulled: whether the labels were in the cost, and so prove nothing.

    Notes:
        No figure proves that the right tissue is on the right tissue. Only labels, landmarks or a look can show it.
    """
    known = list(_annotations(evaluation, evidence, grid, unit, _PULLED if labels_pulled else ""))
    found = [*_folds(folds), *_images(evidence, grid.dim, mirror), *_map(evidence)]
    if (
        evaluation is not None
        and not labels_pulled
        and _proven(evaluation)
        and all(some.kind == GOOD for some in known)
    ):
        found = [replace_bad(some) if some.kind == BAD and folds == 0 else some for some in found]
    others = [text for text in warnings if mirror <= _MIRROR or "mirror image" not in text]
    found += [*known, *_tissue(tissue), *(Finding(LOOK, f"{WARNED}{text}.") for text in others)]
    found.sort(key=lambda some: _ORDER.index(some.kind))
    kind = found[0].kind
    return Verdict(kind, _HEADLINES[kind].format(_reason(found[0].text)), tuple(found))


def _reason(text: str) -> str:
    """Return a finding as the end of a sentence, without its figures."""
    short = text.removeprefix(WARNED).split(" (")[0].rstrip(".")
    return short[0].lower() + short[1:] if short.startswith(("The ", "What ", "Nothing ", "Many ")) else short


def replace_bad(finding: Finding) -> Finding:
    """Return a finding of the images that labels or landmarks contradict: a reason to look."""
    return Finding(LOOK, finding.text, finding.figures)


def _folds(folds: int) -> Iterator[Finding]:
    if folds:
        text = f"The map folds ({folds:,} voxel{'s' if folds > 1 else ''}: it cannot be inverted there)."
        yield Finding(BAD, text, {"folds": folds})
    else:
        yield Finding(GOOD, "The map does not fold anywhere (checked exactly, not only by central differences).")


def _images(evidence: Evidence, dim: int, mirror: float) -> Iterator[Finding]:
    """Whether the images show the same, and fit."""
    signs = list(_signs(evidence, dim))
    unlike = evidence.information < _NO_INFORMATION or len(signs) >= _SIGNS
    if unlike:
        text = "The images do not fit (they may not show the same, or the registration failed)."
        kind = LOOK if evidence.structure_before > _STRUCTURE else BAD  # two contrasts are hard to compare
        yield Finding(kind, text, {"signs": len(signs), "structure_before": evidence.structure_before})
    if mirror > _MIRROR:
        text = "The moving image looks like a mirror image of the fixed one (mirrored it would fit "
        text += f"{number(mirror)} times as well): check the directions in both headers."
        yield Finding(BAD if mirror > _MIRRORED else LOOK, text, {"mirror": mirror})
    if evidence.turned:
        axes = " and ".join(evidence.turned)
        yield Finding(BAD, f"The moving image would fit much better turned over along {axes}.")
    yield from signs
    yield from _loss(evidence)
    if not signs:
        text = (
            f"The images fit (correlation {number(evidence.correlation_before)} → {number(evidence.correlation)} where "
            f"there is contrast, information {number(evidence.information_before)} → {number(evidence.information)}; "
            "1 for equal images)."
        )
        names = ("correlation_before", "correlation", "information_before", "information")
        yield Finding(GOOD, text, {name: getattr(evidence, name) for name in names})


def _signs(evidence: Evidence, dim: int) -> Iterator[Finding]:
    """Yield the signs that two images do not belong together."""
    e = evidence
    if not e.information >= _INFORMATION:
        text = f"The images have little in common ({number(e.information)} of the information that the fixed one has "
        text += f"about itself; {_INFORMATION} and more are usual)."
        yield Finding(LOOK, text, {"information": e.information})
    if not e.correlation >= _CORRELATION:
        text = f"What has contrast hardly correlates ({number(e.correlation)}; {_CORRELATION} and more are usual)."
        yield Finding(LOOK, text, {"correlation": e.correlation})
    if e.disagreement > _DISAGREEMENT[dim]:
        text = "The map depends on the direction (from moving to fixed another one is found for "
        text += f"{e.disagreement:.0%} of what has contrast)."
        yield Finding(LOOK, text, {"disagreement": e.disagreement})
    if e.extreme_inside > _EXTREME:
        text = f"Many volumes change more than threefold ({e.extreme_inside:.0%} of what has contrast, {e.extreme:.0%} "
        text += "of all voxels)."
        yield Finding(LOOK, text, {"extreme_inside": e.extreme_inside, "extreme": e.extreme})


def _loss(evidence: Evidence) -> Iterator[Finding]:
    """Whether the deformation made anything worse."""
    for name in ("correlation", "information"):
        before, after = getattr(evidence, f"{name}_before"), getattr(evidence, name)
        if before - after > _LOST:
            text = f"The deformation made the images less alike ({name} {number(before)} → {number(after)})."
            kind = BAD if before - after > _SPOILT else LOOK
            yield Finding(kind, text, {f"{name}_before": before, name: after})
            return


def _map(evidence: Evidence) -> Iterator[Finding]:
    """What is unusual about the map itself."""
    e = evidence
    if e.covered < _COVERED:
        text = f"The moving image covers only a part of the fixed one ({e.covered:.0%} of what has contrast)."
        yield Finding(LOOK, text, {"covered": e.covered})
    if e.absent > _ABSENT:
        text = f"Nothing in the moving image corresponds to a part of the fixed one ({e.absent:.0%} of what has "
        yield Finding(LOOK, f"{text}contrast, where the map is only carried through).", {"absent": e.absent})
    if not e.inverse_error < _INVERSE:
        text = f"The map and its inverse do not take points back ({number(e.inverse_error)} voxels off at 1 % of them)."
        yield Finding(LOOK, text, {"inverse_error": e.inverse_error})


def _tissue(outcomes: Sequence[TissueOutcome]) -> Iterator[Finding]:
    """Tissue that is not what it was to be."""
    for one in outcomes:
        residual, off = one.after.residual.item(), one.after.off.item()
        if one.kind == "rigid" and residual > _BENT:
            text = (
                f"The tissue of label {one.label} did not stay rigid (up to {number(residual)} voxels off its motion)."
            )
            yield Finding(LOOK, text, {"label": one.label, "residual": residual})
        if one.kind == "incompressible" and off > _SQUEEZED:
            text = (
                f"The tissue of label {one.label} did not keep its volume (the determinant is up to {off:.0%} off 1)."
            )
            yield Finding(LOOK, text, {"label": one.label, "off": off})


def _annotations(
    evaluation: Evaluation | None, evidence: Evidence, grid: Grid, unit: str, remark: str
) -> Iterator[Finding]:
    if evaluation is None:
        return
    if evaluation.after.labels:
        yield from _own_images(evidence.label_contrast)
        yield from _labels(evaluation, remark)
        yield from _left_behind(evaluation, evidence)
        yield from _surfaces(evaluation, grid, unit)
    distances = [stage.distances for stage in (evaluation.before, evaluation.after)]
    if distances[0] is not None and distances[1] is not None:
        yield from _landmarks(distances[0], distances[1], grid, unit)


def _proven(evaluation: Evaluation) -> bool:
    """Whether labels or landmarks show that the registration helped."""
    before, after = evaluation.before, evaluation.after
    if after.labels:
        gain = _mean(after.dice) - _mean(before.dice)
        return gain > _PROVEN and _mean(after.dice) >= 0.5
    return False


def _own_images(contrast: tuple[float, float] | None) -> Iterator[Finding]:
    """Whether the labels of both images go with them equally well."""
    if contrast is not None and max(contrast) > _SEEN and min(contrast) < _UNSEEN * max(contrast):
        name = ("fixed", "moving")[contrast.index(min(contrast))]
        text = f"The labels of the {name} image do not go with it (they explain {min(contrast):.0%} of the contrast in "
        text += f"and around them, those of the other image {max(contrast):.0%})."
        yield Finding(BAD, text, {"fixed": contrast[0], "moving": contrast[1]})


def _labels(evaluation: Evaluation, remark: str) -> Iterator[Finding]:
    """How the overlap of labels changed, on average and of each."""
    before, after = (_mean(stage.dice) for stage in (evaluation.before, evaluation.after))
    figures = {"dice_before": before, "dice_after": after}
    means = f"mean Dice {number(before)} → {number(after)}{remark}"
    if not math.isfinite(after):
        return
    if after < _APART:
        yield Finding(BAD, f"The labels do not overlap ({means}): are they of these images?", figures)
    elif after < before - _STEADY:
        yield Finding(BAD, f"The labels overlap less than before ({means}).", figures)
    else:
        yield from _each_label(evaluation, means, figures, after > before + _STEADY)
    if evaluation.aligned is not None and _mean(evaluation.aligned.dice) < before - _PROVEN > after - 2 * _PROVEN:
        text = f"The alignment lowered the overlap of the labels (mean Dice {number(before)} → "
        aligned = _mean(evaluation.aligned.dice)
        yield Finding(LOOK, f"{text}{number(aligned)}).", {"dice_before": before, "dice_aligned": aligned})


def _left_behind(evaluation: Evaluation, evidence: Evidence) -> Iterator[Finding]:
    """Whether the deformation brought the images together, but not their labels."""
    start, after = (_mean(stage.dice) for stage in (evaluation.aligned or evaluation.before, evaluation.after))
    before, alike = evidence.correlation_before, evidence.correlation
    nearer = alike >= _ALIKE and alike - before >= _NEARER * (1 - before)
    gain = (after - start) / max(1 - start, _STEADY)
    if nearer and after < _OVERLAP and gain < _FOLLOWED:
        text = f"The images fit much better after the deformation, their labels do not (mean Dice {number(start)} → "
        text += f"{number(after)}): are they of these images?"
        yield Finding(BAD if gain < _STAYED else LOOK, text, {"dice_aligned": start, "dice_after": after})


def _each_label(evaluation: Evaluation, means: str, figures: dict[str, float], better: bool) -> Iterator[Finding]:
    """Which labels overlap better and which worse, where the mean is no worse."""
    change = (evaluation.after.dice[0] - evaluation.before.dice[0]).nan_to_num()
    gained, lost = int((change > _STEADY).sum()), int((change < -_STEADY).sum())
    counts = f"{gained} of {len(change)} better, {lost} worse"
    if lost:
        worst = int(change.argmin())
        ends = (float(stage.dice[0, worst]) for stage in (evaluation.before, evaluation.after))
        counts += f", most of all label {evaluation.after.labels[worst]}: {' → '.join(map(number, ends))}"
    kind = GOOD if lost <= _WORSE * len(change) else LOOK
    words = "better" if better else "no better"
    yield Finding(
        kind, f"The labels overlap {words} than before ({means}; {counts}).", figures | {"gained": gained, "lost": lost}
    )


def _surfaces(evaluation: Evaluation, grid: Grid, unit: str) -> Iterator[Finding]:
    """Whether the surfaces of labels moved apart."""
    before, after = (_mean(stage.hausdorff) * UNITS[unit] for stage in (evaluation.before, evaluation.after))
    if after > before + min(grid.spacing) * UNITS[unit] and after > 1.1 * before:
        text = f"The surfaces of the labels are farther apart than before (95 % Hausdorff distance {number(before)} → "
        yield Finding(
            LOOK,
            f"{text}{number(after)} {unit}, mean of the labels).",
            {"hausdorff_before": before, "hausdorff_after": after},
        )


def _landmarks(first: Tensor, last: Tensor, grid: Grid, unit: str) -> Iterator[Finding]:
    """How the distances of landmarks changed, on average and of each."""
    before, after, voxel = float(first.mean()), float(last.mean()), min(grid.spacing)
    worse, scale = int((last > first + voxel).sum()), UNITS[unit]
    ends = f"mean distance {number(before * scale)} → {number(after * scale)} {unit}"
    figures = {"landmark_error_before": before * scale, "landmark_error_after": after * scale, "worse": worse}
    if float(last.median()) > _FAR * math.hypot(*grid.extent):
        yield Finding(BAD, f"The landmarks are far apart ({ends}): are they the same points?", figures)
    elif after > before * (1 + _STEADY) + _STEADY * voxel:
        yield Finding(BAD, f"The landmarks are farther apart than before ({ends}).", figures)
    else:
        words = "nearer" if after < before * (1 - _STEADY) else "no nearer"
        text = f"The landmarks are {words} than before ({ends}; {worse} of {last.numel()} farther apart)."
        yield Finding(GOOD if worse <= _WORSE * last.numel() else LOOK, text, figures)


def _mean(values: Tensor) -> float:
    """Return the mean of the values of one item that are finite, NaN without one."""
    values = values[0]
    return float(values[values.isfinite()].mean())


def number(figure: float | None) -> str:
    """Return a figure with three digits, a dash if it is missing."""
    if figure is None or not math.isfinite(figure):
        return "–"
    return f"{figure:.0f}" if abs(figure) >= 1000 else f"{figure:.3g}"
