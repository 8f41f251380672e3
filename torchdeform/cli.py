"""The shell: errors are one sentence on stderr; exit code 0 means done, 1 failed, 2 wrong input."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from torchdeform import __version__
from torchdeform.config import load_settings, parse_override, preset_names
from torchdeform.errors import ComputationError, InputError
from torchdeform.io.files import stem
from torchdeform.pair import Outcome, register_files
from torchdeform.registration.result import Progress as Step

_TRACEBACK = "TORCHDEFORM_TRACEBACK"


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"torchdeform {__version__}")
        raise typer.Exit


Fixed = Annotated[
    Path,
    typer.Argument(metavar="FIXED", help="Image that stays (PNG, JPEG, TIFF, BMP, NIfTI, MetaImage, NRRD; 2D or 3D)."),
]
Moving = Annotated[Path, typer.Argument(metavar="MOVING", help="Image that is warped onto it.")]
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", show_default="named after MOVING", help="Folder for the results; its other files are kept."
    ),
]
Preset = Annotated[str, typer.Option(metavar="NAME", help=f"Settings to start from: {', '.join(preset_names())}.")]
Config = Annotated[
    Path | None, typer.Option(metavar="FILE", help="YAML file with settings that differ from the preset.")
]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting that differs; can be repeated.")
]
Device = Annotated[str, typer.Option(metavar="NAME", help="auto, cpu or cuda.")]
Quiet = Annotated[bool, typer.Option("--quiet", metavar="", help="Print errors only.")]
Version = Annotated[
    bool,
    typer.Option("--version", metavar="", callback=_print_version, is_eager=True, help="Print the version and exit."),
]


def register(
    fixed: Fixed,
    moving: Moving,
    out: Out = None,
    preset: Preset = "default",
    config: Config = None,
    assignments: Assignments = None,
    device: Device = "auto",
    quiet: Quiet = False,
    version: Version = False,
) -> None:
    """Warp MOVING onto FIXED by a map that does not fold.

    Writes warped.*, displacement.nii.gz, transform.h5, inverse.h5, result.json and overview.png, all or none.
    """
    settings = load_settings(preset, config, dict(map(parse_override, assignments or [])))
    with _Bar(quiet) as bar:
        outcome = register_files(fixed, moving, out or Path(stem(moving)), settings, device=device, callback=bar.show)
    if not quiet:
        typer.echo(summary(outcome))


def summary(outcome: Outcome) -> str:
    """Return what a person wants to know of a registration, in five lines."""
    r = outcome.record
    lines = {
        f"similarity ({r['similarity']})": f"{r['similarity_before']:.4g} -> {r['similarity_after']:.4g}",
        "folds": f"{r['folds']}, determinant {r['determinant_min']:.3g} to {r['determinant_max']:.3g}",
        "inverse error": f"{r['inverse_error_mean']:.2g} voxel on average, {r['inverse_error_max']:.2g} at most",
        "seconds": f"{sum(outcome.seconds.values()):.1f} on {r['device']}",
        "results": f"{outcome.folder}{os.sep} ({', '.join(outcome.files)})",
    }
    width = max(map(len, lines))
    return "\n".join(f"{name:<{width}}  {text}" for name, text in lines.items())


class _Bar:
    """A progress bar on stderr, only where a person sees it."""

    def __init__(self, quiet: bool) -> None:
        console = Console(stderr=True)
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[detail]}"),
            TimeElapsedColumn(),
        )
        hidden = quiet or not console.is_terminal
        self._progress = Progress(*columns, console=console, transient=True, disable=hidden)
        self._task = self._progress.add_task("reading", total=1.0, detail="")

    def __enter__(self) -> "_Bar":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, step: Step) -> None:
        """Show one step of the optimisation; a level counts the same whatever its size."""
        done = (step.level + step.step / max(step.steps, 1)) / step.levels
        size = "×".join(map(str, step.shape))
        detail = f"step {step.step}, similarity {step.similarity.mean().item():.4g}"
        self._progress.update(
            self._task, completed=done, description=f"level {step.level + 1}/{step.levels} {size}", detail=detail
        )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``register`` with the shell's arguments, or those given, and return the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(register)
    return _run(app, "register", arguments)


def torchdeform(arguments: Sequence[str] | None = None) -> int:
    """Run ``torchdeform``, whose commands are what can be done, like `main`."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True)
    app.callback()(_root)
    app.command()(register)
    return _run(app, "torchdeform", arguments)


def _root(version: Version = False) -> None:
    """Registration of images by maps that do not fold, built from divergence and curl."""


def _run(app: typer.Typer, name: str, arguments: Sequence[str] | None) -> int:
    """Run a command; whatever goes wrong becomes one sentence and an exit code."""
    try:
        return app(args=arguments, prog_name=name, standalone_mode=False) or 0
    except Exception as error:  # the boundary to the shell: a person gets a sentence, not a traceback
        if os.environ.get(_TRACEBACK):
            raise
        sentence, code = explain(error)
        if sentence:
            typer.echo(f"{name}: {sentence}", err=True)
        return code


def explain(error: Exception) -> tuple[str, int]:
    """Return what to tell a person about an error, and the exit code."""
    if isinstance(error, InputError):
        return str(error), 2
    if isinstance(error, typer.TyperException):
        message = error.format_message().rstrip(".")  # empty where typer has shown the help already
        return f"{message}; see --help" if message else "", error.exit_code
    if isinstance(error, ComputationError):
        return str(error), 1
    if isinstance(error, MemoryError) or "out of memory" in str(error) or "allocate memory" in str(error):
        return "there is not enough memory for images of this size; use a machine with more, or smaller images", 1
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}; check the disk and its permissions", 1
    text = " ".join(str(error).split())
    return f"unexpected {type(error).__name__}: {text}; set {_TRACEBACK}=1 to see where, and report it", 1


if __name__ == "__main__":
    sys.exit(torchdeform())
