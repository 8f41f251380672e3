"""``check``: the properties of two images, what looks wrong with them, and a picture of both."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from torchdeform.cli.options import (
    FixedFeatures,
    FixedLabels,
    FixedMask,
    FixedPoints,
    Json,
    MovingFeatures,
    MovingLabels,
    MovingMask,
    MovingPoints,
    Tissue,
    choice,
    print_json,
)
from torchdeform.core.image import Image, is_oblique, orientation
from torchdeform.errors import InputError, TorchdeformError, require_choice
from torchdeform.io import read_image
from torchdeform.io.files import atomic_file, require_target, suffix
from torchdeform.io.images import read_labels, read_optional
from torchdeform.io.point_tables import FIXED, MOVING
from torchdeform.io.points import read_points
from torchdeform.pipeline.annotations import check_annotations, check_features
from torchdeform.pipeline.config import load_settings
from torchdeform.pipeline.preflight import ERROR, Finding, Report, preflight
from torchdeform.pipeline.tissue import check_tissue
from torchdeform.registration.affine.settings import ALIGNMENTS
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.placement import place
from torchdeform.registration.settings import FILES, RegistrationSettings
from torchdeform.report.figures import write_overlay

Fixed = Annotated[
    Path, typer.Argument(metavar="FIXED", help="Image that stays: a file, or a folder with a DICOM series.")
]
Moving = Annotated[Path, typer.Argument(metavar="MOVING", help="Image that is to be warped onto it.")]
Picture = Annotated[
    Path | None, typer.Option("--out", metavar="PICTURE.png", show_default=False, help="Write an overlay picture.")
]
Align = Annotated[str, choice(ALIGNMENTS, "Alignment: {}.", "KIND")]


def check(
    fixed: Fixed,
    moving: Moving,
    fixed_mask: FixedMask = None,
    moving_mask: MovingMask = None,
    fixed_points: FixedPoints = None,
    moving_points: MovingPoints = None,
    fixed_labels: FixedLabels = None,
    moving_labels: MovingLabels = None,
    fixed_features: FixedFeatures = None,
    moving_features: MovingFeatures = None,
    tissue: Tissue = None,
    align: Align = "affine",
    out: Picture = None,
    json: Json = False,
) -> None:
    """Show the properties of FIXED and MOVING and what looks wrong with them. Nothing is registered.

    Orientations say where x, y and z point to: LPS is left, posterior, superior. Exit code 2 if there is an error.
    """
    # Options are checked before images are read, which may take long.
    require_choice(align, ALIGNMENTS, "--align")
    if out is not None and suffix(out) != ".png":
        raise InputError(f"--out {out}: the picture is a PNG; give a name that ends in .png")
    if out is not None:
        require_target(out)
    images = read_image(fixed), read_image(moving)
    masks = read_optional(fixed_mask), read_optional(moving_mask)
    found = preflight(*images, fixed_mask=masks[0], moving_mask=masks[1], aligned=align != "none")
    more = (
        *_check_annotations(images[0], FIXED, fixed_points, fixed_labels),
        *_check_annotations(images[1], MOVING, moving_points, moving_labels),
        *([] if tissue is None else check_tissue(images[0], read_labels(tissue))),
        *check_features(images, (read_optional(fixed_features), read_optional(moving_features))),
    )
    report = Report.made_of(*found.findings, *more)
    settings = load_settings("default", overrides={"align.kind": align, "features": fixed_features and FILES})
    predicted = None if report.of(ERROR) else _predicted(*images, *masks, settings)
    drawn = _draw(out, *images) if out is not None else None
    (_print_json if json else _print_text)(images, report.findings, predicted, drawn)
    if report.of(ERROR):
        raise typer.Exit(2)


def _check_annotations(image: Image, side: str, points: Path | None, labels: Path | None) -> Iterator[Finding]:
    """Return what looks wrong with the landmarks and the labels of an image."""
    positions = None if points is None else read_points(points, image, side=side).positions
    return check_annotations(image, positions, points, None if labels is None else read_labels(labels))


def _predicted(
    fixed: Image, moving: Image, fixed_mask: Image | None, moving_mask: Image | None, settings: RegistrationSettings
) -> str | None:
    """Return a sentence on the similarity that `register` will choose, or on why it cannot begin."""
    try:
        return place(fixed, moving, settings, Annotations(fixed_mask=fixed_mask, moving_mask=moving_mask)).choice
    except TorchdeformError as error:
        return str(error)


def _print_text(
    images: tuple[Image, Image], findings: Sequence[Finding], predicted: str | None, picture: Path | None
) -> None:
    typer.echo(side_by_side(*images))
    for finding in findings:
        typer.echo(f"{finding.severity}: {finding.text}")
    if not findings:
        typer.echo("nothing looks wrong")
    if predicted is not None:
        typer.echo(f"register will choose: {predicted}")
    if picture is not None:
        typer.echo(f"picture: {picture}")


def _print_json(
    images: tuple[Image, Image], findings: Sequence[Finding], predicted: str | None, picture: Path | None
) -> None:
    properties = {side: _properties(image) for side, image in zip(("fixed", "moving"), images, strict=True)}
    found = [{"severity": finding.severity, "text": finding.text} for finding in findings]
    print_json({**properties, "findings": found, "predicted": predicted, "picture": picture})


def side_by_side(fixed: Image, moving: Image) -> str:
    """Return the properties of two images in two columns, one property per line."""
    columns = [{"": name, **_properties(image)} for name, image in (("fixed", fixed), ("moving", moving))]
    widths = [max(len(text) for text in column.values()) for column in columns]
    left = max(map(len, columns[0]))
    rows = (
        f"{name:<{left}}  " + "  ".join(f"{c[name]:<{w}}" for c, w in zip(columns, widths, strict=True))
        for name in columns[0]
    )
    return "\n".join(row.rstrip() for row in rows)


def _properties(image: Image) -> dict[str, str]:
    low, high = (float(end) for end in image.data.aminmax())
    return {
        "file": image.name,
        "size": " × ".join(map(str, image.grid.shape[::-1])),
        "spacing": " × ".join(f"{image.in_unit(h):.4g}" for h in image.grid.spacing[::-1]) + f" {image.unit}",
        "origin": ", ".join(f"{image.in_unit(x):.5g}" for x in image.origin) + f" {image.unit}",
        "orientation": orientation(image) + (" (oblique)" if is_oblique(image) else ""),
        "intensities": f"{low:.5g} to {high:.5g}, {image.pixel_type}",
        "channels": str(image.data.shape[1]),
    }


def _draw(out: Path, fixed: Image, moving: Image) -> Path | None:
    """Write the overlay and return its path; None for a picture and a volume, which cannot be overlaid."""
    if fixed.grid.dim != moving.grid.dim:
        return None
    with atomic_file(out) as new:
        write_overlay(new, fixed, moving)
    return out
