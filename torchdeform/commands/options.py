"""Options that several verbs share, under one name and with one meaning."""

from pathlib import Path
from typing import Annotated

import typer

from torchdeform import __version__


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"torchdeform {__version__}")
        raise typer.Exit


Out = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", show_default="named after the image", help="Folder for the results; its other files are kept."
    ),
]
FixedMask = Annotated[
    Path | None, typer.Option(metavar="FILE", show_default="none", help="Where FIXED counts (not 0).")
]
MovingMask = Annotated[
    Path | None, typer.Option(metavar="FILE", show_default="none", help="Where MOVING counts (not 0).")
]
Device = Annotated[str, typer.Option(metavar="NAME", help="auto, cpu or cuda.")]
Quiet = Annotated[bool, typer.Option("--quiet", metavar="", help="Print errors only.")]
Version = Annotated[
    bool,
    typer.Option("--version", metavar="", callback=_print_version, is_eager=True, help="Print the version and exit."),
]


def table(lines: dict[str, str]) -> str:
    """Return names and texts as lines with the texts below each other."""
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {text}" for name, text in lines.items())
