"""The tables of `accuracy.py`: every setting on every set, and what is chosen without the subjects it is judged on."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from statistics import mean, stdev
from typing import Any

from held_out import DEFAULT, Score, choose, chosen_without, gain, standard_error
from pairs import Pair

Row = dict[str, Any]
Run = tuple[str, Pair, str, Row]  # set, pair, name of the setting or tool, and what its rows have in common
Place = tuple[str, str]  # set and name of a pair

_FIGURES = {
    "Dice": ("dice", ".4f"),
    "all labels as one": ("union", ".4f"),
    "landmarks, mean": ("landmark_mean", ".3f"),
    "landmarks, median": ("landmark_median", ".3f"),
}


class Table:
    """The rows of each setting or tool on each pair.

    Args:
        runs: what was asked for.
        rows: all that was done.
        jitters: starts of each pair.

    Attributes:
        failed: a sentence for each run that failed.
    """

    def __init__(self, runs: Iterable[Run], rows: Sequence[Row], jitters: int) -> None:
        self.pairs: dict[Place, Pair] = {}
        self.failed: list[str] = []
        self._rows: dict[tuple[str, str, str], list[Row]] = {}
        for which, pair, name, key in runs:
            found = (row for row in rows if key.items() <= row.items() and row["jitter"] < jitters)
            own = list({row["jitter"]: row for row in found}.values())
            self.pairs[which, pair.name] = pair
            self.failed += dict.fromkeys(f"{which}, {pair.name}, {name}: {r['failed']}" for r in own if "failed" in r)
            if len(own) == jitters and not any("failed" in row for row in own):
                self._rows[which, pair.name, name] = own

    @property
    def sets(self) -> list[str]:
        """The sets, in the order they were asked for."""
        return list(dict.fromkeys(which for which, _ in self.pairs))

    def of(self, which: str, name: str) -> list[list[Row]]:
        """Return the rows of a setting on a set, by pair."""
        return [rows for (where, _, who), rows in self._rows.items() if (where, who) == (which, name)]

    def names(self, which: str) -> list[str]:
        """Return the settings and tools that registered pairs of a set."""
        return list(dict.fromkeys(name for where, _, name in self._rows if where == which))

    def complete(self, name: str) -> bool:
        """Return whether a setting registered every pair."""
        return all((*place, name) in self._rows for place in self.pairs)

    def scores(self, names: Sequence[str]) -> list[Score]:
        """Return the pairs that every one of some settings registered."""
        return [
            Score(pair.fixed.parent.name, *place, frozenset(pair.subjects), {n: self._error(place, n) for n in names})
            for place, pair in self.pairs.items()
            if all((*place, name) in self._rows for name in names)
        ]

    def figure(self, which: str, errors: Iterable[float]) -> str:
        """Return a mean error as a set's own figure, Dice or a distance."""
        value = mean(errors)
        return f"{1 - value:.4f}" if "dice" in self.of(which, DEFAULT)[0][0] else f"{value:.3f}"

    def _error(self, place: Place, name: str) -> float:
        return mean(map(error, self._rows[*place, name]))


def error(row: Row) -> float:
    """Return what is to be small: 1 − Dice, or the mean distance of the landmarks."""
    return 1 - row["dice"] if "dice" in row else row["landmark_mean"]


def shown(table: Table) -> str:
    """Return a line for each set and setting or tool, as Markdown."""
    last = ("gain on default ± SE", "sd of starts", "folds", "seconds", "times default")
    lines = _head("set", "setting", "pairs", *_FIGURES, *last)
    for which in table.sets:
        for name in table.names(which):
            lines.append(_line(which, name, *_cells(table, which, name)))
    return "\n".join(lines)


def _cells(table: Table, which: str, name: str) -> list[str]:
    runs, usual = table.of(which, name), table.of(which, DEFAULT)
    rows = [row for own in runs for row in own]
    figures = [format(mean(row[key] for row in rows), how) if key in rows[0] else "" for key, how in _FIGURES.values()]
    spread = mean(stdev(map(error, own)) if len(own) > 1 else 0.0 for own in runs)
    seconds = mean(row["seconds"] for row in rows)
    ratio = f"{seconds / mean(row['seconds'] for own in usual for row in own):.2f}" if usual else ""
    scores = [score for score in table.scores((DEFAULT, name)) if score.set == which]
    gained = _gained(scores, {(score.set, score.pair): name for score in scores})
    folds = f"{max(row['folds'] for row in rows):.0f}"
    return [str(len(runs)), *figures, gained, f"{spread:.4f}", folds, f"{seconds:.2f}", ratio]


def _gained(scores: Sequence[Score], chosen: Mapping[Place, str]) -> str:
    """Return how much smaller the error is than that of the default, in the set's own unit."""

    def won(some: Sequence[Score]) -> float:
        return mean(s.errors[DEFAULT] - s.errors[chosen[s.set, s.pair]] for s in some)

    return _with_error(won(scores), standard_error(scores, won), ".4f") if scores else ""


def verdict(table: Table, names: Sequence[str]) -> str:
    """Return what is chosen among some settings for whom, what that gains, and whether the default would change."""
    whole = [name for name in names if table.complete(name)]
    if DEFAULT not in whole or len(whole) < 2:
        return "Nothing to choose: the default and another setting must have registered every pair."
    scores = table.scores(whole)
    chosen, lines = chosen_without(scores, whole), _head("set", "default", *_CHOICE)
    for which in table.sets:
        lines.append(_line(which, *_choice(table, [s for s in scores if s.set == which], chosen, whole)))
    left = [f"Left out, as it did not register every pair: {name}." for name in names if name not in whole]
    return "\n".join([*lines, "", *left, *_conclusion(scores, chosen, choose(scores, whole))])


_CHOICE = ("held out", "gain ± SE", "chosen without the subjects", "best in hindsight")


def _choice(table: Table, scores: Sequence[Score], chosen: Mapping[Place, str], names: Sequence[str]) -> list[str]:
    """Return the cells of a set: its figure by default and held out, the gain, who got what, the best in hindsight."""
    which, given = scores[0].set, {}
    for score in scores:
        who = " + ".join(sorted(subject.rpartition("/")[2] for subject in score.subjects))
        given.setdefault(chosen[which, score.pair], {})[who] = None  # once for all pairs of the same subjects
    told = "; ".join(f"{name}: {', '.join(who) if len(given) > 1 else 'all'}" for name, who in given.items())
    means = {name: mean(score.errors[name] for score in scores) for name in names}
    best = min(means, key=means.__getitem__)
    figures = ([s.errors[DEFAULT] for s in scores], [s.errors[chosen[which, s.pair]] for s in scores], [means[best]])
    usual, held_out, hindsight = (table.figure(which, errors) for errors in figures)
    return [usual, held_out, _gained(scores, chosen), told, f"{best} {hindsight}"]


def _conclusion(scores: Sequence[Score], chosen: Mapping[Place, str], best: str) -> list[str]:
    """Return what the choice gains on all sets, and what would become the default."""

    def won(some: Sequence[Score]) -> float:
        return gain(some, lambda score: chosen[score.set, score.pair])

    rise, spread = won(scores), standard_error(scores, won)
    told = f"Held-out gain over all sets: {_with_error(rise, spread, '.2%')} of the default's error."
    doubt = " That is less than its standard error." if abs(rise) < (spread or 0.0) else ""
    votes = ", ".join(f"{name} {count}" for name, count in Counter(chosen.values()).most_common())
    word = f"would change to {best}" if best != DEFAULT and rise > 0 else "stays"
    return [told + doubt, f"The default {word} (all pairs together prefer {best}; pair by pair: {votes})."]


def _with_error(value: float, spread: float | None, how: str) -> str:
    return format(value, "+" + how) + ("" if spread is None else f" ± {format(spread, how)}")


def _head(*cells: str) -> list[str]:
    return [_line(*cells), "|---" * len(cells) + "|"]


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"
