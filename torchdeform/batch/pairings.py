"""Pairs among the images that patterns find: to a template, one after another, every two, or to one of a group."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import combinations, pairwise, permutations
from pathlib import Path

from torchdeform.batch.cohort import COMPANIONS, Images, PatternPairs
from torchdeform.batch.entry import Entry, entity, image_name, pair_name, shared_parts, subject_of
from torchdeform.batch.patterns import Found, fill, find, natural, only, search
from torchdeform.errors import InputError


def find_images(images: Images) -> list[Found]:
    """Return the images that patterns or an expression find, sorted by their paths.

    Raises:
        InputError: there is none.

    Notes:
        A file that is the regions, the mask or the landmarks of another is no image of its own, though the pattern may
        match it.
    """
    if images.folder is not None and images.expression is not None:
        found = search(images.folder, images.expression)
    else:
        found = [one for pattern in images.files for one in find(pattern, images.parts)]
    unique = {one.path: one for one in found}
    beside = {path for one in unique.values() for path in _beside(one, images)}
    left = [one for path, one in unique.items() if path not in beside]
    if not left:
        looked = images.expression or ", ".join(images.files)
        raise InputError(f"no file matches {looked}; check the pattern and the folder")
    return left


def pattern_entries(pattern: PatternPairs, where: str) -> list[Entry]:
    """Return the pairs of a pattern; a pair whose regions, mask or landmarks cannot be told keeps the reason."""
    images = find_images(pattern)
    if pattern.pairing == "template":
        return [_to_template(one, pattern, where) for one in images if one.path != _template(one, pattern)]
    groups: dict[tuple[str, ...], list[Found]] = defaultdict(list)
    for one in images:
        groups[tuple(one.parts[name] for name in pattern.within)].append(one)
    if pattern.order is not None:
        for group in groups.values():
            group.sort(key=lambda one: natural(one.parts[str(pattern.order)]))
    return [entry for group in groups.values() for entry in _PAIRINGS[pattern.pairing](group, pattern, where)]


def companions(one: Found, images: Images, side: str) -> dict[str, Path]:
    """Return what goes along with an image, called as a pair calls it.

    Raises:
        InputError: several files match a pattern, or none.
    """
    patterns = images.companions().items()
    return {f"{side}_{COMPANIONS[key]}": only(fill(pattern, one.parts)) for key, pattern in patterns}


def _beside(one: Found, images: Images) -> list[Path]:
    try:
        return list(companions(one, images, "").values())
    except InputError:
        return []


def _template(moving: Found, pattern: PatternPairs) -> Path | None:
    try:
        return only(fill(pattern.fixed or "", moving.parts))
    except InputError:
        return None


def _to_template(moving: Found, pattern: PatternPairs, where: str) -> Entry:
    def files() -> dict[str, Path]:
        fixed = {key: only(fill(text, moving.parts)) for key, text in pattern.fixed_files().items()}
        return {**fixed, "moving": moving.path, **companions(moving, pattern, "moving")}

    return _entry(image_name(moving.path, moving.parts), files, where, subject_of(moving.parts))


def _consecutive(group: list[Found], pattern: PatternPairs, where: str) -> Iterator[Entry]:
    for fixed, moving in pairwise(group):
        yield _between(fixed, moving, pattern, where)


def _all(group: list[Found], pattern: PatternPairs, where: str) -> Iterator[Entry]:
    for fixed, moving in (permutations if pattern.both_ways else combinations)(group, 2):
        yield _between(fixed, moving, pattern, where)


def _to_member(group: list[Found], pattern: PatternPairs, where: str) -> Iterator[Entry]:
    chosen = [one for one in group if pattern.reference.items() <= one.parts.items()]
    if len(chosen) == 1:
        for moving in group:
            if moving is not chosen[0]:
                yield _between(chosen[0], moving, pattern, where)
        return
    wanted = ", ".join(f"{key} {value}" for key, value in pattern.reference.items())
    parts = {key: group[0].parts[key] for key in pattern.within}
    name = "_".join(entity(*part) for part in parts.items()) or "group"
    problem = f"{len(chosen)} of its {len(group)} images have {wanted}, and one must; check reference and the files"
    yield Entry(name=name, files={}, where=where, subject=subject_of(parts), problem=problem)


_PAIRINGS = {"consecutive": _consecutive, "all": _all, "group": _to_member}


def _between(fixed: Found, moving: Found, pattern: PatternPairs, where: str) -> Entry:
    """Return the pair of two images that were found."""

    def files() -> dict[str, Path]:
        sides = (("fixed", fixed), ("moving", moving))
        beside = [companions(one, pattern, side).items() for side, one in sides]
        return {"fixed": fixed.path, "moving": moving.path, **dict(beside[0]), **dict(beside[1])}

    name = pair_name(fixed.path, moving.path, fixed.parts, moving.parts)
    return _entry(name, files, where, subject_of(shared_parts(fixed.parts, moving.parts)))


def _entry(name: str, files: Callable[[], dict[str, Path]], where: str, subject: str) -> Entry:
    try:
        return Entry(name=name, files=files(), where=where, subject=subject)
    except InputError as error:
        return Entry(name=name, files={}, where=where, subject=subject, problem=str(error))
