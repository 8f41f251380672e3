"""A pair as the cohort names it: its files, and the name that it gets."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torchdeform.io.files import stem

# The short names that BIDS has for what files tell apart; a part of a pattern may be called by the long one.
_ENTITIES = {
    "subject": "sub",
    "session": "ses",
    "acquisition": "acq",
    "direction": "dir",
    "reconstruction": "rec",
    "modality": "mod",
    "hemisphere": "hemi",
}
_SUBJECT = "sub"
_LONGEST = 200  # characters of a name, so that its folder can be made on any system


@dataclass(frozen=True, kw_only=True)
class PairSpec:
    """A pair as the cohort says it, before anything is looked at.

    Args:
        name: of the pair.
        files: by the names that `PairFiles` has for them, every path absolute.
        where: file and line, or keys, that it comes from.
        settings: that differ from the cohort's.
        subject: folder in which the pair's own is, empty for none.
        voxels: landmarks are indices of voxels, without titles.
        problem: why it cannot run, empty if nothing is known.
    """

    name: str
    files: Mapping[str, Path]
    where: str
    settings: Mapping[str, object] = field(default_factory=dict)
    subject: str = ""
    voxels: bool = False
    problem: str = ""


def clean(text: str) -> str:
    """Return a text as a part of a name: what is no letter, digit or dot becomes ``-``."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-.") or "x"


def entity(name: str, value: str, sign: str = "-") -> str:
    """Return ``sub-01`` for the part ``subject`` with the value ``01``."""
    return f"{clean(_ENTITIES.get(name, name))}{sign}{clean(value)}"


def subject_of(parts: Mapping[str, str]) -> str:
    """Return ``sub-01`` where a part tells the subject, else nothing."""
    return next((entity(k, v) for k, v in parts.items() if _ENTITIES.get(k, k) == _SUBJECT), "")


def image_name(path: Path, parts: Mapping[str, str]) -> str:
    """Return the name of an image: its parts, as ``sub-01_ses-2``, or its file's name where there are none."""
    return _short("_".join(entity(*part) for part in parts.items()) or clean(stem(path)))


def pair_name(fixed: Path, moving: Path, fixed_parts: Mapping[str, str], moving_parts: Mapping[str, str]) -> str:
    """Return what both images share, and what tells them apart: ``sub-01_from-ses2_to-ses1``."""
    differ = [key for key in moving_parts if moving_parts[key] != fixed_parts.get(key)]
    shared = [entity(key, value) for key, value in moving_parts.items() if key not in differ]
    if not differ:
        return _short("_".join([*shared, f"from-{clean(stem(moving))}_to-{clean(stem(fixed))}"]))
    ends = ("".join(entity(key, parts[key], "") for key in differ) for parts in (moving_parts, fixed_parts))
    return _short("_".join([*shared, *map("-".join, zip(("from", "to"), ends, strict=True))]))


def shared_parts(one: Mapping[str, str], other: Mapping[str, str]) -> dict[str, str]:
    """Return the parts that two images have in common."""
    return {key: value for key, value in one.items() if other.get(key) == value}


def select(names: Sequence[str], wanted: str) -> list[str]:
    """Return the names that are ``wanted``, begin with it and ``_``, or match it as a pattern (``sub-0*``)."""
    from fnmatch import fnmatchcase

    return [name for name in names if name == wanted or name.startswith(f"{wanted}_") or fnmatchcase(name, wanted)]


def _short(name: str) -> str:
    return name[:_LONGEST]
