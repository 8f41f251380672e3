"""``grid``, ``reconstruct``, ``simulate``: the deformation method."""

import os
from pathlib import Path
from typing import Annotated, cast, get_args

import typer

from torchdeform.cli.options import Device, Json, Out, Quiet, choice, flag, folds_text, optional_file, print_json, table
from torchdeform.deformation.velocity import VelocityName
from torchdeform.errors import InputError
from torchdeform.io.files import stem
from torchdeform.pipeline.deformation import (
    GridSettings,
    MonitorName,
    Record,
    adapt_grid_to_file,
    reconstruct_file,
    simulate_file,
)
from torchdeform.pipeline.register import choose_device

ImageFile = Annotated[Path, typer.Argument(metavar="IMAGE", help="Image, 2D or 3D.")]
Monitor = Annotated[str, choice(get_args(MonitorName), "Where cells are small: {} (IMAGE is f itself).")]
FMin = Annotated[float, typer.Option("--f-min", metavar="F", help="Size of the smallest cells, relative to --f-max.")]
FMax = Annotated[float, typer.Option("--f-max", metavar="F", help="Size of the largest cells.")]
Smoothing = Annotated[
    float | None,
    typer.Option(
        metavar="MM",
        show_default="2 voxels; simulate: 1",
        help="Standard deviation of the smoothing, in pixels where there is no spacing.",
    ),
]
Velocity = Annotated[str, choice(get_args(VelocityName), "{}.")]
DisplacementFile = Annotated[
    Path, typer.Argument(metavar="DISPLACEMENT", help="ITK displacement field, such as displacement.nii.gz.")
]
Order = Annotated[int, typer.Option(metavar="N", help="Order of the finite differences, 2 or 4.")]
Refine = Annotated[bool, flag("--refine", "Correct the map to solver precision.")]
Steps = Annotated[
    int | None, typer.Option(metavar="N", show_default=False, help="Write N time steps from the identity to the map.")
]
Labels = Annotated[Path, typer.Option(metavar="FILE", help="Label image on the grid of IMAGE.")]
Volumes = Annotated[
    list[str], typer.Option("--volume", metavar="LABEL=FACTOR", help="New volume over old; can be repeated.")
]
RigidMask = Annotated[Path | None, optional_file("Mask of what must not move (not 0 there).")]


def adapt_grid(
    image: ImageFile,
    monitor: Monitor = "gradient",
    f_min: FMin = 0.2,
    f_max: FMax = 1.0,
    smoothing: Smoothing = None,
    velocity: Velocity = "div_curl",
    out: Out = None,
    device: Device = "auto",
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Adapt a regular grid to IMAGE: cells become small where the monitor f is small, and none folds.

    Writes displacement.nii.gz (where each node goes), monitor.nii.gz, grid.png and result.json.
    """
    # typer knows no Literal types, so `GridSettings` checks the names.
    settings = GridSettings(cast(MonitorName, monitor), f_min, f_max, smoothing, cast(VelocityName, velocity))
    folder = out or Path(f"{stem(image)}-grid")
    record = adapt_grid_to_file(image, folder, settings, choose_device(device))
    off = f"off by {record['determinant_error_mean']:.2g} on average"
    _print(folder, record, {"determinant / monitor": off}, json=json, quiet=quiet)


def reconstruct(
    displacement: DisplacementFile,
    order: Order = 2,
    refine: Refine = False,
    steps: Steps = None,
    out: Out = None,
    device: Device = "auto",
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct the map of DISPLACEMENT from its divergence, its curl and its boundary values.

    Writes displacement.nii.gz, the time steps, grids.png and result.json.
    """
    folder = out or Path(f"{stem(displacement)}-reconstructed")
    record = reconstruct_file(displacement, folder, order, refine, steps, choose_device(device))
    distance = f"{record['distance_max']:.3g} at most, {record['distance_mean']:.3g} on average"
    _print(folder, record, {"distance to the given map": distance}, json=json, quiet=quiet)


def simulate(
    image: ImageFile,
    labels: Labels,
    volume: Volumes,
    rigid_mask: RigidMask = None,
    smoothing: Smoothing = None,
    out: Out = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Grow or shrink labelled regions of IMAGE by given factors, with a smooth map that does not fold.

    Writes simulated.*, labels.*, displacement.nii.gz, transform.h5 (points after the change -> points of IMAGE, as a
    resampler needs it), inverse.h5 (points of IMAGE -> points after the change), grid.png and result.json.
    """
    folder = out or Path(f"{stem(image)}-simulated")
    record = simulate_file(image, labels, _factors(volume), folder, rigid_mask, smoothing)
    reached = ", ".join(f"{v['label']}: {v['reached']:.4f} (asked {v['asked']:g})" for v in record["volumes"])
    _print(folder, record, {"volumes": reached}, json=json, quiet=quiet)


def _factors(texts: list[str]) -> dict[int, float]:
    pairs = [_factor(text) for text in texts]
    if len(dict(pairs)) < len(pairs):
        raise InputError(f"--volume: a label occurs twice in {', '.join(texts)}; give each once")
    return dict(pairs)


def _factor(text: str) -> tuple[int, float]:
    """Return label and factor of ``17=0.95``."""
    label, _, factor = text.partition("=")
    try:
        return int(label), float(factor)
    except ValueError as error:
        raise InputError(f"--volume needs LABEL=FACTOR such as 17=0.95, got {text!r}") from error


def _print(folder: Path, record: Record, lines: dict[str, str], *, json: bool, quiet: bool) -> None:
    """Print the record for a program, or a few lines for a person."""
    if json:
        print_json({**record, "out": str(folder)})
    if json or quiet:
        return
    typer.echo(
        table({**lines, "folds": folds_text(record), "results": f"{folder}{os.sep} ({', '.join(record['files'])})"})
    )
