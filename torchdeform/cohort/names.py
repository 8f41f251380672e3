"""Pairs as the cohort file gives them, and the names of pairs and images."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torchdeform.io.files import stem

# The short names of BIDS for the parts of file names; a pattern may use the long ones.
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
_LONGEST = 200  # characters of a name, because of the limits of file systems


@dataclass(frozen=True, kw_only=True)
class PairSpec:
    """A pair as the cohort file gives it, before its files are checked.

    Args:
        name: of the pair.
        files: absolute paths by their names in `PairFiles`.
        where: file and line, or keys, that the pair comes from.
        settings: those that differ from the cohort's.
        subject: name of the folder above the pair's folder, empty for none.
        voxels: whether landmarks are voxel indices without titles.
        problem: why the pair cannot run, empty if no reason is known.
    """

    name: str
    files: Mapping[str, Path]
    where: str
    settings: Mapping[str, object] = field(default_factory=dict)
    subject: str = ""
    voxels: bool = False
    problem: str = ""


def clean(text: str) -> str:
    """Return a text as a part of a name: all but letters, digits and dots becomes ``-``."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-.") or "x"


def entity(name: str, value: str, sign: str = "-") -> str:
    """Return ``sub-01`` for the part ``subject`` with the value ``01``."""
    return f"{clean(_ENTITIES.get(name, name))}{sign}{clean(value)}"


def subject_of(parts: Mapping[str, str]) -> str:
    """Return ``sub-01`` if a part is the subject, else an empty string."""
    return _short(next((entity(k, v) for k, v in parts.items() if _ENTITIES.get(k, k) == _SUBJECT), ""))


def image_name(path: Path, parts: Mapping[str, str]) -> str:
    """Return the name of an image: its parts, as ``sub-01_ses-2``, or its file name if it has no parts."""
    return _short("_".join(entity(*part) for part in parts.items()) or clean(stem(path)))


def pair_name(fixed: Path, moving: Path, fixed_parts: Mapping[str, str], moving_parts: Mapping[str, str]) -> str:
    """Return the parts that both images share and those that differ: ``sub-01_from-ses2_to-ses1``."""
    differing = [key for key in moving_parts if moving_parts[key] != fixed_parts.get(key)]
    shared = [entity(key, value) for key, value in moving_parts.items() if key not in differing]
    if not differing:
        return _short("_".join([*shared, f"from-{clean(stem(moving))}_to-{clean(stem(fixed))}"]))
    ends = ("".join(entity(key, parts[key], "") for key in differing) for parts in (moving_parts, fixed_parts))
    return _short("_".join([*shared, *map("-".join, zip(("from", "to"), ends, strict=True))]))


def shared_parts(one: Mapping[str, str], other: Mapping[str, str]) -> dict[str, str]:
    """Return the parts that are the same in two images."""
    return {key: value for key, value in one.items() if other.get(key) == value}


def select(names: Sequence[str], pattern: str) -> list[str]:
    """Return the names that equal ``pattern``, start with it and ``_``, or match it (``sub-0*``)."""
    from fnmatch import fnmatchcase

    return [name for name in names if name == pattern or name.startswith(f"{pattern}_") or fnmatchcase(name, pattern)]


def _short(name: str) -> str:
    return name[:_LONGEST]
