"""Patterns of paths with named parts, ``sub-{subject}/ses-{session}/*_T1w.nii.gz``: find files, fill in parts."""

import glob
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torchdeform.errors import InputError, nearest_name, shown
from torchdeform.io.isolated import isolated

_TOKENS = re.compile(r"\{(?P<part>[A-Za-z_]\w*)\}|(?P<folders>\*\*/)|\[(?P<one>[^\]]+)\]|(?P<any>\*+)|(?P<single>\?)")
_SPECIAL = frozenset("*?[{}")
_ANYTHING = "[^/]+?"
_LONGEST = 10_000  # characters of a regular expression
_SECONDS, _SECONDS_PER_NAME = 10.0, 1e-4  # that matching may take


@dataclass(frozen=True)
class FoundFile:
    """A file that matches a pattern, and the named parts of its path."""

    path: Path
    parts: Mapping[str, str]


def literal(text: str) -> str:
    """Return the pattern that matches only this text."""
    return "".join(f"[{character}]" if character in _SPECIAL else character for character in text)


def part_names(pattern: str) -> tuple[str, ...]:
    """Return the names of the parts of a pattern, in their order.

    Raises:
        InputError: a brace without a name.
    """
    rest = _TOKENS.sub("", pattern)
    if "{" in rest or "}" in rest:
        raise InputError(f"{shown(pattern)}: a part is written {{name}}, with letters, digits and _ only")
    return tuple(dict.fromkeys(token["part"] for token in _TOKENS.finditer(pattern) if token["part"]))


def find(pattern: str, parts: Mapping[str, str]) -> list[FoundFile]:
    """Return the files that match a pattern, sorted by their paths; numbers in paths are sorted by value.

    Args:
        pattern: absolute path with ``*``, ``?``, ``[abc]``, ``**/`` for any folders, and ``{part}``. A part that occurs
            twice must be the same in both places.
        parts: regular expressions that parts must match, by name; anything but / if none is given.
    """
    paths = [Path(path) for path in _matching(pattern)]
    return _matched(_translated(pattern, parts), {path.as_posix(): path for path in paths}, pattern)


def search(folder: Path, expression: str) -> list[FoundFile]:
    """Return the files below a folder whose whole path there matches a regular expression with named groups."""
    files = (path for path in folder.rglob("*") if not path.is_dir())
    return _matched(expression, {path.relative_to(folder).as_posix(): path for path in files}, expression)


def _matched(expression: str, files: Mapping[str, Path], written: str) -> list[FoundFile]:
    """Return the files whose names match, sorted; ``written`` is the expression as it stands in the cohort file.

    Notes:
        Python's matching has no limit of time, and nested repetitions may take for ever, so another process does it.
    """
    compiled(expression, written)
    seconds = _SECONDS + _SECONDS_PER_NAME * len(files)
    try:
        found = isolated(match_names, expression, list(files), path=Path(), size=0, seconds=seconds)
    except InputError as error:
        raise InputError(f"{shown(written)} takes too long to match; write it without repetitions in others") from error
    return sorted(
        (FoundFile(files[name], parts) for name, parts in found), key=lambda one: natural_key(one.path.as_posix())
    )


def match_names(expression: str, names: list[str]) -> list[tuple[str, dict[str, str]]]:
    """Return the names that match a regular expression, and their parts."""
    pattern = re.compile(expression)
    return [(name, match.groupdict("")) for name in names if (match := pattern.fullmatch(name))]


def fill_parts(pattern: str, parts: Mapping[str, str]) -> str:
    """Return a pattern with its parts filled in."""
    return _TOKENS.sub(lambda token: literal(parts[token["part"]]) if token["part"] else token[0], pattern)


def single_file(pattern: str) -> Path:
    """Return the one file that a pattern without parts matches.

    A pattern without wildcards is a path, whether it exists or not.

    Raises:
        InputError: several files match, or none.
    """
    plain = _plain(pattern)
    if not _TOKENS.search(re.sub(r"\[[*?[{}]\]", "", pattern)):
        return Path(plain)
    paths = sorted(_matching(pattern))
    if len(paths) == 1:
        return Path(paths[0])
    seen = f"{len(paths)} files match: {paths[0]}, {paths[1]} ..." if paths else "no file matches"
    raise InputError(f"{plain} must match one file, but {seen}; correct the pattern")


def require_parts(names: Mapping[str, object] | tuple[str, ...], known: tuple[str, ...], where: str) -> None:
    """Raise `InputError` unless every name is one of the known parts."""
    for name in names:
        if name not in known:
            hint = f"the parts are {', '.join(known)}" if known else "the pattern names no part, such as {subject}"
            raise InputError(f"{where}: there is no part '{name}'{nearest_name(name, known) or f'; {hint}'}")


def natural_key(text: str) -> list[tuple[bool, int, str]]:
    """Return a key for sorting that puts ``ses-2`` before ``ses-10``."""
    pieces = re.findall(r"[0-9]+|[^0-9]+", text)
    return [(not piece.isdecimal(), int(piece) if piece.isdecimal() else 0, piece) for piece in pieces]


def _matching(pattern: str) -> list[str]:
    """Return the paths that may match a pattern, without hidden files."""
    return glob.glob(_TOKENS.sub(_to_glob, pattern), recursive=True)  # noqa: PTH207 - pathlib would find hidden files, too


def _plain(pattern: str) -> str:
    """Return a pattern without its brackets around special characters."""
    return re.sub(r"\[([*?[{}])\]", r"\1", pattern)


def _to_glob(token: re.Match[str]) -> str:
    if token["any"]:
        return "*"  # two in a row are one
    return token[0] if not token["part"] else "*"


def _translated(pattern: str, parts: Mapping[str, str]) -> str:
    """Return the regular expression of a pattern."""
    pieces, last, seen = [], 0, set()
    for token in _TOKENS.finditer(pattern):
        pieces += [re.escape(pattern[last : token.start()]), _piece(token, parts, seen)]
        last = token.end()
    return "".join([*pieces, re.escape(pattern[last:])])


def _piece(token: re.Match[str], parts: Mapping[str, str], seen: set[str]) -> str:
    """Return the regular expression of a token; ``seen`` are the parts to its left."""
    if name := token["part"]:
        if name in seen:
            return f"(?P={name})"
        seen.add(name)
        return f"(?P<{name}>{parts.get(name, _ANYTHING)})"
    if one := token["one"]:
        escaped = re.sub(r"([\\\[^&~|])", r"\\\1", one.removeprefix("!"))
        return f"[{'^' * one.startswith('!')}{escaped}]"
    return {"folders": r"(?:[^/]+/)*", "any": "[^/]*", "single": "[^/]"}[token.lastgroup or ""]


def compiled(expression: str, written: str) -> re.Pattern[str]:
    """Return a regular expression; ``written`` is what stands in the cohort file.

    Raises:
        InputError: it is none, or longer or deeper than anybody writes one.
    """
    if len(expression) > _LONGEST:
        raise InputError(f"{shown(written)} has {len(expression)} characters; write a shorter expression")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about what later versions of Python may read otherwise
            return re.compile(expression)
    except (re.error, OverflowError, RecursionError) as error:
        raise InputError(f"{shown(written)} is no regular expression with these parts: {error}; check parts") from error
