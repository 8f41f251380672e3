"""The pairs of real images that benchmarks measure on: files, labels, points, masks, and whose they are."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path


@dataclass(frozen=True)
class Pair:
    """Two image files and what is known of them.

    Attributes:
        name: unlike that of any other pair of a set.
        fixed: an image, or labels that are painted as one.
        moving: the same.
        subjects: whose images these are; the same person has the same name in every set.
        counted: the labels whose overlap is averaged; all that both files have, except 0, when empty.
        contrasts: in which `paint` shows fixed and moving; empty for images.
    """

    name: str
    fixed: Path
    moving: Path
    fixed_labels: Path | None = None
    moving_labels: Path | None = None
    fixed_points: Path | None = None
    moving_points: Path | None = None
    fixed_mask: Path | None = None
    moving_mask: Path | None = None
    subjects: tuple[str, ...] = ()
    counted: tuple[int, ...] = ()
    contrasts: tuple[str, ...] = ()


Make = Callable[[Path], list[Pair]]


def _labelled(folder: Path, first: str, second: str, ending: str = ".nii.gz", labels: str = "_labels") -> Pair:
    files = [folder / f"{name}{end}{ending}" for end in ("", labels) for name in (first, second)]
    return Pair(f"{first} <- {second}", *files, subjects=(f"{folder.name}/{first}", f"{folder.name}/{second}"))


def _in_turn(folder: Path, names: list[str]) -> list[Pair]:
    """Each subject and the one after it."""
    return [_labelled(folder, a, b) for a, b in pairwise(names)]


def _numbered(which: str, name: str, numbers: range) -> Make:
    return lambda data: _in_turn(data / which, [f"{name}{i}" for i in numbers])


def _hippocampi(data: Path) -> list[Pair]:
    folder = data / "hippocampus_3d"
    return _in_turn(folder, sorted(p.name.removesuffix(".nii.gz") for p in folder.glob("hippocampus_???.nii.gz")))


def _hearts(data: Path) -> list[Pair]:
    """Two phases of one heart; a patient has several slices."""
    names = [p.name.removesuffix("_ED.png") for p in sorted((data / "heart_2d").glob("*_ED.png"))]
    pairs = [_labelled(data / "heart_2d", f"{name}_ED", f"{name}_ES", ".png", "_label") for name in names]
    patients = [f"heart_2d/{name.rpartition('_')[0]}" for name in names]
    return [replace(pair, subjects=(patient,)) for pair, patient in zip(pairs, patients, strict=True)]


def _spine(data: Path) -> list[Pair]:
    names = ("t1w", "t2")
    files = [data / "spine_t1t2_3d" / f"{name}{end}.nii.gz" for end in ("", "_seg-manual") for name in names]
    return [Pair("t1w <- t2", *files, subjects=("spine_t1t2_3d",))]


def _lung(*, masks: bool) -> Make:
    def make(data: Path) -> list[Pair]:
        folder = data / "lung_ct_3d"
        pair = Pair("lung", folder / "fixed.mha", folder / "moving.mha", subjects=(folder.name,))
        points = [folder / f"{side}_points.txt" for side in ("fixed", "moving")]
        pair = replace(pair, fixed_points=points[0], moving_points=points[1])
        seen = [folder / f"{side}_mask.mha" for side in ("fixed", "moving")]
        return [replace(pair, fixed_mask=seen[0], moving_mask=seen[1]) if masks else pair]

    return make


def _histology(data: Path) -> list[Pair]:
    fixed = data / "histology_2d" / "1-he.png"
    return [
        Pair(
            f"1-he <- {moving.stem}",
            fixed,
            moving,
            fixed_points=fixed.with_suffix(".csv"),
            moving_points=moving.with_suffix(".csv"),
            subjects=("histology_2d",),
        )
        for moving in sorted(fixed.parent.glob("*.png"))
        if moving != fixed
    ]


def _brains(data: Path) -> list[Pair]:
    """Label 33 is the cortex that belongs to none of the 32 regions."""
    pairs = _numbered("brain_t1_3d", "na", range(13, 17))(data)
    return [replace(pair, counted=tuple(range(1, 33))) for pair in pairs]


def _painted(*contrasts: str) -> Make:
    """Label maps of people, painted."""

    def make(data: Path) -> list[Pair]:
        found = _numbered("brain_maps_3d", "person_0", range(1, 5))(data)
        files = [(pair, {"fixed_labels": pair.fixed, "moving_labels": pair.moving}) for pair in found]
        return [replace(pair, **labels, contrasts=contrasts) for pair, labels in files]

    return make


WHOLE_BRAINS: dict[str, Make] = {
    "brain_t1_3d": _brains,
    "brain_maps_3d": _painted("t1", "t1"),
    "brain_maps_t1_t2_3d": _painted("t1", "t2"),
}
SETS: dict[str, Make] = {
    "mindboggle_2d": _numbered("mindboggle_2d", "subject", range(1, 9)),
    "heart_2d": _hearts,
    "histology_2d": _histology,
    "hippocampus_3d": _hippocampi,
    "spine_t1t2_3d": _spine,
    "mouse_brain_3d": _numbered("mouse_brain_3d", "mouse", range(1, 5)),
    "lung_ct_3d": _lung(masks=True),
    "lung_ct_3d_bare": _lung(masks=False),
    **WHOLE_BRAINS,
}
