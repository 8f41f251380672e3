"""``report.html``: one page without other files, on which a person judges a registration, with its pictures."""

import base64
import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchdeform.metrics.similarity import measure_name
from torchdeform.registration.verdict import MARKS
from torchdeform.report.drawing import (
    Scale,
    difference_scale,
    draw_convergence,
    draw_volumes,
    length_scale,
    rotation_scale,
    signed_scale,
    volume_scale,
)
from torchdeform.report.record import describe
from torchdeform.report.report_data import ReportData, Slices
from torchdeform.report.tables import command_lines, file_name, footer, tables, tiles
from torchdeform.report.web_images import (
    UNITS,
    Frame,
    colours,
    css_stops,
    curve,
    frame_of,
    grey_levels,
    grid_paths,
    image_strip,
)

_TEMPLATES = Path(__file__).parent / "templates"
_MODES = {"swipe": "swipe", "flicker": "flicker", "checkerboard": "checkerboard", "overlay": "two colours"}
# Largest side of a slice in pixels and quality of its JPEG, from the best to one that always fits.
_SIZES = {2: ((900, 88), (700, 80), (500, 70), (350, 50)), 3: ((256, 85), (224, 75), (192, 60), (144, 40))}
_MOST = 4_200_000  # characters of all pictures together
_GRID_LINES = {2: 40, 3: 28}
_CURVE_INCHES = (5.2, 2.5)


def write_report(path: Path, data: ReportData, record: Mapping[str, Any] | None = None) -> None:
    """Write a page that shows whether a registration went well; it needs no network and has less than 5 MB.

    Args:
        path: the file to write, usually ``report.html``.
        data: what `make_report_data` returns; the page can show its slices.
        record: the content of ``result.json``; when None that of `describe`, which has no commands.
    """
    known = describe(data.result, data.fixed, data.moving) if record is None else record
    page = _render(
        verdict=known["verdict"],
        marks=MARKS,
        modes=_MODES,
        fixed_name=file_name(known["fixed"]),
        moving_name=file_name(known["moving"]),
        tiles=tiles(known),
        tables=tables(known),
        commands=command_lines(known),
        footer=footer(known),
        **fitting_pictures(data),
    )
    path.write_text(page, encoding="utf-8")


def _render(**context: object) -> str:
    """Fill the template. All text is escaped, and the page's own script is the only one that can run."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style, script = (Markup((_TEMPLATES / f"report.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    known = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = environment.get_template("report.html")
    return page.render(style=style, script=script, script_hash=f"sha256-{known}", **context)


@dataclass(frozen=True)
class Picture:
    """One figure of the page with its caption: by plane, a strip of slices or the paths of a grid."""

    name: str
    title: str
    caption: str
    strips: Mapping[str, str] = field(default_factory=dict)
    paths: Mapping[str, list[str]] = field(default_factory=dict)
    bar: str = ""
    ticks: tuple[Mapping[str, object], ...] = ()

    @property
    def size(self) -> int:
        """Characters on the page."""
        return sum(map(len, self.strips.values())) + sum(len(p) for paths in self.paths.values() for p in paths)


def fitting_pictures(data: ReportData) -> dict[str, object]:
    """Return the template's values for the pictures of a registration, in the best quality that fits the page."""
    for size in _SIZES[data.result.grid.dim]:
        renderer = _Renderer(data, *size)
        pictures = renderer.pictures()
        if sum(picture.size for group in pictures.values() for picture in group) <= _MOST:
            break
    planes = renderer.planes()
    return {
        "planes": planes,
        "wide": round(sum(plane["shape"] for plane in planes), 3),
        "data": {plane["name"]: {key: plane[key] for key in ("positions", "labels")} for plane in planes},
        "choices": [{"name": name, "title": title} for name, title in _others(data).items()],
        "differences": pictures.pop("Differences"),
        "groups": pictures,
        "curves": _curves(data),
        "dense": len(planes) > 1,
    }


def _others(data: ReportData) -> dict[str, str]:
    """Return the images that can be compared with the fixed one, with their titles."""
    aligned = data.result.affine is not None
    titles = {"warped": "warped", "moving": "moving, aligned" if aligned else "moving", "original": "moving, as it was"}
    return {name: title for name, title in titles.items() if name in data.slices[0].fields}


class _Renderer:
    """Makes the pictures in one size and quality."""

    def __init__(self, data: ReportData, largest: int, quality: int) -> None:
        self._data, self._quality = data, quality
        self._parts = [(cuts, frame_of(cuts.plane, len(cuts.numbers), largest)) for cuts in data.slices]

    def planes(self) -> list[dict[str, Any]]:
        """Return the figures of each plane that the page needs."""
        return [_plane(cuts, frame) for cuts, frame in self._parts]

    def pictures(self) -> dict[str, list[Picture]]:
        """Return all pictures, in groups."""
        scale = difference_scale(self._data.limits["before"])
        titles = {"fixed": "fixed", **_others(self._data)}
        return {
            "Differences": [
                self._map("before", "Difference before the deformation", scale),
                self._map("after", "Difference after it", scale),
            ],
            "Images": [
                Picture(name, title.capitalize(), _CAPTIONS[name], self._strips(name, None))
                for name, title in titles.items()
            ],
            "The map": list(self._maps()),
        }

    def _maps(self) -> Iterator[Picture]:
        limits, dim = self._data.limits, self._data.result.grid.dim
        paths = {cuts.plane.name: grid_paths(cuts, frame, _GRID_LINES[dim]) for cuts, frame in self._parts}
        yield Picture("grid", "Deformed grid", _CAPTIONS["grid"], paths=paths)
        yield self._map("log_det", "Volume: moving / fixed", volume_scale(limits["log_det"]))
        yield self._map("divergence", "Divergence", signed_scale(limits["divergence"]))
        yield self._map(
            "rotation", "Curl" if dim == 2 else "Length of the curl", rotation_scale(limits["rotation"], dim)
        )
        yield self._map("inverse_error", "Inverse consistency", length_scale(limits["inverse_error"]))

    def _map(self, name: str, title: str, scale: Scale) -> Picture:
        """Return a picture in the colours of a scale."""
        ticks = tuple(
            {"place": round(100 * (value - scale.low) / (scale.high - scale.low), 2), "text": text}
            for value, text in scale.ticks
        )
        return Picture(name, title, _CAPTIONS[name], self._strips(name, scale), bar=css_stops(scale), ticks=ticks)

    def _strips(self, name: str, scale: Scale | None) -> dict[str, str]:
        """Return the slices of a field as data URIs, by plane."""
        found = {}
        for cuts, frame in self._parts:
            values = cuts.fields[name]
            pixels = grey_levels(values) if scale is None else colours(values, scale)
            found[cuts.plane.name] = image_strip(pixels, cuts.plane, frame, self._quality)
        return found


_CAPTIONS = {
    "fixed": "The image that stays.",
    "warped": "The moving image after the map: it should look like the fixed one.",
    "moving": "The moving image, on the grid of the fixed one.",
    "original": "The moving image before the alignment.",
    "before": "|fixed − moving|: dark where both agree.",
    "after": "|fixed − warped|, in the same scale.",
    "grid": "Where points of the fixed image are in the moving one. Without folds lines never cross.",
    "log_det": "Size of a piece of tissue in the moving image: 2 (orange) is twice the volume, 0.5 (purple) half.",
    "divergence": "Divergence of the displacement: positive where the moving image is larger, negative where smaller.",
    "rotation": "Curl of the displacement: how much the map rotates.",
    "inverse_error": "In voxels: how far a point is from itself after the map and its inverse.",
}


def _plane(cuts: Slices, frame: Frame) -> dict[str, Any]:
    positions = frame.positions
    return {
        "name": cuts.plane.name,
        "view": f"0 0 {UNITS * frame.across} {UNITS * frame.down}",
        "shape": round(frame.across / frame.down, 5),
        "middle": cuts.middle,
        "positions": positions,
        "position": positions[cuts.middle],
        "labels": [f"slice {number + 1} of {cuts.plane.depth}" for number in cuts.numbers],
    }


def _curves(data: ReportData) -> list[dict[str, object]]:
    """Return the histogram of volumes and the curve of the similarity over the steps."""
    from markupsafe import Markup

    limit, measure = data.limits["log_det"], measure_name(data.result.settings.similarity.measure)
    about_volumes = "How often each change of volume occurs, over all voxels."
    about_steps = f"Similarity ({measure}) over the steps, by level."
    curves = (
        ("Volumes", about_volumes, lambda axes: draw_volumes(axes, data.volumes, limit)),
        ("Convergence", about_steps, lambda axes: draw_convergence(axes, data.result)),
    )
    return [
        {"title": title, "caption": caption, "svg": Markup(curve(title, draw, *_CURVE_INCHES))}
        for title, caption, draw in curves
    ]
