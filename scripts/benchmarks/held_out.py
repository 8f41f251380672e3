"""Choosing one setting for all sets without looking at the subject it is judged on.

The error of a setting on a pair is 1 − Dice, or the mean distance of the landmarks, averaged over the starts. Its gain
is the error of the default less its own, in shares of the default's mean error on the set, which makes millimetres and
overlaps comparable. Pairs are averaged within a *group*, the sets that show the same people, and groups weigh alike.

For each pair the setting with the largest gain is chosen on all pairs of all sets that show neither of its subjects. A
subject that is alone in its set is judged by what was chosen on the other sets. Ties keep the default.

Pairs that share a subject are not independent, so standard errors are those of the jackknife over subjects:
SE² = (n − 1) / n Σ (m_s − mean of m)², m_s being the statistic without the pairs that show subject s.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean

DEFAULT = "default"

# A gain no larger than this is rounding.
_NOTHING = 1e-9


@dataclass(frozen=True)
class Score:
    """What every setting reaches on a pair.

    Attributes:
        group: sets of the same group count as one.
        set: the set.
        pair: its name there.
        subjects: whom it shows.
        errors: by setting, smaller is better.
    """

    group: str
    set: str
    pair: str
    subjects: frozenset[str]
    errors: Mapping[str, float]


def gain(scores: Sequence[Score], chosen: Callable[[Score], str]) -> float:
    """Return the mean over groups of what is gained on the default, in shares of its error.

    Args:
        scores: some pairs.
        chosen: the setting of each.
    """
    usual = {name: mean(s.errors[DEFAULT] for s in scores if s.set == name) for name in {s.set for s in scores}}
    groups: dict[str, list[float]] = {}
    for score in scores:
        won = score.errors[DEFAULT] - score.errors[chosen(score)]
        groups.setdefault(score.group, []).append(won / (usual[score.set] or 1.0))
    return mean(map(mean, groups.values()))


def choose(scores: Sequence[Score], settings: Iterable[str]) -> str:
    """Return the setting with the largest gain on some pairs, the default if none gains or there are no pairs."""
    gains = {name: gain(scores, lambda _, name=name: name) for name in settings if name != DEFAULT and scores}
    best = max(gains, key=gains.__getitem__, default=DEFAULT)
    return best if gains.get(best, 0.0) > _NOTHING else DEFAULT


def chosen_without(scores: Sequence[Score], settings: Sequence[str]) -> dict[tuple[str, str], str]:
    """Return for each pair, by set and name, the setting that all pairs without its subjects choose."""
    folds = {score.subjects for score in scores}
    choice = {out: choose([s for s in scores if not s.subjects & out], settings) for out in folds}
    return {(score.set, score.pair): choice[score.subjects] for score in scores}


def standard_error(scores: Sequence[Score], statistic: Callable[[Sequence[Score]], float]) -> float | None:
    """Return the standard error of a statistic of pairs over their subjects; None for fewer than two."""
    subjects = sorted(set().union(*(score.subjects for score in scores)))
    left = [[score for score in scores if subject not in score.subjects] for subject in subjects]
    values = [statistic(rest) for rest in left if rest]
    if len(values) < 2:
        return None
    middle, count = mean(values), len(values)
    return math.sqrt((count - 1) / count * sum((value - middle) ** 2 for value in values))
