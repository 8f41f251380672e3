"""``report.html``: one page without other files, on which a person judges a registration, with its pictures."""

import base64
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchdeform.registration.verdict import MARKS
from torchdeform.report.contours import Lines
from torchdeform.report.drawing import (
    LINES,
    Scale,
    difference_scale,
    draw_convergence,
    draw_volumes,
    length_scale,
    moved_lines,
    rotation_scale,
    signed_scale,
    volume_scale,
)
from torchdeform.report.legend import legend
from torchdeform.report.marks import ABSENT, NO_DATA, REGIONS, TISSUE, WORST, Mark
from torchdeform.report.planes import SIDES, WORDS
from torchdeform.report.record import describe
from torchdeform.report.report_data import ReportData, Slices
from torchdeform.report.sampling import FIXED, MOVING, ORIGINAL, WARPED
from torchdeform.report.tables import command_lines, file_name, footer, tables, tiles
from torchdeform.report.web_images import (
    UNITS,
    Bar,
    Frame,
    bar_of,
    colours,
    curve,
    frame_of,
    grey_levels,
    image_strip,
    svg_paths,
)

_TEMPLATES = Path(__file__).parent / "templates"
_MODES = {"swipe": "swipe", "flicker": "flicker", "checkerboard": "checkerboard", "overlay": "two colours"}
# Largest side of a slice in pixels and quality of its JPEG, from the best to one that always fits.
_SIZES = {2: ((900, 88), (700, 80), (500, 70), (350, 50)), 3: ((256, 85), (224, 75), (192, 60), (144, 40))}
_MOST = 4_200_000  # characters of all pictures together
_IMAGES_IN_ALL = 8  # about how many times the size of one image they have
_GRID_LINES = {2: 40, 3: 20}
_HATCHES = 80  # lines of a hatched area across a picture
GRID = "grid"
_SCRIPTED = ("positions", "labels", "start", "lines")  # what the page's script needs of a plane
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
        worst=data.known.worst.reason,
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
    page = environment.get_template("report.html")
    return page.render(style=style, script=script, script_hash=script_hash(script), **context)


def script_hash(script: str) -> str:
    """Return the name of a script in a page's Content-Security-Policy, which lets no other script run."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}"


@dataclass(frozen=True)
class Line:
    """Lines that are drawn over pictures, by plane a path for each slice."""

    id: str
    mark: Mark
    paths: Mapping[str, list[str]]


@dataclass(frozen=True)
class Picture:
    """One figure of the page with its caption: by plane a strip of slices, or lines alone, and lines over them."""

    name: str
    title: str
    caption: str
    strips: Mapping[str, str] = field(default_factory=dict)
    lines: Sequence[Line] = ()
    bar: Bar | None = None


def fitting_pictures(data: ReportData) -> dict[str, object]:
    """Return the template's values for the pictures of a registration, in the best quality that fits the page."""
    sizes = _SIZES[data.result.grid.dim]
    frames = _frames(data, sizes[0][0])
    lines = list(_lines(data, frames))
    pictures: dict[str, list[Picture]] = {}
    for size in sizes:
        renderer = _Renderer(data, lines, *size)
        if size is not sizes[-1] and renderer.likely_size() > _MOST:
            continue
        pictures = renderer.pictures()
        if _size(lines, pictures) <= _MOST:
            break
    planes = [_plane(cuts, frame, lines) for cuts, frame in frames]
    return {
        "planes": planes,
        "wide": round(sum(plane["shape"] for plane in planes), 3),
        "data": {plane["name"]: {key: plane[key] for key in _SCRIPTED} for plane in planes},
        "choices": [{"name": name, "title": title} for name, title in _others(data).items()],
        "lines": lines,
        "stage_lines": {
            "above": [line for line in lines if line.mark.kind == NO_DATA],  # part of the image that is compared
            "over": [line for line in lines if line.mark.kind not in (GRID, NO_DATA)],
        },
        "legend": legend(data),
        "hatch": UNITS * max(max(frame.down, frame.across) for _, frame in frames) // _HATCHES,
        "differences": pictures.pop("Differences"),
        "groups": pictures,
        "curves": _curves(data),
        "dense": len(planes) > 1,
    }


def _frames(data: ReportData, largest: int) -> list[tuple[Slices, Frame]]:
    return [(cuts, frame_of(cuts.plane, len(cuts.numbers), largest)) for cuts in data.slices]


def _lines(data: ReportData, frames: Sequence[tuple[Slices, Frame]]) -> Iterator[Line]:
    """Yield what is drawn over the slices, and the grid, the planes together."""
    found: dict[Mark, dict[str, list[str]]] = {}
    for cuts, frame in frames:
        marks = dict(cuts.marks) if data.light else cuts.marks | {Mark(GRID, FIXED, LINES): _grids(cuts)}
        for mark, lines in marks.items():
            found.setdefault(mark, {})[cuts.plane.name] = svg_paths(lines, cuts.plane, frame)
    for k, (mark, paths) in enumerate(found.items()):
        yield Line(f"line-{k}", mark, paths)


def _size(lines: Sequence[Line], pictures: Mapping[str, Sequence[Picture]]) -> int:
    """Return the characters that pictures take on the page."""
    paths = sum(len(path) for line in lines for paths in line.paths.values() for path in paths)
    return paths + sum(len(strip) for group in pictures.values() for p in group for strip in p.strips.values())


def _others(data: ReportData) -> dict[str, str]:
    """Return the images that can be compared with the fixed one, with their titles."""
    aligned = data.result.affine is not None
    titles = {WARPED: "warped", MOVING: "moving, aligned" if aligned else "moving", ORIGINAL: "moving, as it was"}
    shown = data.slices[0].fields.keys() - ({ORIGINAL} if data.light else set())
    return {name: title for name, title in titles.items() if name in shown}


class _Renderer:
    """Makes the pictures in one size and quality."""

    def __init__(self, data: ReportData, lines: Sequence[Line], largest: int, quality: int) -> None:
        self._data, self._all_lines, self._quality = data, lines, quality
        self._parts = _frames(data, largest)

    def likely_size(self) -> int:
        """Return about how many characters everything takes, from the size of one image."""
        return _size(self._all_lines, {}) + _IMAGES_IN_ALL * sum(map(len, self._strips(FIXED, None).values()))

    def pictures(self) -> dict[str, list[Picture]]:
        """Return all pictures, in groups."""
        scale, light = difference_scale(self._data.limits["before"]), self._data.light
        titles = {FIXED: "fixed", **_others(self._data)}
        differences = [
            self._map("before", "Difference before the deformation", scale, self._over(MOVING, *REGIONS, WORST)),
            self._map("after", "Difference after it", scale, self._over(WARPED, *REGIONS, WORST)),
        ]
        images = [
            Picture(name, title.capitalize(), _CAPTIONS[name], self._strips(name, None), self._over(name))
            for name, title in titles.items()
        ]
        found = {"Differences": differences, "Images": images}
        return found if light else found | {"The map": list(self._maps())}

    def _over(self, image: str, *kinds: str) -> list[Line]:
        """Return the lines that belong over an image: its own and those of the fixed one, of some kinds or all."""
        return [
            line
            for line in self._all_lines
            if line.mark.image in (FIXED, image) and (line.mark.kind in kinds if kinds else line.mark.kind != GRID)
        ]

    def _maps(self) -> Iterator[Picture]:
        limits, dim = self._data.limits, self._data.result.grid.dim
        yield Picture(GRID, "Deformed grid", _CAPTIONS[GRID], lines=self._over(FIXED, GRID))
        size, scale = WORDS[dim]["volume"].capitalize(), volume_scale(limits["log_det"])
        yield self._map("log_det", f"{size}: moving / fixed", scale, self._over(FIXED, ABSENT, TISSUE))
        yield self._map("divergence", "Divergence", signed_scale(limits["divergence"]))
        yield self._map(
            "rotation", "Curl" if dim == 2 else "Length of the curl", rotation_scale(limits["rotation"], dim)
        )
        yield self._map("inverse_error", "Inverse consistency", length_scale(limits["inverse_error"]))

    def _map(self, name: str, title: str, scale: Scale, lines: Sequence[Line] = ()) -> Picture:
        """Return a picture in the colours of a scale."""
        caption = _CAPTIONS[name].format(**WORDS[self._data.result.grid.dim])
        return Picture(name, title, caption, self._strips(name, scale), lines, bar_of(scale))

    def _strips(self, name: str, scale: Scale | None) -> dict[str, str]:
        """Return the slices of a field as data URIs, by plane; those of the map, which is smooth, in half the size."""
        found = {}
        for cuts, frame in self._parts:
            values = cuts.fields[name]
            pixels = grey_levels(values) if scale is None else colours(values, scale)
            size = frame.half if name in _SMOOTH else frame
            found[cuts.plane.name] = image_strip(pixels, cuts.plane, size, self._quality)
        return found


_SMOOTH = ("log_det", "divergence", "rotation", "inverse_error")
_CAPTIONS = {
    "fixed": "The image that stays.",
    "warped": "The moving image after the map: it should look like the fixed one.",
    "moving": "The moving image, on the grid of the fixed one.",
    "original": "The moving image before the alignment.",
    "before": "|fixed − moving|: dark where both agree.",
    "after": "|fixed − warped|, in the same scale.",
    "grid": "Where points of the fixed image are in the moving one. Without folds lines never cross.",
    "log_det": "Size of a piece of tissue in the moving image: 2 (orange) is twice the {volume}, 0.5 (purple) half.",
    "divergence": "Divergence of the displacement: positive where the moving image is larger, negative where smaller.",
    "rotation": "Curl of the displacement: how much the map rotates.",
    "inverse_error": "In {voxel}s: how far a point is from itself after the map and its inverse.",
}


def _grids(cuts: Slices) -> Sequence[Lines]:
    """Return the deformed grid of every slice."""
    count = _GRID_LINES[cuts.plane.grid.dim]
    return [moved_lines(cuts.plane, u, count) for u in cuts.fields["u"]]


def _plane(cuts: Slices, frame: Frame, lines: Sequence[Line]) -> dict[str, Any]:
    positions, name = frame.positions, cuts.plane.name
    return {
        "name": name,
        "view": f"0 0 {UNITS * frame.across} {UNITS * frame.down}",
        "shape": round(frame.across / frame.down, 5),
        "start": cuts.start,
        "positions": positions,
        "position": positions[cuts.start],
        "labels": [f"slice {number + 1} of {cuts.plane.depth}" for number in cuts.numbers],
        "letters": dict(zip(SIDES, cuts.plane.letters, strict=False)),
        "lines": {line.id: line.paths[name] for line in lines if name in line.paths} if len(positions) > 1 else {},
    }


def _curves(data: ReportData) -> list[dict[str, object]]:
    """Return the histogram of volumes and the curve of the similarity over the steps."""
    from markupsafe import Markup

    limit, measure = data.limits["log_det"], data.result.settings.maximised
    words = WORDS[data.result.grid.dim]
    about_volumes = "How often each change of {volume} occurs, over all {voxel}s.".format(**words)
    about_steps = f"Similarity ({measure}) over the steps, by level."
    curves = (
        (
            f"{words['volume'].capitalize()}s",
            about_volumes,
            lambda axes: draw_volumes(axes, data.volumes, limit, words),
        ),
        ("Convergence", about_steps, lambda axes: draw_convergence(axes, data.result)),
    )
    return [
        {"title": title, "caption": caption, "svg": Markup(curve(title, draw, *_CURVE_INCHES))}
        for title, caption, draw in curves
    ]
