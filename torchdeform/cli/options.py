"""Options that several verbs share, with one name and one meaning each."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import torch
import typer

from torchdeform import __version__
from torchdeform.pipeline.register import DEVICES, choose_device
from torchdeform.report.record import as_json, device_name


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"torchdeform {__version__}, torch {torch.__version__}, {device_name(choose_device('auto'))}")
        raise typer.Exit


def flag(name: str, about: str) -> Any:
    """Return an option that is given or not."""
    return typer.Option(name, metavar="", help=about)


def optional_file(about: str, metavar: str = "FILE") -> Any:
    """Return an option for a file that may be left out."""
    return typer.Option(metavar=metavar, show_default=False, help=about)


def choice(names: Sequence[str], about: str, metavar: str = "NAME", **how: Any) -> Any:
    """Return an option for one of some names, which a shell completes; ``{}`` in its help stands for them."""
    return typer.Option(metavar=metavar, help=about.format(", ".join(names)), autocompletion=lambda: list(names), **how)


Out = Annotated[
    Path | None,
    typer.Option(metavar="DIR", show_default="named after the image", help="Folder for the results."),
]
FixedMask = Annotated[Path | None, optional_file("Where FIXED counts (not 0).")]
MovingMask = Annotated[Path | None, optional_file("Where MOVING counts (not 0).")]
FixedPoints = Annotated[Path | None, optional_file("Landmarks (csv, elastix txt, Slicer), measured ...")]
MovingPoints = Annotated[Path | None, optional_file("... and the same landmarks in MOVING.")]
FixedLabels = Annotated[Path | None, optional_file("Regions, whose overlap is measured ...")]
MovingLabels = Annotated[Path | None, optional_file("... and the same regions of MOVING.")]
FixedFeatures = Annotated[Path | None, optional_file("Channels to compare in place of intensities ...")]
MovingFeatures = Annotated[Path | None, optional_file("... and the same channels of MOVING.")]
Tissue = Annotated[Path | None, optional_file("Tissue of FIXED: say what 1 is by --set tissues.1=rigid.", "LABELS")]
Device = Annotated[str, choice(DEVICES, "auto, cpu or cuda.")]
Quiet = Annotated[bool, flag("--quiet", "Print errors only.")]
Json = Annotated[bool, flag("--json", "Print one JSON record, for programs.")]
Version = Annotated[
    bool,
    typer.Option(
        "--version", metavar="", callback=_print_version, is_eager=True, help="Print versions and device, and exit."
    ),
]


def warn(sentence: str) -> None:
    """Print a warning on stderr, because standard output has the figures only."""
    typer.echo(f"warning: {sentence}", err=True)


def print_json(record: Mapping[str, object]) -> None:
    """Print a record as JSON, the only line on standard output."""
    typer.echo(as_json(record))


def folds_text(record: Mapping[str, Any]) -> str:
    """Return the folds of a map and the range of its determinant, from its record, and of which map they are."""
    aligned = record.get("alignment", {}).get("kind", "none") != "none"
    part = " without the alignment" if aligned else ""
    return f"{record['folds']}, determinant {record['determinant_min']:.3g} to {record['determinant_max']:.3g}{part}"


def inverse_text(mean: float, largest: float) -> str:
    """Return how far a point is from its start after a map and its inverse, in voxels."""
    return f"{mean:.2g} voxel on average, {largest:.2g} at most"


def say_written(path: Path, lines: Mapping[str, str] | None = None, *, quiet: bool = False) -> None:
    """Print some lines and the file that was written, unless nothing is to be printed."""
    if not quiet:
        typer.echo(table({**(lines or {}), "written": str(path)}))


def table(lines: dict[str, str]) -> str:
    """Return names and texts as lines in two columns."""
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {text}" for name, text in lines.items())
