"""``index.html``: the pairs of a cohort at one look: counts, strips of every measure, a table with the worst first."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from torchdeform import __version__
from torchdeform.cohort.strips import WIDTH, strip_of
from torchdeform.cohort.task import DONE, FAILED
from torchdeform.io.files import atomic_file
from torchdeform.pipeline.register import OVERVIEW, REPORT, THUMBNAIL
from torchdeform.report.page import script_hash

WAITING = "waiting"

Row = Mapping[str, str | float]


@dataclass(frozen=True)
class Measure:
    """A measure of a pair.

    Attributes:
        title: its name.
        columns: of the summary: what it was before and what it is, or its smallest and largest value.
        worse: of each column, which values are the worse ones: 1 the large, −1 the small, 0 no matter.
        parts: what two columns are.
        between: text between them.
        unit: of its values.
        ratios: whether twice as much is as far as half as much.
    """

    title: str
    columns: tuple[str, ...]
    worse: tuple[int, ...]
    parts: tuple[str, str] = ("before", "after")
    between: str = " → "
    unit: str = ""
    ratios: bool = False


MEASURES = (
    Measure("similarity", ("similarity_before", "similarity_after"), (0, -1)),
    Measure("Dice", ("dice_before", "dice_after"), (0, -1)),
    Measure("landmark error", ("landmark_error_before", "landmark_error_after"), (0, 1)),
    Measure("folds", ("folds",), (1,)),
    Measure(
        "determinant", ("determinant_min", "determinant_max"), (-1, 1), ("smallest", "largest"), " to ", ratios=True
    ),
    Measure(
        "inverse error", ("inverse_error_mean", "inverse_error_max"), (0, 1), ("mean", "largest"), " / ", "voxel", True
    ),
    Measure("time", ("seconds",), (1,), unit="s"),
    Measure("memory", ("peak_memory_mb",), (1,), unit="MB"),
    Measure("GPU memory", ("gpu_memory_mb",), (1,), unit="MB"),
)

GOOD, LOOK, BAD = VERDICTS = ("good", "look", "bad")

# What a pair is, the worst first: its verdict if it has one, else its status; the sign and the words of its badge.
BADGES = {
    FAILED: ("⊘", "failed"),
    BAD: ("✗", "do not use"),
    LOOK: ("!", "look closely"),
    WAITING: ("…", "waiting"),
    DONE: ("•", "done"),
    GOOD: ("✓", "good"),
}

_TEMPLATES = Path(__file__).parent / "templates"
# Of these files of a pair the first that exists is linked, or shown.
_LINKED, _SHOWN = (REPORT, OVERVIEW), (THUMBNAIL, OVERVIEW)


def badge_of(row: Row) -> str:
    """Return the key in `BADGES` of a pair."""
    verdict = row.get("verdict", "")
    return str(verdict if row["status"] == DONE and verdict in BADGES else row["status"])


def means(rows: Sequence[Row]) -> dict[str, str]:
    """Return the mean of every measure, over the pairs that have it, as text by its title."""
    found = {}
    for measure in _measured(rows):
        unit = _unit(measure, rows)
        values = [list(_values(rows, column).values()) for column in measure.columns]
        found[measure.title] = _text(measure, [fmean(v) if v else None for v in values]) + (unit and f" {unit}")
    return found


def write_page(path: Path, rows: Sequence[Row], failures: Mapping[str, Row]) -> None:
    """Write the page of a cohort; all text is escaped.

    Args:
        path: the file; links are relative to its folder.
        rows: of the summary, all with the same columns.
        failures: rows of the table of failures, by the name of the pair.

    Notes:
        Its size is about half a kilobyte a pair; pictures are loaded when they come into view.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    script = Markup((_TEMPLATES / "index.js").read_text(encoding="utf-8"))
    loader = FileSystemLoader(_TEMPLATES)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    known, counts = _measured(rows), Counter(map(badge_of, rows))
    links = {str(row["name"]): _link(path.parent, row, _LINKED) for row in rows}
    order = list(BADGES)
    text = environment.get_template("index.html").stream(
        title=path.absolute().parent.name,
        total=len(rows),
        badges=[(key, *BADGES[key], counts[key]) for key in order if counts[key]],
        strips=[_strip(measure, rows, links) for measure in known],
        width=WIDTH,
        titles=[_title(measure, rows) for measure in known],
        rows=(
            _shown(path.parent, row, known, failures.get(str(row["name"]), {})) | {"link": links[str(row["name"])]}
            for row in sorted(rows, key=lambda row: order.index(badge_of(row)))
        ),
        version=__version__,
        script=script,
        script_hash=script_hash(script),
    )
    with atomic_file(path) as new, new.open("w", encoding="utf-8") as file:
        file.writelines(text)


def _shown(folder: Path, row: Row, known: Sequence[Measure], failure: Row) -> dict[str, object]:
    """Return what the table has of a pair, without its link."""
    badge, log = badge_of(row), str(failure.get("log", ""))
    values = [[_number(row, column) for column in measure.columns] for measure in known]
    return {
        "name": row["name"],
        "badge": badge,
        "label": BADGES[badge],
        "why": failure.get("sentence", "") or (row.get("headline", "") if badge != GOOD else ""),
        "log": log if log and (folder / log).is_file() else "",
        "picture": _link(folder, row, _SHOWN),
        "cells": [(_text(m, v), "" if v[-1] is None else f"{v[-1]:.6g}") for m, v in zip(known, values, strict=True)],
    }


def _strip(measure: Measure, rows: Sequence[Row], links: Mapping[str, str]) -> dict[str, Any]:
    """Return the strip of a measure with its title and its outliers as text."""
    columns = [(values, w) for c, w in zip(measure.columns, measure.worse, strict=True) if (values := _values(rows, c))]
    strip = strip_of(*zip(*columns, strict=True), ratios=measure.ratios)
    named = [(outlier.name, _digits(outlier.value), links[outlier.name]) for outlier in strip.named]
    marks = [(o.x, o.y, f"{o.name}: {_digits(o.value)}", links[o.name]) for o in strip.outliers]
    return {
        "title": _title(measure, rows),
        "parts": measure.parts if len(columns) > 1 else (),
        "log": strip.log,
        "low": _digits(strip.low),
        "high": _digits(strip.high),
        "height": strip.height,
        "lines": strip.lines,
        "marks": marks,
        "named": named,
        "more": strip.far - len(named),
    }


def _link(folder: Path, row: Row, names: Sequence[str]) -> str:
    """Return the first of some files that a pair has, relative to the page; empty if it has none."""
    if not row["folder"]:
        return ""
    return next((f"{row['folder']}/{name}" for name in names if (folder / str(row["folder"]) / name).is_file()), "")


def _measured(rows: Sequence[Row]) -> list[Measure]:
    """Return the measures that any pair has."""
    return [measure for measure in MEASURES if any(_values(rows, column) for column in measure.columns)]


def _values(rows: Sequence[Row], column: str) -> dict[str, float]:
    """Return the values of a column by pair, of those that are done and have one."""
    found = {str(row["name"]): _number(row, column) for row in rows if row["status"] == DONE}
    return {name: value for name, value in found.items() if value is not None}


def _number(row: Row, column: str) -> float | None:
    value = row.get(column, "")
    return float(value) if value != "" and math.isfinite(float(value)) else None


def _unit(measure: Measure, rows: Sequence[Row]) -> str:
    """Return the unit of a measure; distances of landmarks have that of the images, if it is one."""
    units = (
        {str(row["unit"]) for row in rows if row.get("unit")} if measure.title == "landmark error" else {measure.unit}
    )
    return units.pop() if len(units) == 1 else ""


def _title(measure: Measure, rows: Sequence[Row]) -> str:
    unit = _unit(measure, rows)
    return f"{measure.title}, {unit}" if unit else measure.title


def _text(measure: Measure, values: Sequence[float | None]) -> str:
    """Return the values of a measure as text, empty if there are none."""
    return measure.between.join(_digits(value) for value in values if value is not None)


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
