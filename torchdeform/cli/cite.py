"""``cite``: what to cite for a registration."""

from dataclasses import fields
from pathlib import Path
from typing import Annotated

import typer

from torchdeform.cli.register import Assignments, Config, Preset
from torchdeform.errors import InputError
from torchdeform.io.texts import read_json
from torchdeform.pipeline.citations import bibtex
from torchdeform.pipeline.config import load_settings, parse_override
from torchdeform.registration.settings import RegistrationSettings

ResultFile = Annotated[
    Path | None,
    typer.Argument(metavar="RESULT.json", show_default="settings of the options", help="Record of a registration."),
]


def cite(
    result: ResultFile = None, preset: Preset = "default", config: Config = None, assignments: Assignments = None
) -> None:
    """Print BibTeX of the publications behind a registration: that of RESULT.json, or one with the given settings.

    A comment above each entry says what it is cited for.
    """
    overrides = dict(map(parse_override, assignments or []))
    if result is None:
        typer.echo(bibtex(load_settings(preset, config, overrides)))
    elif preset != "default" or config is not None or overrides:
        raise InputError(f"{result} has settings of its own; leave out --preset, --config and --set")
    else:
        typer.echo(bibtex(recorded_settings(result)))


def recorded_settings(path: Path) -> RegistrationSettings:
    """Return the settings in a ``result.json``, without those that this version does not know.

    Raises:
        InputError: the file cannot be read, or is no record of a registration.
    """
    record = read_json(path, "result.json of a registration")
    settings = record.get("settings") if isinstance(record, dict) else None
    if not isinstance(settings, dict):
        raise InputError(f"{path} is no record of a registration; give the result.json in its folder")
    known = {field.name for field in fields(RegistrationSettings)}
    return load_settings(overrides={key: value for key, value in settings.items() if key in known})
