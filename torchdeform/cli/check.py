"""``check``: what two images are, what looks wrong with them, and a picture of where they lie."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from torchdeform.cli.options import FixedMask, Json, MovingMask, among, print_json
from torchdeform.core.image import Image
from torchdeform.errors import InputError, require_choice
from torchdeform.io import read_image
from torchdeform.io.files import atomic_folder, suffix
from torchdeform.pipeline.preflight import ERROR, Finding, is_oblique, orientation, preflight
from torchdeform.registration.affine.settings import ALIGNMENTS
from torchdeform.report.figures import write_overlay

Fixed = Annotated[
    Path, typer.Argument(metavar="FIXED", help="Image that shall stay: a file, or a folder with a DICOM series.")
]
Moving = Annotated[Path, typer.Argument(metavar="MOVING", help="Image that shall be warped onto it.")]
Picture = Annotated[
    Path | None, typer.Option("--out", metavar="PICTURE.png", show_default=False, help="Write an overlay picture.")
]
Align = Annotated[
    str,
    typer.Option(metavar="KIND", help=f"{', '.join(ALIGNMENTS)}: shall come first.", autocompletion=among(ALIGNMENTS)),
]


def check(
    fixed: Fixed,
    moving: Moving,
    fixed_mask: FixedMask = None,
    moving_mask: MovingMask = None,
    align: Align = "affine",
    out: Picture = None,
    json: Json = False,
) -> None:
    """Say what FIXED and MOVING are and what looks wrong with them, before they are registered. Nothing is moved.

    Orientations name where x, y and z point to: LPS is left, posterior, superior. Exit code 2 if there is an error.
    """
    require_choice(align, ALIGNMENTS, "--align")
    if out is not None and suffix(out) != ".png":
        raise InputError(f"--out {out}: the picture is a PNG; let its name end in .png")
    images = read_image(fixed), read_image(moving)
    masks = [None if path is None else read_image(path) for path in (fixed_mask, moving_mask)]
    report = preflight(*images, fixed_mask=masks[0], moving_mask=masks[1], aligned=align != "none")
    drawn = _draw(out, *images) if out is not None else None
    (_tell_program if json else _tell_person)(images, report.findings, drawn)
    if report.of(ERROR):
        raise typer.Exit(2)


def _tell_person(images: tuple[Image, Image], findings: Sequence[Finding], picture: Path | None) -> None:
    typer.echo(side_by_side(*images))
    for finding in findings:
        typer.echo(f"{finding.severity}: {finding.text}")
    if not findings:
        typer.echo("nothing looks wrong")
    if picture is not None:
        typer.echo(f"picture: {picture}")


def _tell_program(images: tuple[Image, Image], findings: Sequence[Finding], picture: Path | None) -> None:
    properties = {side: _properties(image) for side, image in zip(("fixed", "moving"), images, strict=True)}
    found = [{"severity": finding.severity, "text": finding.text} for finding in findings]
    print_json({**properties, "findings": found, "picture": picture})


def side_by_side(fixed: Image, moving: Image) -> str:
    """Return what two images are, a property a line."""
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
        "spacing (mm)": " × ".join(f"{h:.4g}" for h in image.grid.spacing[::-1]),
        "origin (mm)": ", ".join(f"{x:.5g}" for x in image.origin),
        "orientation": orientation(image) + (" (oblique)" if is_oblique(image) else ""),
        "intensities": f"{low:.5g} to {high:.5g}, {image.pixel_type}",
        "channels": str(image.data.shape[1]),
    }


def _draw(out: Path, fixed: Image, moving: Image) -> Path | None:
    """Write the overlay and return where it is; None for a picture and a volume, which do not lie on each other."""
    if fixed.grid.dim != moving.grid.dim:
        return None
    with atomic_folder(out.parent) as folder:
        write_overlay(folder / out.name, fixed, moving)
    return out
