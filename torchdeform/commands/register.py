"""``register``: one pair of images, from two files to a folder of results."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from torchdeform.commands.options import Device, Out, Quiet, Version, table
from torchdeform.config import load_settings, parse_override, preset_names
from torchdeform.io.files import stem
from torchdeform.pair import Outcome, register_files
from torchdeform.registration.result import Progress as Step

Fixed = Annotated[
    Path,
    typer.Argument(metavar="FIXED", help="Image that stays (PNG, JPEG, TIFF, BMP, NIfTI, MetaImage, NRRD; 2D or 3D)."),
]
Moving = Annotated[Path, typer.Argument(metavar="MOVING", help="Image that is warped onto it.")]
Preset = Annotated[str, typer.Option(metavar="NAME", help=f"Settings to start from: {', '.join(preset_names())}.")]
Config = Annotated[
    Path | None, typer.Option(metavar="FILE", help="YAML file with settings that differ from the preset.")
]
Assignments = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting that differs; can be repeated.")
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
    return table(lines)


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
