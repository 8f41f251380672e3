"""Pairs that stand in a CSV or TSV file, one a row."""

import csv
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from torchdeform.batch.cohort import checked_name
from torchdeform.batch.entry import Entry, pair_name
from torchdeform.batch.strict import beside, expand
from torchdeform.config import parse_override
from torchdeform.errors import InputError, nearest_name, require_choice
from torchdeform.io.files import suffix
from torchdeform.pair import PairFiles

_SEPARATORS = {".csv": ",", ".tsv": "\t"}
_FILES = tuple(field.name for field in fields(PairFiles) if field.name != "out")
_COLUMNS = ("name", *_FILES)
_SETTING = "settings."
_EMPTY = ("", "n/a")  # BIDS writes n/a where there is nothing


def table_entries(path: Path) -> list[Entry]:
    """Return the pairs of a table; its paths are relative to its own folder.

    Raises:
        InputError: the file is missing, no table, lacks a column or has one that means nothing, or a row that is wrong;
            with the line.
    """
    require_choice(suffix(path), _SEPARATORS, f"{path}: the ending of a table")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; check the name of the table") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text; save it as UTF-8") from error
    reader = csv.reader(lines, delimiter=_SEPARATORS[suffix(path)])
    titles = [title.strip() for title in next(reader, [])]
    _require_columns(titles, path)
    return [_entry(dict(zip(titles, _cells(row, titles, where), strict=True)), path.parent, where)
            for row in reader if any(map(str.strip, row)) and (where := f"{path} line {reader.line_num}")]  # fmt: skip


def _require_columns(titles: list[str], path: Path) -> None:
    for title in titles:
        if title not in _COLUMNS and not title.startswith(_SETTING):
            hint = nearest_name(title, _COLUMNS) or f"; there are {', '.join(_COLUMNS)} and {_SETTING}KEY"
            raise InputError(f"{path} line 1: there is no column '{title}'{hint}")
        if titles.count(title) > 1:
            raise InputError(f"{path} line 1: the column '{title}' stands there twice")
    for title in ("fixed", "moving"):
        if title not in titles:
            raise InputError(f"{path} line 1: the column '{title}' is missing")


def _cells(row: list[str], titles: list[str], where: str) -> list[str]:
    if len(row) != len(titles):
        raise InputError(f"{where}: it has {len(row)} cells and the first line {len(titles)}")
    return [cell.strip() for cell in row]


def _entry(row: Mapping[str, str], folder: Path, where: str) -> Entry:
    given = {title: cell for title, cell in row.items() if cell not in _EMPTY}
    for title in ("fixed", "moving"):
        if title not in given:
            raise InputError(f"{where}: {title} is empty")
    try:
        files = {key: beside(folder.resolve(), expand(given[key])) for key in _FILES if key in given}
        name = checked_name(given["name"]) if "name" in given else pair_name(files["fixed"], files["moving"], {}, {})
        settings = (
            parse_override(f"{k.removeprefix(_SETTING)}={v}") for k, v in given.items() if k.startswith(_SETTING)
        )
        return Entry(name=name, files=files, where=where, settings=dict(settings))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
