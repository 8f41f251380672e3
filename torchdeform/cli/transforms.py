"""``apply``, ``points``, ``invert``, ``compose``, ``jacobian``: work with transforms."""

from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Annotated

import torch
import typer

from torchdeform.cli.options import (
    Json,
    Quiet,
    choice,
    flag,
    inverse_text,
    optional_file,
    print_json,
    say_written,
    warn,
)
from torchdeform.core.diagnostics import diagnose, inverse_error
from torchdeform.core.image import AUTO, Image, same_place
from torchdeform.core.interpolation import COPYING, LABEL_MODE, MODES
from torchdeform.core.transform import Displacement, Transform
from torchdeform.core.warp import voxels
from torchdeform.errors import InputError, require_choice
from torchdeform.io.files import require_target, require_writable, suffix
from torchdeform.io.images import (
    FORMATS,
    read_image,
    read_labels,
    read_optional,
    require_storable,
    write_image,
    write_labels,
)
from torchdeform.io.point_tables import FIXED, MOVING
from torchdeform.io.points import read_points, require_points_file, write_points
from torchdeform.io.transforms import read_transform, require_transform_file, write_transform
from torchdeform.pipeline.preflight import looks_like_labels
from torchdeform.report.record import describe_map

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
    Path, typer.Argument(metavar="POINTS", help="Points: csv, tsv, txt, elastix txt, Slicer fcsv or mrk.json.")
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
Outside = Annotated[
    str, typer.Option(metavar="VALUE", help="Value where MOVING does not reach; auto: what surrounds it, 0 for labels.")
]


def apply(
    transform: TransformFile,
    moving: MovingFile,
    out: OutFile,
    reference: Reference = None,
    interpolation: Interpolation = "linear",
    inverse: Inverse = False,
    outside: Outside = AUTO,
    quiet: Quiet = False,
) -> None:
    """Warp the MOVING image onto the grid of the fixed image: result(x) = MOVING(TRANSFORM(x)).

    Images go from moving to fixed with the same transform that maps points from fixed to moving. With --inverse an
    image of the fixed space goes to the moving space.
    """
    require_choice(interpolation, MODES, "--interpolation")
    _require_image_output(out, transform, moving, reference)
    labels, beyond = interpolation in COPYING, _outside(outside)
    chain = _read(transform, inverse)
    place = _place(chain, reference, transform)
    image = read_labels(moving) if labels else read_image(moving)
    if not labels and looks_like_labels(image):
        warn(f"{moving} looks like labels, which {interpolation} interpolation mixes; use --interpolation {LABEL_MODE}")
    require_storable(beyond, suffix(out), image, labels=labels)
    result = chain.image(image, place, mode=interpolation, outside=beyond)
    (write_labels if labels else write_image)(result, out)
    say_written(out, quiet=quiet)


def points(
    transform: TransformFile,
    points: PointsFile,
    out: OutFile,
    reference: Counted = None,
    inverse: Inverse = False,
    quiet: Quiet = False,
) -> None:
    """Map POINTS of the fixed image to the moving image: result = TRANSFORM(point), in world LPS mm.

    Points go from fixed to moving with the same transform that brings the moving image to the fixed one. With --inverse
    points of the moving image go to the fixed image.
    """
    require_points_file(out)
    _require_output(out, transform, points, reference)
    chain = _read(transform, inverse)
    given = read_points(points, read_optional(reference), dim=chain.dim, side=MOVING if inverse else FIXED)
    write_points(replace(given, positions=chain.points(given.positions)), out)
    say_written(out, quiet=quiet)


def invert(
    transform: TransformFile, out: OutFile, reference: FieldGrid = None, json: Json = False, quiet: Quiet = False
) -> None:
    """Write the inverse of TRANSFORM, which maps points from moving to fixed and images from fixed to moving.

    Affine maps are inverted exactly, displacement fields on their own grid. Prints how far a point is from its start
    after a field and its inverse, in voxels, as register does.
    """
    require_transform_file(out)
    _require_output(out, transform, reference)
    chain = _read(transform)
    inverse = _on_grid(chain.inverse(), reference)
    write_transform(inverse, out)
    if quiet and not json:
        return
    mean, largest = _inverse_error(chain.inverse())
    if json:
        print_json({"out": out, "inverse_error_mean": mean, "inverse_error_max": largest})
    else:
        say_written(out, {"inverse consistency": inverse_text(mean, largest)})


def compose(transforms: TransformFiles, out: OutFile, reference: FieldGrid = None, quiet: Quiet = False) -> None:
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
    say_written(out, quiet=quiet)


def jacobian(
    transform: TransformFile, out: OutFile, reference: Reference = None, json: Json = False, quiet: Quiet = False
) -> None:
    """Write the Jacobian determinant of TRANSFORM on the grid of the fixed image: moving volume over fixed volume.

    Points go from fixed to moving: above 1 a piece of the fixed image is larger in the moving image, below 1 smaller.
    The determinant is that of the whole map, with the alignment; that of the deformation alone is printed, too, as
    register does, and its folds by all one-sided determinants.
    """
    _require_image_output(out, transform, reference)
    chain = _read(transform)
    image = chain.jacobian_determinant(_place(chain, reference, transform))
    write_image(image, out)
    low, high, mean = (float(f(image.data)) for f in (torch.amin, torch.amax, torch.mean))
    parts = [describe_map(diagnose(field.data, field.grid)) for field in _fields(chain)]
    folds = max(int((~(image.data > 0)).sum()), sum(part["folds"] for part in parts))
    if json:
        whole = {"determinant_min": low, "determinant_max": high, "determinant_mean": mean, "folds": folds}
        print_json({"out": out, **whole, "deformations": parts})
        return
    lines = {"determinant": f"{low:.3g} to {high:.3g}, {mean:.3g} on average"}
    if len(chain.stages) > 1:
        ranges = (f"{part['determinant_min']:.3g} to {part['determinant_max']:.3g}" for part in parts)
        lines["without the alignment"] = " and ".join(ranges)
    say_written(out, lines | {"folds": f"{folds}"}, quiet=quiet)


def _read(path: Path, inverse: bool = False) -> Transform:
    chain = read_transform(path)
    return chain.inverse() if inverse else chain


def _place(chain: Transform, reference: Path | None, path: Path) -> Image | None:
    if reference is None and chain.reference is None:
        raise InputError(f"{path} has no grid for the result; give --reference IMAGE")
    return read_optional(reference)


def _outside(text: str) -> float | str:
    """Return the number that a text holds, or ``auto``."""
    if text == AUTO:
        return text
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--outside needs a number or auto, got {text!r}") from error


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
    require_target(out)
    for path in inputs:
        if path is not None and out.exists() and path.exists() and out.samefile(path):
            raise InputError(f"--out {out} is one of the files to read; choose another name")
    if out.is_dir():
        raise InputError(f"--out {out} is a folder; give the name of a file")
    require_writable(out.parent)


def _fields(chain: Transform) -> list[Image]:
    """Return the displacement fields of a transform."""
    return [stage.field for stage in chain.stages if isinstance(stage, Displacement)]


def _inverse_error(inverse: Transform) -> tuple[float, float]:
    """Return mean and maximum of |φ(φ⁻¹(x)) − x| in voxels, for the worst field; affine maps have no error."""
    found = [_field_error(stage) for stage in inverse.stages if isinstance(stage, Displacement)]
    return max((mean for mean, _ in found), default=0.0), max((largest for _, largest in found), default=0.0)


def _field_error(stage: Displacement) -> tuple[float, float]:
    """Return mean and maximum of how far, in voxels, a field and its inverse take the nodes from their places."""
    field, known = stage.field, stage.known_inverse
    if known is None:
        return 0.0, 0.0
    if same_place(field, known):
        mean, largest = inverse_error(known.data.to(field.data), field.data, field.grid)
        return mean.item(), largest.item()
    distance = voxels(Transform((stage, Displacement(known))).flatten(field).field.data, field.grid)
    return distance.mean().item(), distance.max().item()
