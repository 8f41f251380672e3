"""The pairs of a cohort: from a list, a table, a Learn2Reg data set, or among the images that patterns find."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import fields
from itertools import combinations, pairwise, permutations
from pathlib import Path

from torchdeform.cohort.learn2reg import learn2reg_pairs
from torchdeform.cohort.names import PairSpec, entity, image_name, pair_name, shared_parts, subject_of
from torchdeform.cohort.patterns import FoundFile, fill_parts, find, natural_key, search, single_file
from torchdeform.cohort.schema import COMPANIONS, TISSUE, Cohort, Images, Pair, PatternPairs, checked_name
from torchdeform.cohort.settings import absolute_path, expand
from torchdeform.errors import InputError, nearest_name, require_choice, shown
from torchdeform.io.files import suffix
from torchdeform.io.gate import read_text
from torchdeform.io.texts import csv_rows
from torchdeform.pipeline.config import parse_override
from torchdeform.pipeline.register import PairFiles

_FILES = tuple(field.name for field in fields(PairFiles) if field.name != "out")
_COLUMNS = ("name", *_FILES)  # of a table
_SETTING = "settings."
_SEPARATORS = {".csv": ",", ".tsv": "\t"}
_EMPTY = ("", "n/a")  # BIDS writes n/a where there is nothing


def find_images(images: Images) -> list[FoundFile]:
    """Return the images that patterns or an expression find, sorted by their paths.

    Raises:
        InputError: there is none.

    Notes:
        A file with the labels, mask, landmarks or tissue of another one is no image, even if the pattern matches it.
    """
    if images.folder is not None and images.expression is not None:
        found = search(images.folder, images.expression)
    else:
        found = [one for pattern in images.files for one in find(pattern, images.parts)]
    unique = {one.path: one for one in found}
    others = {path for one in unique.values() for path in _existing_companions(one, images)}
    left = [one for path, one in unique.items() if path not in others]
    if not left:
        shown = images.expression or ", ".join(images.files)
        raise InputError(f"no file matches {shown}; check the pattern and the folder")
    return left


def pattern_pairs(pattern: PatternPairs, where: str) -> list[PairSpec]:
    """Return the pairs of a pattern. A pair without a unique mask, labels or landmarks gets a problem."""
    images = find_images(pattern)
    if pattern.pairing == "template":
        return [_to_template(one, pattern, where) for one in images if one.path != _template(one, pattern)]
    groups: dict[tuple[str, ...], list[FoundFile]] = defaultdict(list)
    for one in images:
        groups[tuple(one.parts[name] for name in pattern.within)].append(one)
    if pattern.order is not None:
        for group in groups.values():
            group.sort(key=lambda one: natural_key(one.parts[str(pattern.order)]))
    return [pair for group in groups.values() for pair in _within(group, pattern, where)]


def companions(one: FoundFile, images: Images, side: str) -> dict[str, Path]:
    """Return the labels, mask and landmarks of an image, by their names in a pair.

    Raises:
        InputError: several files match a pattern, or none.
    """
    patterns = images.companions().items()
    return {f"{side}_{COMPANIONS[key]}": single_file(fill_parts(pattern, one.parts)) for key, pattern in patterns}


def _existing_companions(one: FoundFile, images: Images) -> Iterator[Path]:
    for pattern in (*images.companions().values(), *_tissue_of(images).values()):
        with suppress(InputError):
            yield single_file(fill_parts(pattern, one.parts))


def _tissue_of(images: Images) -> dict[str, str]:
    """Return the pattern of the tissue of fixed images, by its key, if there is one."""
    pattern = getattr(images, TISSUE, None)
    return {} if pattern is None else {TISSUE: pattern}


def _template(moving: FoundFile, pattern: PatternPairs) -> Path | None:
    try:
        return single_file(fill_parts(pattern.fixed or "", moving.parts))
    except InputError:
        return None


def _to_template(moving: FoundFile, pattern: PatternPairs, where: str) -> PairSpec:
    def files() -> dict[str, Path]:
        fixed = {key: single_file(fill_parts(text, moving.parts)) for key, text in pattern.fixed_files().items()}
        return {**fixed, "moving": moving.path, **companions(moving, pattern, "moving")}

    return _pair_spec(image_name(moving.path, moving.parts), files, where, subject_of(moving.parts))


def _within(group: list[FoundFile], pattern: PatternPairs, where: str) -> list[PairSpec]:
    """Return the pairs of a group, by the kind of pairing."""
    if pattern.pairing == "consecutive":
        ends = pairwise(group)
    elif pattern.pairing == "all":
        ends = (permutations if pattern.both_ways else combinations)(group, 2)
    else:
        chosen = [one for one in group if pattern.reference.items() <= one.parts.items()]
        if len(chosen) != 1:
            return [_without_reference(group, len(chosen), pattern, where)]
        ends = ((chosen[0], moving) for moving in group if moving is not chosen[0])
    return [_between(fixed, moving, pattern, where) for fixed, moving in ends]


def _without_reference(group: list[FoundFile], count: int, pattern: PatternPairs, where: str) -> PairSpec:
    reference = ", ".join(f"{key} {value}" for key, value in pattern.reference.items())
    parts = {key: group[0].parts[key] for key in pattern.within}
    name = "_".join(entity(*part) for part in parts.items()) or "group"
    problem = f"{count} of its {len(group)} images have {reference}, not one; check reference and the files"
    return PairSpec(name=name, files={}, where=where, subject=subject_of(parts), problem=problem)


def _between(fixed: FoundFile, moving: FoundFile, pattern: PatternPairs, where: str) -> PairSpec:
    """Return the pair of two found images."""

    def files() -> dict[str, Path]:
        sides = (("fixed", fixed), ("moving", moving))
        found = {key: path for side, one in sides for key, path in companions(one, pattern, side).items()}
        tissue = {key: single_file(fill_parts(text, fixed.parts)) for key, text in _tissue_of(pattern).items()}
        return {"fixed": fixed.path, "moving": moving.path, **found, **tissue}

    name = pair_name(fixed.path, moving.path, fixed.parts, moving.parts)
    return _pair_spec(name, files, where, subject_of(shared_parts(fixed.parts, moving.parts)))


def _pair_spec(name: str, files: Callable[[], dict[str, Path]], where: str, subject: str) -> PairSpec:
    try:
        return PairSpec(name=name, files=files(), where=where, subject=subject)
    except InputError as error:
        return PairSpec(name=name, files={}, where=where, subject=subject, problem=str(error))


def pair_specs(cohort: Cohort) -> list[PairSpec]:
    """Return the pairs of a cohort; only the names of files are read.

    Raises:
        InputError: the cohort has no pairs, or the part that lists them is wrong.
    """
    pairs = cohort.pairs
    if pairs is None:
        raise InputError(f"{cohort.path} names no pairs; add pairs with one of list, table, pattern and learn2reg")
    if pairs.table is not None:
        found = table_pairs(pairs.table.file)
    elif pairs.pattern is not None:
        found = pattern_pairs(pairs.pattern, f"{cohort.path}: pairs.pattern")
    elif pairs.learn2reg is not None:
        found = learn2reg_pairs(pairs.learn2reg)
    else:
        found = [_listed(pair, f"{cohort.path}: pairs.list[{n}]") for n, pair in enumerate(pairs.list or ())]
    if not found:
        raise InputError(f"{cohort.path} gives no pair at all; check pairs")
    return found


def named_images(cohort: Cohort) -> dict[str, dict[str, Path]]:
    """Return the images of a template by name: ``image``, and ``labels``, ``mask`` and ``points`` if given.

    Raises:
        InputError: the cohort has no images, none is found, two get the same name, or a companion is missing.
    """
    if cohort.images is None:
        raise InputError(f"{cohort.path} names no images; add images with files, the pattern of their paths")
    named: dict[str, dict[str, Path]] = {}
    for one in find_images(cohort.images):
        name = image_name(one.path, one.parts)
        if name in named:
            paths = f"{named[name]['image']} and {one.path}"
            raise InputError(f"{paths} would both be called {name}; name the part that differs, such as {{subject}}")
        others = {key.lstrip("_"): path for key, path in companions(one, cohort.images, "").items()}
        named[name] = {"image": one.path, **others}
    return named


def _listed(pair: Pair, where: str) -> PairSpec:
    files = {key: path for key in _FILES if (path := getattr(pair, key)) is not None}
    name = pair.name or pair_name(pair.fixed, pair.moving, {}, {})
    return PairSpec(name=name, files=files, where=where, settings=pair.settings)


def table_pairs(path: Path) -> list[PairSpec]:
    """Return the pairs of a table. Its paths are relative to its folder.

    Raises:
        InputError: the file is missing or no table, lacks a column, has an unknown one or a wrong row; with the line.
    """
    require_choice(suffix(path), _SEPARATORS, f"{path}: the ending of a table")
    rows = csv_rows(read_text(path, "table", legacy=True), str(path), _SEPARATORS[suffix(path)])
    titles = [title.strip() for title in next(rows, (1, []))[1]]
    _require_columns(titles, path)
    places = ((f"{path} line {line}", row) for line, row in rows)
    return [
        _row_pair(dict(zip(titles, _cells(row, titles, where), strict=True)), path.parent, where)
        for where, row in places
    ]


def _require_columns(titles: list[str], path: Path) -> None:
    for title in titles:
        if title not in _COLUMNS and not title.startswith(_SETTING):
            hint = nearest_name(title, _COLUMNS) or f"; there are {', '.join(_COLUMNS)} and {_SETTING}KEY"
            raise InputError(f"{path} line 1: there is no column {shown(title)}{hint}")
        if titles.count(title) > 1:
            raise InputError(f"{path} line 1: the column {shown(title)} occurs twice; remove one")
    for title in ("fixed", "moving"):
        if title not in titles:
            raise InputError(f"{path} line 1: the column '{title}' is missing; add it")


def _cells(row: list[str], titles: list[str], where: str) -> list[str]:
    if len(row) != len(titles):
        raise InputError(f"{where}: it has {len(row)} cells but the first line {len(titles)}; complete it")
    return [cell.strip() for cell in row]


def _row_pair(row: Mapping[str, str], folder: Path, where: str) -> PairSpec:
    given = {title: cell for title, cell in row.items() if cell not in _EMPTY}
    for title in ("fixed", "moving"):
        if title not in given:
            raise InputError(f"{where}: {title} is empty; give a file")
    try:
        files = {key: absolute_path(folder.resolve(), expand(given[key])) for key in _FILES if key in given}
        name = checked_name(given["name"]) if "name" in given else pair_name(files["fixed"], files["moving"], {}, {})
        settings = (
            parse_override(f"{k.removeprefix(_SETTING)}={v}") for k, v in given.items() if k.startswith(_SETTING)
        )
        return PairSpec(name=name, files=files, where=where, settings=dict(settings))
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
