"""Where a cohort's pairs come from: a list, a table, patterns of paths, or a Learn2Reg data set."""

from dataclasses import fields
from pathlib import Path

from torchdeform.batch.cohort import Cohort, Pair
from torchdeform.batch.entry import Entry, image_name, pair_name
from torchdeform.batch.learn2reg import learn2reg_entries
from torchdeform.batch.pairings import companions, find_images, pattern_entries
from torchdeform.batch.tables import table_entries
from torchdeform.errors import InputError
from torchdeform.pair import PairFiles

_FILES = tuple(field.name for field in fields(PairFiles) if field.name != "out")


def entries(cohort: Cohort) -> list[Entry]:
    """Return the pairs of a cohort as it names them; nothing is looked at but names.

    Raises:
        InputError: the cohort has no pairs, or what says them is wrong.
    """
    pairs = cohort.pairs
    if pairs is None:
        raise InputError(f"{cohort.path} names no pairs; add pairs with one of list, table, pattern and learn2reg")
    if pairs.table is not None:
        found = table_entries(pairs.table.file)
    elif pairs.pattern is not None:
        found = pattern_entries(pairs.pattern, f"{cohort.path}: pairs.pattern")
    elif pairs.learn2reg is not None:
        found = learn2reg_entries(pairs.learn2reg)
    else:
        found = [_listed(pair, f"{cohort.path}: pairs.list[{n}]") for n, pair in enumerate(pairs.list or ())]
    if not found:
        raise InputError(f"{cohort.path} comes to no pair at all; check pairs")
    return found


def named_images(cohort: Cohort) -> dict[str, dict[str, Path]]:
    """Return the images of a template by their names: ``image``, and ``labels``, ``mask`` and ``points`` where given.

    Raises:
        InputError: the cohort has no images, none is found, two would have one name, or what goes along is missing.
    """
    if cohort.images is None:
        raise InputError(f"{cohort.path} names no images; add images with files, the pattern of their paths")
    named: dict[str, dict[str, Path]] = {}
    for one in find_images(cohort.images):
        name = image_name(one.path, one.parts)
        if name in named:
            paths = f"{named[name]['image']} and {one.path}"
            raise InputError(f"{paths} would both be called {name}; name the part that differs, as {{subject}}")
        beside = {key.lstrip("_"): path for key, path in companions(one, cohort.images, "").items()}
        named[name] = {"image": one.path, **beside}
    return named


def _listed(pair: Pair, where: str) -> Entry:
    files = {key: path for key in _FILES if (path := getattr(pair, key)) is not None}
    name = pair.name or pair_name(pair.fixed, pair.moving, {}, {})
    return Entry(name=name, files=files, where=where, settings=pair.settings)
