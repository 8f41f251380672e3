"""``report.html``: one page without other files, on which a person judges a registration."""

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchdeform.report.pictures import fitting_pictures
from torchdeform.report.record import describe
from torchdeform.report.report_data import ReportData
from torchdeform.report.tables import command_lines, file_name, footer, tables, tiles
from torchdeform.report.verdict import BAD, DOUBTFUL, GOOD, judge

_TEMPLATES = Path(__file__).parent / "templates"
_MARKS = {GOOD: "✓", DOUBTFUL: "!", BAD: "✗"}
_MODES = {"swipe": "swipe", "flicker": "flicker", "checkerboard": "checkerboard", "overlay": "two colours"}


def write_report(path: Path, data: ReportData, record: Mapping[str, Any] | None = None) -> None:
    """Write a page that shows whether a registration went well; it needs no network and has less than 5 MB.

    Args:
        path: the file to write, usually ``report.html``.
        data: what `make_report_data` returns; the page can show its slices.
        record: the content of ``result.json``; when None that of `describe`, which has no commands.
    """
    known = describe(data.result, data.fixed, data.moving) if record is None else record
    page = _render(
        verdict=judge(known),
        marks=_MARKS,
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
