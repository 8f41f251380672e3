"""The figures of the page: tiles, tables, commands."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchdeform.metrics.similarity import measure_name
from torchdeform.registration.verdict import number
from torchdeform.report.planes import WORDS
from torchdeform.report.record import apply_commands

_LONG = 12  # a table with more rows is folded
_STAGES = ("before", "aligned", "after")

Record = Mapping[str, Any]


def ends(record: Record, key: str) -> tuple[float, float]:
    """Return a measure of labels or landmarks at the start and at the end; NaN if unknown."""
    measures = record.get("evaluation", {})
    before, after = (value(measures.get(stage, {}).get(key)) for stage in ("before", "after"))
    return before, after


def value(figure: float | None) -> float:
    """Return a figure of a record, NaN if it is missing."""
    return math.nan if figure is None else figure


@dataclass(frozen=True)
class Tile:
    """One figure in large type, with its name above and an explanation below."""

    name: str
    value: str
    small: str


@dataclass(frozen=True)
class Part:
    """Rows of a table with their heads.

    ``fold`` is the text to click on to open them, empty if they are open; ``words`` is the number of columns after the
    first with words instead of figures.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    fold: str = ""
    words: int = 0


@dataclass(frozen=True)
class Table:
    """A section of the page with figures."""

    title: str
    parts: Sequence[Part]
    summary: str = ""


def file_name(place: Mapping[str, Any]) -> str:
    """Return the name of an image's file, without its folder."""
    return Path(str(place["path"])).name or str(place["path"])


def tiles(record: Record) -> list[Tile]:
    """Return the most important figures."""
    frames, words = {2: 4, 3: 10}[len(record["fixed"]["size"])], _words(record)
    low, high = number(record["determinant_min"]), number(record["determinant_max"])
    return [
        Tile(
            "Folds",
            f"{record['folds']:,}",
            f"{words['voxel']}s where one of the {frames} one-sided determinants is not positive",
        ),
        Tile(
            f"Similarity ({measure_name(record['similarity'])})",
            f"{number(record['similarity_before'])} → {number(record['similarity_after'])}",
            "before → after the deformation; higher is better",
        ),
        *_accuracy(record),
        Tile(
            f"{words['volume'].capitalize()}, moving / fixed",
            f"{low} to {high}",
            "smallest and largest determinant of the map",
        ),
        Tile(
            "Inverse consistency",
            _voxels(record, "inverse_error_mean"),
            f"on average; {_voxels(record, 'inverse_error_max')} at most",
        ),
        Tile("Time", _seconds(sum(record["seconds"].values())), f"on {record['device']}"),
    ]


def _accuracy(record: Record) -> list[Tile]:
    """Return tiles of labels and landmarks, if they were given."""
    found = []
    for key, name, unit, about in (
        ("dice_mean", "Dice of the labels", "", f"mean overlap before → after; 1 is perfect{_in_cost(record)}"),
        ("landmark_error_mean", "Distance of landmarks", f" {record['unit']}", "mean before → after; 0 is perfect"),
    ):
        before, after = ends(record, key)
        if math.isfinite(after):
            found.append(Tile(name, f"{number(before)} → {number(after)}{unit}", about))
    return found


def _words(record: Record) -> Mapping[str, str]:
    return WORDS[len(record["fixed"]["size"])]


def _voxels(record: Record, key: str) -> str:
    return f"{_length(value(record[key]))} {_words(record)['voxel']}"


def _seconds(time: float) -> str:
    return f"{time:.1f} s" if time < 90 else f"{time / 60:.1f} min"


def tables(record: Record) -> list[Table]:
    """Return the tables of a record: tissue, labels, landmarks, levels, time and memory, files, settings, versions."""
    found = (_tissue, _labels, _landmarks, _levels, _costs, _images, _settings)
    return [table for make in found if (table := make(record)) is not None]


def _measures(record: Record, key: str) -> dict[str, Mapping[str, Any]]:
    """Return the measures of labels and landmarks by stage, of the stages that have the key."""
    found = record.get("evaluation", {})
    return {stage: found[stage] for stage in _STAGES if key in found.get(stage, {})}


def _tissue(record: Record) -> Table | None:
    """Return how the labels of tissue were kept."""
    rows = [
        [f"{one['label']}", kind_of(one), f"{one['nodes']:,}", *(text(one, " → ") for text in KEPT.values())]
        for one in record.get("tissue", ())
    ]
    voxel = _words(record)["voxel"]
    summary = (
        "Before → after the last correction. Off a rigid motion: the largest distance from the rigid motion that fits "
        f"best, in {voxel}s. Determinant: how far from 1, so from keeping the size, 99.9 % of the {voxel}s are at most."
    )
    head = ["label", "kind", f"{voxel}s", "off a rigid motion", "determinant within", _words(record)["volume"]]
    return Table("Tissue", [Part(head, rows, words=1)], summary) if rows else None


def kind_of(tissue: Mapping[str, Any]) -> str:
    """Return what a label of tissue is."""
    kind = "own prices" if tissue["kind"] == "own" else tissue["kind"]
    return f"{kind}, sliding" if tissue["sliding"] else kind


def _stages(one: Mapping[str, Any], key: str, arrow: str, form: Callable[[float], str]) -> str:
    """Return a figure of a label before and after, or once if it is the same."""
    texts = [form(value(one[stage][key])) for stage in ("before", "after")]
    return arrow.join(dict.fromkeys(texts))


def _percent(share: float, sign: str = "") -> str:
    """Return a share in per cent, to a hundredth at most."""
    if not math.isfinite(share):
        return "–"
    percent = round(100 * share, 2)
    return f"{percent:{sign}.0f} %" if abs(percent) >= 10 else f"{percent:{sign}.2g} %"


def _length(voxels: float) -> str:
    return "< 0.001" if 0 <= voxels < 1e-3 else number(voxels)


# What is said of a label, by its key in the record.
KEPT: dict[str, Callable[[Mapping[str, Any], str], str]] = {
    "residual": lambda one, arrow: _stages(one, "residual", arrow, _length),
    "off": lambda one, arrow: _stages(one, "off", arrow, _percent),
    "volume": lambda one, arrow: _stages(one, "volume", arrow, lambda volume: _percent(volume - 1, "+")),
}


def _labels(record: Record) -> Table | None:
    stages = _measures(record, "dice")
    if not stages:
        return None
    after = stages["after"]["dice"]
    rows = [
        [
            label,
            *(number(m["dice"][label]) for m in stages.values()),
            *(number(stages[end]["hausdorff_95"][label]) for end in ("before", "after")),
        ]
        for label in sorted(after, key=lambda label: value(after[label]) if math.isfinite(value(after[label])) else 2.0)
    ]
    means = " → ".join(f"{number(m['dice_mean'])} {stage}" for stage, m in stages.items())
    head = ["label", *(f"Dice {stage}" for stage in stages), "distance before", "distance after"]
    summary = (
        f"Mean Dice {means}, over {len(after)} labels; the worst come first. Distance: 95 % Hausdorff, in "
        f"{record['unit']}{_in_cost(record)}."
    )
    return Table("Labels", [_foldable(head, rows, f"All {len(rows)} labels")], summary)


def _in_cost(record: Record) -> str:
    """Return what to say of labels that were in the cost."""
    return "; the labels were in the cost, so this is no independent measure" if record.get("labels_in_cost") else ""


def _landmarks(record: Record) -> Table | None:
    stages = _measures(record, "landmark_errors")
    if not stages:
        return None
    head = [f"distance in {record['unit']}", *stages]
    whole = [
        [kind, *(number(m[f"landmark_error_{kind}"]) for m in stages.values())] for kind in ("mean", "median", "max")
    ]
    each = zip(*(m["landmark_errors"] for m in stages.values()), strict=True)
    rows = [[f"{place}", *map(number, row)] for place, row in enumerate(each, start=1)]
    return Table("Landmarks", [Part(head, whole), _foldable(["landmark", *stages], rows, f"All {len(rows)} landmarks")])


def _foldable(head: list[str], rows: list[list[str]], title: str) -> Part:
    return Part(head, rows, title if len(rows) > _LONG else "")


def _levels(record: Record) -> Table | None:
    rows = [
        [
            "×".join(map(str, level["size"])),
            f"{max(len(level['similarity']) - 1, 0)}",
            f"{number(level['similarity'][0])} → {number(level['similarity'][-1])}" if level["similarity"] else "–",
            f"{level['shortened']}",
            _seconds(level["seconds"]),
        ]
        for level in record["levels"]
    ]
    head = ["level", "steps", "similarity", "steps shortened to avoid folds", "time"]
    return Table("Levels, coarse to fine", [Part(head, rows)]) if rows else None


def _costs(record: Record) -> Table:
    """Return the time of each stage, and the peak memory up to its end."""
    peaks = record.get("memory") or {}
    rows = [
        [stage, _seconds(seconds), f"{peaks[stage] / 1e9:.2f} GB" if peaks.get(stage) else "–"]
        for stage, seconds in record["seconds"].items()
    ]
    return Table("Time and memory", [Part(["stage", "time", "peak memory so far"], rows)])


def _images(record: Record) -> Table:
    rows = []
    for name in ("fixed", "moving"):
        place = record[name]
        size, spacing = ("×".join(number(v) for v in place[key]) for key in ("size", "spacing"))
        rows.append(
            [
                name,
                str(place["path"]),
                size,
                f"{spacing} {place['unit']}",
                f"{place['channels']}",
                str(place["pixel_type"]),
            ]
        )
    inputs = [
        [option.replace("_", " "), path, "", "", "", ""]
        for option, path in record.get("inputs", {}).items()
        if option not in ("fixed", "moving")
    ]
    return Table(
        "Files",
        [Part(["", "file", f"{_words(record)['voxel']}s", "spacing", "channels", "type"], rows + inputs, words=1)],
    )


def _settings(record: Record) -> Table:
    given = [[name, _plain(setting) or "–"] for name, setting in record["settings"].items()]
    versions = [[name, str(version)] for name, version in record["versions"].items()]
    parts = [Part(["setting", "value"], given, "All settings", words=1), Part(["version of", ""], versions, words=1)]
    return Table("Settings and versions", parts)


def _plain(setting: object) -> str:
    if isinstance(setting, Mapping):
        return ", ".join(f"{key}: {_plain(item)}" for key, item in setting.items())
    return ", ".join(map(str, setting)) if isinstance(setting, list | tuple) else str(setting)


def command_lines(record: Record) -> dict[str, str]:
    """Return the commands that repeat and apply a registration, by a description; none if its record has none."""
    if "command" not in record:
        return {}
    again = {f"Repeat this registration, in {record['folder']}": str(record["command"])}
    lines = apply_commands(record["inputs"], Path(record["inputs"]["out"]))
    return again | {f"Apply it to {what}": line for what, line in lines.items()}


def footer(record: Record) -> str:
    """Return the last line of the page."""
    return f"torchdeform {record['versions']['torchdeform']}. All figures are in result.json, too."
