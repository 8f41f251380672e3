"""``apply``, ``points``, ``invert``, ``compose``, ``jacobian``: work with transforms."""

import math
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Annotated

import torch
import typer

from torchdeform.cli.options import Json, Quiet, choice, flag, optional_file, print_json
from torchdeform.core.image import Image
from torchdeform.core.interpolation import COPYING, MODES
from torchdeform.core.transform import Transform
from torchdeform.errors import InputError, require_choice
from torchdeform.io.files import require_writable, suffix
from torchdeform.io.images import FORMATS, read_image, read_labels, read_optional, write_image, write_labels
from torchdeform.io.points import read_points, require_points_file, write_points
from torchdeform.io.transforms import read_transform, require_transform_file, write_transform

TransformFile = Annotated[
    Path,
    typer.Argument(
        metavar="TRANSFORM", help="Transform of ITK, ANTs or torchdeform (.h5, .mat, .tfm, .txt, or a warp .nii.gz)."
    ),
]
TransformFiles = Annotated[
    list[Path],
    typer.Argument(metavar="FIRST SECOND ...", help="Transforms, in the order in which points go through them."),
]
MovingFile = Annotated[Path, typer.Argument(metavar="MOVING", help="Image to warp, any format, 2D or 3D.")]
PointsFile = Annotated[
    Path, typer.Argument(metavar="POINTS", help="Points: csv, tsv, elastix txt, Slicer fcsv or mrk.json.")
]
OutFile = Annotated[Path, typer.Option("--out", metavar="FILE", help="File to write, in the format of its ending.")]
Reference = Annotated[
    Path | None,
    typer.Option(
        metavar="IMAGE",
        show_default="the grid in TRANSFORM",
        help="Fixed image, whose grid the result gets (the moving image with --inverse).",
    ),
]
Counted = Annotated[Path | None, optional_file("Image of the voxels, if POINTS counts in voxels.", "IMAGE")]
FieldGrid = Annotated[
    Path | None,
    typer.Option(
        metavar="IMAGE",
        show_default="the grid in TRANSFORM",
        help="Grid of the result, if that is a field (.nii.gz).",
    ),
]
Interpolation = Annotated[str, choice(MODES, "{}; label or nearest keep values and their type.")]
Inverse = Annotated[bool, flag("--inverse", "Use the inverse of TRANSFORM.")]
Outside = Annotated[float, typer.Option(metavar="VALUE", help="Value where MOVING does not reach.")]


def apply(
    transform: TransformFile,
    moving: MovingFile,
    out: OutFile,
    reference: Reference = None,
    interpolation: Interpolation = "linear",
    inverse: Inverse = False,
    outside: Outside = 0.0,
) -> None:
    """Warp the MOVING image onto the grid of the fixed image: result(x) = MOVING(TRANSFORM(x)).

    Images go from moving to fixed with the same transform that maps points from fixed to moving. With --inverse an
    image of the fixed space goes to the moving space.
    """
    require_choice(interpolation, MODES, "--interpolation")
    _require_image_output(out, transform, moving, reference)
    labels = interpolation in COPYING
    chain = _read(transform, inverse)
    place = _place(chain, reference, transform)
    image = read_labels(moving) if labels else read_image(moving)
    result = chain.image(image, place, mode=interpolation, outside=outside)
    (write_labels if labels else write_image)(result, out)


def points(
    transform: TransformFile,
    points: PointsFile,
    out: OutFile,
    reference: Counted = None,
    inverse: Inverse = False,
) -> None:
    """Map POINTS of the fixed image to the moving image: result = TRANSFORM(point), in world LPS mm.

    Points go from fixed to moving with the same transform that brings the moving image to the fixed one. With --inverse
    points of the moving image go to the fixed image.
    """
    require_points_file(out)
    _require_output(out, transform, points, reference)
    chain = _read(transform, inverse)
    given = read_points(points, read_optional(reference), dim=chain.dim)
    write_points(replace(given, positions=chain.points(given.positions)), out)


def invert(
    transform: TransformFile, out: OutFile, reference: FieldGrid = None, json: Json = False, quiet: Quiet = False
) -> None:
    """Write the inverse of TRANSFORM, which maps points from moving to fixed and images from fixed to moving.

    Affine maps are inverted exactly, displacement fields on their own grid. Prints how far a point is from its start
    after TRANSFORM and its inverse.
    """
    require_transform_file(out)
    _require_output(out, transform, reference)
    chain = _read(transform)
    inverse = _on_grid(chain.inverse(), reference)
    write_transform(inverse, out)
    if quiet and not json:
        return
    mean, largest = (math.nan, math.nan) if chain.reference is None else _round_trip(chain, chain.reference)
    if json:
        print_json({"out": out, "inverse_error_mean_mm": mean, "inverse_error_max_mm": largest})
    elif chain.reference is not None:
        typer.echo(f"inverse consistency  {mean:.2g} mm on average, {largest:.2g} at most")


def compose(transforms: TransformFiles, out: OutFile, reference: FieldGrid = None) -> None:
    """Write one transform for several: points go through FIRST, then SECOND, and so on; images the other way.

    The result maps points of the fixed space of FIRST to the moving space of the last, and images back. ANTs lists its
    transforms in the same order.
    """
    require_transform_file(out)
    _require_output(out, *transforms, reference)
    if len(transforms) < 2:
        raise InputError(
            "compose needs at least two transforms; give them in the order in which points go through them"
        )
    write_transform(_on_grid(reduce(Transform.then, map(_read, transforms)), reference), out)


def jacobian(
    transform: TransformFile, out: OutFile, reference: Reference = None, json: Json = False, quiet: Quiet = False
) -> None:
    """Write the Jacobian determinant of TRANSFORM on the grid of the fixed image: moving volume over fixed volume.

    Points go from fixed to moving: above 1 a piece of the fixed image is larger in the moving image, below 1 smaller;
    0 or less is a fold.
    """
    _require_image_output(out, transform, reference)
    chain = _read(transform)
    image = chain.jacobian_determinant(_place(chain, reference, transform))
    write_image(image, out)
    low, high, mean = (float(f(image.data)) for f in (torch.amin, torch.amax, torch.mean))
    folds = int((~(image.data > 0)).sum())
    if json:
        print_json(
            {"out": out, "determinant_min": low, "determinant_max": high, "determinant_mean": mean, "folds": folds}
        )
    elif not quiet:
        typer.echo(f"determinant  {low:.3g} to {high:.3g}, {mean:.3g} on average")
        typer.echo(f"folds        {folds}")


def _read(path: Path, inverse: bool = False) -> Transform:
    chain = read_transform(path)
    return chain.inverse() if inverse else chain


def _place(chain: Transform, reference: Path | None, path: Path) -> Image | None:
    if reference is None and chain.reference is None:
        raise InputError(f"{path} has no grid for the result; give --reference IMAGE")
    return read_optional(reference)


def _on_grid(chain: Transform, reference: Path | None) -> Transform:
    return chain if reference is None else replace(chain, fixed=read_image(reference))


def _require_image_output(out: Path, *inputs: Path | None) -> None:
    if suffix(out) not in FORMATS:
        raise InputError(f"{out} has no ending that images are written with; use one of {', '.join(FORMATS)}")
    _require_output(out, *inputs)


def _require_output(out: Path, *inputs: Path | None) -> None:
    """Raise `InputError` if the result cannot be written, or would replace a file that it is made from.

    Called before anything is read, so that a wrong name costs no time.
    """
    for path in inputs:
        if path is not None and out.exists() and path.exists() and out.samefile(path):
            raise InputError(f"--out {out} is one of the files to read; choose another name")
    if out.is_dir():
        raise InputError(f"--out {out} is a folder; give the name of a file")
    require_writable(out.parent)


def _round_trip(chain: Transform, place: Image) -> tuple[float, float]:
    """Return mean and maximum of |φ⁻¹(φ(x)) − x| over the nodes, in mm."""
    back = chain.then(chain.inverse()).flatten(place).field.data
    distance = back.square().sum(dim=1).sqrt()
    return float(distance.mean()), float(distance.max())
