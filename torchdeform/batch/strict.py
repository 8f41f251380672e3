"""What the models of a cohort file are built from: strict records, and paths beside the file."""

import os
from collections.abc import Callable
from pathlib import Path
from string import Template
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, ValidationInfo

from torchdeform.batch.patterns import literal, part_names
from torchdeform.errors import InputError
from torchdeform.memory import parse_size


class Strict(BaseModel):
    """A record that cannot be changed, with no key but its own and no value of another type."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


def expand(text: str) -> str:
    """Return a text with ``$VAR`` and ``${VAR}`` replaced by the environment's values; ``$$`` is a dollar sign.

    Raises:
        InputError: a variable that is not set.
    """
    return _substitute(text, str)


def expand_pattern(text: str) -> str:
    """Return a pattern, expanded as by `expand`; what the variables hold is taken literally."""
    return _substitute(text, literal)


def _substitute(text: str, form: Callable[[str], str]) -> str:
    if "$" not in text:
        return text
    try:
        return Template(text).substitute({name: form(value) for name, value in os.environ.items()})
    except KeyError as error:
        raise InputError(f"the environment variable {error.args[0]} is not set; set it, or write the path") from error
    except ValueError as error:
        raise InputError(f"{text!r} has a $ before no variable's name; write $$ for a dollar sign") from error


def _folder(info: ValidationInfo) -> Path:
    """Return the folder of the cohort file, to which its paths are relative."""
    return (info.context or {}).get("folder", Path())


def _text(value: object) -> str:
    if not isinstance(value, str | Path) or not str(value):
        raise InputError(f"a path is a text, got {value!r}")
    return str(value)


def place(value: object, info: ValidationInfo) -> Path:
    """Return the path that a text of the file stands for."""
    return beside(_folder(info), expand(_text(value)))


def pattern(value: object, info: ValidationInfo) -> str:
    """Return the absolute pattern that a text of the file stands for."""
    text = expand_pattern(_text(value))
    part_names(text)
    return beside(Path(literal(_folder(info).as_posix())), text).as_posix()


def beside(folder: Path, text: str) -> Path:
    """Return a path as it is if it is absolute, else below ``folder``; ``../`` at its beginning leads out of there."""
    path = Path(text).expanduser()
    while path.parts[:1] == ("..",):
        folder, path = folder.parent, Path(*path.parts[1:])
    return folder / path


def _size(value: object) -> object:
    return parse_size(value) if isinstance(value, str) else value


_written = PlainSerializer(lambda value: str(value).replace("$", "$$"), return_type=str, when_used="json")

Place = Annotated[Path, BeforeValidator(place), _written]
Pattern = Annotated[str, BeforeValidator(pattern), _written]
Size = Annotated[int, BeforeValidator(_size), Field(gt=0)]
