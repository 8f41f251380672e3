"""``register``: one pair of images, from two files to a folder of results."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from torchdeform.cli.options import (
    Device,
    FixedFeatures,
    FixedLabels,
    FixedMask,
    FixedPoints,
    Json,
    MovingFeatures,
    MovingLabels,
    MovingMask,
    MovingPoints,
    Out,
    Quiet,
    Tissue,
    Version,
    choice,
    flag,
    folds_text,
    inverse_text,
    print_json,
    table,
    warn,
)
from torchdeform.cli.progress import StepProgress
from torchdeform.core.memory import parse_size
from torchdeform.io.files import stem
from torchdeform.metrics.similarity import measure_name
from torchdeform.pipeline.config import load_settings, parse_override, preset_names
from torchdeform.pipeline.register import REPORT, REPORTS, Outcome, PairFiles, register_files
from torchdeform.registration.affine.settings import ALIGNMENTS
from torchdeform.registration.verdict import BAD, GOOD, LOOK, MARKS, WARNED
from torchdeform.report.tables import KEPT, kind_of

_BAD_RESULT = 3  # exit code
_PLAIN_MARKS = {GOOD: "OK", LOOK: "!", BAD: "X"}  # for terminals without Unicode
_SAID = {"rigid": ("residual",), "stiff": ("residual", "volume"), "incompressible": ("off", "volume")}  # of tissue
_COLOURS = {GOOD: typer.colors.GREEN, LOOK: typer.colors.YELLOW, BAD: typer.colors.RED}

Report = Annotated[str, choice(REPORTS, "Pictures: {}.", "KIND")]
Overwrite = Annotated[bool, flag("--overwrite", "Replace results of another pair in the folder.")]
Fixed = Annotated[
    Path,
    typer.Argument(metavar="FIXED", help="Image that stays: PNG, TIFF, NIfTI, NRRD, a DICOM folder ..."),
]
Moving = Annotated[Path, typer.Argument(metavar="MOVING", help="Image that is warped onto it.")]
Align = Annotated[str | None, choice(ALIGNMENTS, "First: {} (usual).", "KIND", show_default=False)]
PointsWeight = Annotated[
    float | None, typer.Option(metavar="W", show_default="0", help="Weight of the landmarks in the cost.")
]
Symmetric = Annotated[bool, flag("--symmetric", "Treat both images alike: swapping them inverts the map.")]
Memory = Annotated[
    str | None, typer.Option(metavar="SIZE", show_default="what is free", help="Use at most this, such as 4GB.")
]
Preset = Annotated[str, choice(preset_names(), "From {}.", show_default=False)]
Config = Annotated[
    Path | None, typer.Option(metavar="FILE", help="YAML file with settings that differ from the preset.")
]
Strict = Annotated[bool, flag("--strict", "End with exit code 3 if the verdict is bad.")]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting that differs; can be repeated.")
]


def register(
    fixed: Fixed,
    moving: Moving,
    out: Out = None,
    align: Align = None,
    fixed_mask: FixedMask = None,
    moving_mask: MovingMask = None,
    fixed_points: FixedPoints = None,
    moving_points: MovingPoints = None,
    points_weight: PointsWeight = None,
    fixed_labels: FixedLabels = None,
    moving_labels: MovingLabels = None,
    fixed_features: FixedFeatures = None,
    moving_features: MovingFeatures = None,
    tissue: Tissue = None,
    symmetric: Symmetric = False,
    preset: Preset = "default",
    config: Config = None,
    assignments: Assignments = None,
    memory: Memory = None,
    strict: Strict = False,
    device: Device = "auto",
    report: Report = "full",
    overwrite: Overwrite = False,
    json: Json = False,
    quiet: Quiet = False,
    version: Version = False,
) -> None:
    """Warp MOVING onto FIXED: an alignment, then a map that does not fold.

    Writes report.html (open it: did it work?), warped.*, transform.h5 (warps MOVING, maps points of FIXED), inverse.h5,
    displacement.nii.gz, overview.png and result.json, all or none.
    """
    # Options that were not given must not override the preset and the file.
    shortcuts = {"align": align, "points_weight": points_weight, "symmetric": symmetric or None}
    overrides = {key: value for key, value in shortcuts.items() if value is not None}
    settings = load_settings(preset, config, dict(map(parse_override, assignments or [])) | overrides)
    files = PairFiles(
        fixed=fixed,
        moving=moving,
        out=out or Path(stem(moving)),
        fixed_mask=fixed_mask,
        moving_mask=moving_mask,
        fixed_points=fixed_points,
        moving_points=moving_points,
        fixed_labels=fixed_labels,
        moving_labels=moving_labels,
        fixed_features=fixed_features,
        moving_features=moving_features,
        tissue=tissue,
    )
    limit = None if memory is None else parse_size(memory)
    with StepProgress(quiet) as bar:
        outcome = register_files(
            files, settings, device=device, memory=limit, report=report, overwrite=overwrite, callback=bar.show
        )
    if json:
        print_json({**outcome.record, "out": str(outcome.folder)})
    elif not quiet:
        for warning in outcome.record["warnings"]:
            warn(warning)
        typer.echo(summary(outcome), color=False if os.environ.get("NO_COLOR") else None)
    if strict and outcome.record["verdict"]["kind"] == BAD:
        raise typer.Exit(_BAD_RESULT)


def summary(outcome: Outcome) -> str:
    """Return the verdict and the most important figures of a registration in a few lines."""
    r = outcome.record
    stages = (r[f"similarity_{stage}"] for stage in ("before", "aligned", "after"))
    marks = [f"{mark:.2f}" for mark in stages if mark is not None]
    lines = {
        f"similarity ({measure_name(r['similarity'])})": f"{' -> '.join(marks)} (1: the same)",
        **({} if r["similarity_choice"] is None else {"chosen": r["similarity_choice"]}),
        **_matched(r),
        "folds": folds_text(r),
        "inverse consistency": inverse_text(r["inverse_error_mean"], r["inverse_error_max"]),
        **_measured(r),
        **_kept(r),
        "seconds": f"{sum(r['seconds'].values()):.1f} on {r['device']}",
        "results": f"{outcome.folder}{os.sep} ({', '.join(r['files'])})",
    }
    if REPORT in r["files"]:
        lines["look at"] = str(outcome.folder / REPORT)
    return f"{verdict_text(r['verdict'])}\n{table(lines)}"


def _matched(record: Mapping[str, Any]) -> dict[str, str]:
    """Return how many points the start has found again."""
    if not record["keypoints"]:
        return {}
    found = record["keypoints"][0]
    return {"points": f"{found['matched']} of {found['looked_for']} found again in the other image"}


def verdict_text(verdict: Mapping[str, Any]) -> str:
    """Return the headline of a verdict with its sign, in colour, and the reasons below it that are no warnings."""
    kind = verdict["kind"]
    sign = MARKS[kind] if _can_print(MARKS[kind]) else _PLAIN_MARKS[kind]
    reasons = [
        f"  {finding['text']}"
        for finding in verdict["findings"]
        if finding["kind"] != GOOD and not finding["text"].startswith(WARNED)
    ]
    return "\n".join([typer.style(f"{sign} {verdict['headline']}", fg=_COLOURS[kind], bold=True), *reasons])


def _can_print(text: str) -> bool:
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except UnicodeEncodeError:
        return False
    return True


def _measured(record: dict[str, Any]) -> dict[str, str]:
    """Return lines about labels and landmarks, if they were given."""
    lines, dice = {}, "Dice (labels in the cost)" if record["labels_in_cost"] else "Dice"
    for key, name, unit in (("dice_mean", dice, ""), ("landmark_error_mean", "landmark error", f" {record['unit']}")):
        figures = [f"{stage[key]:.4g}" for stage in record["evaluation"].values() if key in stage]
        if figures:
            lines[name] = " -> ".join(figures) + unit
    return lines


def _kept(record: dict[str, Any]) -> dict[str, str]:
    """Return a line about each label of tissue: how far it is from what its kind asks for."""
    said = {"residual": "{} voxel off a rigid motion", "off": "determinant within {}", "volume": "volume {}"}
    return {
        f"tissue {one['label']} ({kind_of(one)})": ", ".join(
            said[key].format(KEPT[key](one, " -> ")) for key in _SAID.get(one["kind"], ("volume",))
        )
        for one in record["tissue"]
    }
