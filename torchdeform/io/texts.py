"""What texts from outside hold: YAML, JSON and rows of tables, in bounded time, and refused in one sentence."""

import csv
import json
import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from torchdeform.errors import InputError, shown
from torchdeform.io.gate import article, read_text

Lines = dict[tuple[str | int, ...], int]

_MOST_ENTRIES = 1_000_000  # of a YAML file, those that aliases repeat counted again
_DEEPEST = 50  # mappings and lists inside one another
_LARGEST = 2**63  # whole numbers beyond it are no setting, size or index

_LONGEST_NUMBER = 400  # characters

_PLAIN = "tag:yaml.org,2002:"
_KINDS = tuple(_PLAIN + kind for kind in ("null", "bool", "int", "float", "str", "seq", "map", "merge"))
_NUMBERS = (f"{_PLAIN}int", f"{_PLAIN}float")
_MERGE = f"{_PLAIN}merge"

T = TypeVar("T")


def parse_yaml(text: str, name: str) -> Any:
    """Return what a YAML text holds: mappings with texts for keys, lists, texts, numbers, truth values, None.

    Args:
        text: the text. Dates are texts, as are whole numbers as keys, and merge keys (``<<``) work.
        name: of the file or the setting, for the sentence.

    Raises:
        InputError: no YAML, a key that is given twice or is no text, a number beyond 2⁶³, a character that no name can
            have, an object of a program, more than 50 levels, or more than a million entries, counted with those that
            aliases repeat.
    """
    return _sentence(lambda: _value(_tree(text, name), {}), text, name)


def yaml_lines(text: str, name: str) -> Lines:
    """Return the line, from 1, of every key and list item of a YAML text, by the keys and positions that lead to it."""
    lines: Lines = {}
    open_nodes: list[tuple[tuple[str | int, ...], Any]] = [((), _sentence(lambda: _tree(text, name), text, name))]
    while open_nodes:
        keys, node = open_nodes.pop()
        for key, child, mark in _children(node):
            lines.setdefault((*keys, *key), mark.line + 1)
            open_nodes.append(((*keys, *key), child))
    return lines


def _children(node: object) -> list[tuple[tuple[str | int, ...], Any, Any]]:
    """Return key (none for what ``<<`` merges in), node and place of what stands in a YAML mapping or list."""
    import yaml

    if isinstance(node, yaml.MappingNode):
        return [(() if key.tag == _MERGE else (key.value,), value, key.start_mark) for key, value in node.value]
    if isinstance(node, yaml.SequenceNode):
        return [((position,), value, value.start_mark) for position, value in enumerate(node.value)]
    return []


def _sentence(work: Callable[[], T], text: str, name: str) -> T:
    """Return what ``work`` returns; what PyYAML raises becomes one sentence."""
    import yaml

    try:
        return work()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" at line {min(mark.line, _lines(text)) + 1}" if mark else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "it cannot be read"
        raise InputError(f"{name} is no valid YAML{line}: {problem}") from error


def _lines(text: str) -> int:
    """Return the number of the last line with anything on it, from 0."""
    return text.rstrip().count("\n")


def _tree(text: str, name: str) -> Any:
    """Return the tree of nodes of a YAML text, None if it is empty."""
    import yaml

    if not _encodes(text):
        raise InputError(f"{name} has a character that no file and no name can have; write it anew")
    _require_bounded(text, name)
    return yaml.compose(text, _loader())


def _require_bounded(text: str, name: str) -> None:
    """Raise `InputError` for too many levels, or too many entries, before anything is made of them."""
    import yaml

    sizes: dict[str, int] = {}  # of what has an anchor and is complete
    inside: list[tuple[str | None, int]] = []  # anchor of each mapping and list that is open, and the entries before it
    count = 0
    for event in yaml.parse(text, _loader()):
        where = f"{name} line {event.start_mark.line + 1}"
        count += 1
        if isinstance(event, yaml.AliasEvent):
            if any(anchor == event.anchor for anchor, _ in inside):
                raise InputError(f"{where}: *{event.anchor} stands inside of itself; write out what it stands for")
            count += sizes.get(event.anchor, 0)
        elif isinstance(event, yaml.CollectionStartEvent):
            inside.append((event.anchor, count))
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = inside.pop()
            sizes |= {anchor: count - before} if anchor else {}
        if len(inside) > _DEEPEST:
            raise InputError(f"{where}: there are more than {_DEEPEST} levels inside one another; write it flatter")
        if count > _MOST_ENTRIES:
            raise InputError(f"{where}: there are more than {_MOST_ENTRIES} entries, aliases written out; write fewer")


@cache
def _loader() -> Any:
    """Return the loader of PyYAML, the fast one in C where there is one, to which dates and a lone = are texts."""
    import yaml

    base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    known = {
        first: [(kind, form) for kind, form in resolvers if kind in _KINDS]
        for first, resolvers in base.yaml_implicit_resolvers.items()
    }
    return type("Loader", (base,), {"yaml_implicit_resolvers": known})


def _value(node: Any, made: dict[Any, Any]) -> Any:
    """Return what a node of YAML stands for; ``made`` are the values of the nodes so far."""
    import yaml

    if node is not None and node not in made:
        if node.tag not in _KINDS:
            _refuse(node, f"{shown(node.tag)} is an object of a program; write plain values")
        if isinstance(node, yaml.MappingNode):
            made[node] = _mapping(node, made)
        elif isinstance(node, yaml.SequenceNode):
            made[node] = [_value(child, made) for child in node.value]
        else:
            made[node] = _scalar(node)
    return made.get(node)


def _mapping(node: Any, made: dict[Any, Any]) -> dict[str, Any]:
    """Return a mapping, its own keys laid over those that ``<<`` merges in, of which the first counts."""
    own: dict[str, Any] = {}
    for key, child in node.value:
        name = _MERGE if key.tag == _MERGE else _value(key, made)
        name = str(name) if type(name) is int else name
        if not isinstance(name, str):
            _refuse(key, f"the key {shown(name)} is no text; write it in quotes")
        if name in own:
            _refuse(key, f"{shown(key.value)[1:-1]} is given twice")
        own[name] = _value(child, made)
        if name == _MERGE and not all(isinstance(one, dict) for one in _listed(own[name])):
            _refuse(key, "<< takes a mapping or a list of mappings")
    merged: dict[str, Any] = {}
    for one in reversed(_listed(own.pop(_MERGE, []))):
        merged |= one
    return merged | own


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _scalar(node: Any) -> Any:
    """Return a text, a number, a truth value or None."""
    import yaml

    if len(node.value) > _LONGEST_NUMBER and node.tag in _NUMBERS:
        _refuse(node, f"a number of {len(node.value)} digits is too long")
    try:
        value = yaml.constructor.SafeConstructor().construct_object(node)
    except (ValueError, KeyError, IndexError):  # PyYAML's, for numbers of too many digits and tags that do not fit
        _refuse(node, f"{shown(node.value)} is no {node.tag.removeprefix(_PLAIN)} that can be used")
    if problem := _problem(value):
        _refuse(node, problem)
    return value


def _refuse(node: Any, problem: str) -> NoReturn:
    import yaml

    raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


def _problem(value: object) -> str | None:
    """Return what is wrong with a text or a number, None if nothing is."""
    if isinstance(value, int) and abs(value) > _LARGEST:
        return f"{shown(value)} is too large a number"
    if isinstance(value, str) and ("\0" in value or not _encodes(value)):
        return f"{shown(value)} has a character that no file and no name can have"
    return None


def _encodes(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def to_yaml(content: Mapping[str, object]) -> str:
    """Return plain values as YAML text, keys in their order."""
    import yaml

    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True, width=120)


def read_json(path: Path, what: str) -> Any:
    """Return what a JSON file holds; numbers are finite.

    Args:
        path: the file.
        what: what is asked for, say ``result.json of a registration``, for the sentence.

    Raises:
        InputError: no file, no JSON, a number beyond 2⁶³ or not finite, or a character that no name can have.
    """
    return parse_json(read_text(path, what), str(path), what)


def parse_json(text: str, name: str, what: str) -> Any:
    """Return what a JSON text holds, see `read_json`; ``name`` is that of the file."""
    try:
        content = json.loads(text, parse_int=_whole, parse_float=_finite, parse_constant=_finite)
        for part in _texts_in(content):
            if problem := _problem(part):
                raise InputError(problem)
    except RecursionError:
        reason = "it has too many levels"
    except ValueError as error:
        reason = str(error)
    else:
        return content
    raise InputError(f"{name} is no valid JSON ({reason}); give {article(what)}")


def _texts_in(content: object) -> Iterator[str]:
    """Yield the texts in lists and mappings."""
    parts = [content]
    while parts:
        part = parts.pop()
        if isinstance(part, str):
            yield part
        elif isinstance(part, dict):
            parts += [*part, *part.values()]
        elif isinstance(part, list):
            parts += part


def _whole(digits: str) -> int:
    if len(digits) > len(str(_LARGEST)) + 1:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{shown(text)} is no finite number")
    return value


def csv_rows(text: str, name: str, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and cells of the rows of a table, rows without anything in them left out.

    Raises:
        InputError: quotes that make a cell of more than 131,072 characters.
    """
    reader = csv.reader(StringIO(text, newline=""), delimiter=separator)
    try:
        yield from ((reader.line_num, row) for row in reader if any(map(str.strip, row)))
    except csv.Error as error:
        raise InputError(f"{name} line {reader.line_num}: {error}; check the quotes there") from error
