"""``index.html``: all pairs of a cohort in a table that sorts, with links to their reports."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdeform import __version__

if TYPE_CHECKING:
    from torchdeform.batch.summary import Failure, Row

_TEMPLATES = Path(__file__).parent / "templates"
_SHOWN = ("report.html", "overview.png")  # what a pair's name leads to, the first that is there
_STATUSES = ("done", "failed", "waiting")


def write_page(path: Path, rows: "Sequence[Row]", failures: "Iterable[Failure]") -> None:
    """Write the page of a cohort; every text in it is escaped.

    Args:
        path: the file; links are relative to its folder.
        rows: of the summary, all with the same columns.
        failures: what failed, with sentences and logs.
    """
    from jinja2 import Environment, FileSystemLoader

    loader = FileSystemLoader(_TEMPLATES)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    why = {failure.name: failure for failure in failures}
    statuses = [str(row["status"]) for row in rows]
    text = environment.get_template(path.name).stream(
        columns=[column for column in _columns(rows) if column not in ("name", "status", "folder")],
        rows=({"cells": row, "link": _link(path.parent, row), **_trouble(path.parent, row, why)} for row in rows),
        counts={status: statuses.count(status) for status in _STATUSES},
        title=path.absolute().parent.name,
        version=__version__,
    )
    part = path.with_name(f".{path.name}.part")
    with part.open("w", encoding="utf-8") as file:
        file.writelines(text)
    part.replace(path)


def _columns(rows: "Sequence[Row]") -> list[str]:
    """Return the columns that some pair has a figure in."""
    return [column for column in (rows[0] if rows else ()) if any(row[column] != "" for row in rows)]


def _link(folder: Path, row: "Row") -> str:
    """Return what a pair's name leads to, relative to the page; empty if there is nothing."""
    if not row["folder"]:
        return ""
    return next((f"{row['folder']}/{name}" for name in _SHOWN if (folder / str(row["folder"]) / name).is_file()), "")


def _trouble(folder: Path, row: "Row", why: "Mapping[str, Failure]") -> dict[str, Any]:
    failure = why.get(str(row["name"])) if row["status"] == "failed" else None
    if failure is None:
        return {"sentence": "", "log": ""}
    log = failure.log
    return {"sentence": failure.sentence, "log": log.relative_to(folder).as_posix() if log and log.is_file() else ""}
