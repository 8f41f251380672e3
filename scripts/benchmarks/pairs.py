"""The pairs of real images that benchmarks measure on: files, labels, points, masks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Pair:
    """Two image files and what is known of them."""

    name: str
    fixed: Path
    moving: Path
    fixed_labels: Path | None = None
    moving_labels: Path | None = None
    fixed_points: Path | None = None
    moving_points: Path | None = None
    fixed_mask: Path | None = None
    moving_mask: Path | None = None


def _labelled(folder: Path, first: str, second: str, ending: str = ".nii.gz", labels: str = "_labels") -> Pair:
    images = [folder / f"{name}{ending}" for name in (first, second)]
    return Pair(f"{first} <- {second}", *images, *(folder / f"{name}{labels}{ending}" for name in (first, second)))


def _numbered(name: str, count: int) -> Callable[[Path], list[Pair]]:
    """Subject i and subject i + 1."""
    return lambda folder: [_labelled(folder, f"{name}{i}", f"{name}{i + 1}") for i in range(1, count)]


def _hippocampi(folder: Path) -> list[Pair]:
    first, *others = sorted(p.name.removesuffix(".nii.gz") for p in folder.glob("hippocampus_???.nii.gz"))
    return [_labelled(folder, a, b) for a, b in zip([first, *others], others, strict=False)]


def _hearts(folder: Path) -> list[Pair]:
    names = [p.name.removesuffix("_ED.png") for p in sorted(folder.glob("*_ED.png"))]
    return [_labelled(folder, f"{name}_ED", f"{name}_ES", ".png", "_label") for name in names]


def _spine(folder: Path) -> list[Pair]:
    names = ("t1w", "t2")
    files = [folder / f"{name}{end}.nii.gz" for end in ("", "_seg-manual") for name in names]
    return [Pair("t1w <- t2", *files)]


def _lung(folder: Path) -> list[Pair]:
    pair = {name: folder / f"{name}.mha" for name in ("fixed", "moving", "fixed_mask", "moving_mask")}
    points = {name: folder / f"{name}.txt" for name in ("fixed_points", "moving_points")}
    return [Pair("lung", **pair, **points)]


def _histology(folder: Path) -> list[Pair]:
    fixed = folder / "1-he.png"
    return [
        Pair(
            f"1-he <- {moving.stem}",
            fixed,
            moving,
            fixed_points=fixed.with_suffix(".csv"),
            moving_points=moving.with_suffix(".csv"),
        )
        for moving in sorted(folder.glob("*.png"))
        if moving != fixed
    ]


SETS: dict[str, Callable[[Path], list[Pair]]] = {
    "mindboggle_2d": _numbered("subject", 8),
    "heart_2d": _hearts,
    "histology_2d": _histology,
    "hippocampus_3d": _hippocampi,
    "spine_t1t2_3d": _spine,
    "mouse_brain_3d": _numbered("mouse", 4),
    "lung_ct_3d": _lung,
}
