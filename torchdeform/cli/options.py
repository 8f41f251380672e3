"""Options that several verbs share, with one name and one meaning each."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated

import torch
import typer

from torchdeform import __version__
from torchdeform.pipeline.register import DEVICES, choose_device
from torchdeform.report.record import as_json, device_name


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"torchdeform {__version__}, torch {torch.__version__}, {device_name(choose_device('auto'))}")
        raise typer.Exit


def completion(names: Iterable[str]) -> Callable[[], list[str]]:
    """Return the values that a shell offers for an option, for `typer.Option`."""
    return lambda: list(names)


Out = Annotated[
    Path | None,
    typer.Option(metavar="DIR", show_default="named after the image", help="Folder for the results."),
]
FixedMask = Annotated[Path | None, typer.Option(metavar="FILE", show_default=False, help="Where FIXED counts (not 0).")]
MovingMask = Annotated[
    Path | None, typer.Option(metavar="FILE", show_default=False, help="Where MOVING counts (not 0).")
]
Device = Annotated[str, typer.Option(metavar="NAME", help="auto, cpu or cuda.", autocompletion=completion(DEVICES))]
Quiet = Annotated[bool, typer.Option("--quiet", metavar="", help="Print errors only.")]
Json = Annotated[bool, typer.Option("--json", metavar="", help="Print one JSON record, for programs.")]
Version = Annotated[
    bool,
    typer.Option(
        "--version", metavar="", callback=_print_version, is_eager=True, help="Print versions and device, and exit."
    ),
]


def print_json(record: Mapping[str, object]) -> None:
    """Print a record as JSON, the only line on standard output."""
    typer.echo(as_json(record))


def table(lines: dict[str, str]) -> str:
    """Return names and texts as lines in two columns."""
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {text}" for name, text in lines.items())
