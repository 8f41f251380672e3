"""Overlap, folds and time of `register` and of SimpleITK's diffeomorphic demons, on real images in the same run.

Usage: python scripts/benchmarks/registration.py [DATA] [--sets heart_2d mindboggle_2d mouse_brain_3d brain_morph_2d]

DATA is the folder of images, TORCHDEFORM_DATA or ../shared/data by default. Nothing is aligned beforehand. Demons get
matched histograms and three levels of 100, 100 and 40 iterations, smoothed by 1.5 voxels.
"""

import argparse
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from time import perf_counter

import numpy as np
import SimpleITK as sitk
import torch
from numpy.typing import ArrayLike
from skimage.color import rgb2gray
from skimage.filters import threshold_otsu
from skimage.io import imread
from skimage.transform import resize
from torch import Tensor

import torchdeform as td


@dataclass(frozen=True)
class Case:
    """Two images and labels of both, as ``(1, 1, *S)``."""

    fixed: Tensor
    moving: Tensor
    fixed_labels: Tensor
    moving_labels: Tensor


def tensor(array: ArrayLike) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))[None, None]


def read(path: Path) -> Tensor:
    array = sitk.GetArrayFromImage(sitk.ReadImage(str(path)))
    colour = path.suffix == ".png" and array.ndim == 3
    return tensor(array[..., 0] if colour else array)


def numbered(folder: Path, name: str, count: int) -> Iterator[Case]:
    """Subjects i and i + 1."""
    for i in range(1, count):
        pair = [folder / f"{name}{j}" for j in (i, i + 1)]
        images = [read(Path(f"{p}{end}.nii.gz")) for end in ("", "_labels") for p in pair]
        yield Case(*images)


def hearts(folder: Path) -> Iterator[Case]:
    for path in sorted(folder.glob("*_ED.png")):
        files = [path, path.with_name(path.name.replace("_ED", "_ES"))]
        labels = [(read(f.with_name(f.stem + "_label.png")) > 127).float() for f in files]
        yield Case(read(files[0]), read(files[1]), *labels)


def brain_outline(folder: Path) -> Iterator[Case]:
    grey = [rgb2gray(imread(folder / f"I_{n}.png")[..., :3]) for n in ("large", "little")]
    pair = [np.asarray(resize(g, (129, 129), anti_aliasing=True)) for g in grey]
    yield Case(*map(tensor, pair), *(tensor(p > threshold_otsu(pair[0])) for p in pair))


SETS: dict[str, tuple[str, Callable[[Path], Iterator[Case]]]] = {
    "mindboggle_2d": ("default", lambda d: numbered(d, "subject", 8)),
    "heart_2d": ("default", hearts),
    "brain_morph_2d": ("shape", brain_outline),
    "mouse_brain_3d": ("default", lambda d: numbered(d, "mouse", 2)),
}


def dice(fixed: Tensor, moving: Tensor, warped: Tensor) -> float:
    """Mean Dice over the labels that both images have."""
    common = set(fixed.unique().tolist()) & set(moving.unique().tolist()) - {0.0}
    both = [(fixed == label, warped == label) for label in common]
    return mean(2 * float((a & b).sum()) / float(a.sum() + b.sum()) for a, b in both)


def demons(case: Case) -> Tensor:
    """Displacement ``(1, D, *S)`` in voxels by SimpleITK's diffeomorphic demons, coarse to fine."""
    fixed, moving = (sitk.GetImageFromArray(t[0, 0].numpy()) for t in (case.fixed, case.moving))
    moving = sitk.HistogramMatching(moving, fixed, 256, 7, True)
    field = None
    for factor, steps in ((4, 100), (2, 100), (1, 40)):
        size = [max(8, n // factor) for n in fixed.GetSize()]
        spacing = [(n - 1) / (m - 1) for n, m in zip(fixed.GetSize(), size, strict=True)]
        frame = sitk.Image(size, sitk.sitkFloat32)
        frame.SetSpacing(spacing)
        coarse = [
            sitk.Resample(sitk.SmoothingRecursiveGaussian(i, [0.5 * factor] * i.GetDimension()), frame)
            for i in (fixed, moving)
        ]
        method = sitk.DiffeomorphicDemonsRegistrationFilter()
        method.SetNumberOfIterations(steps)
        method.SetStandardDeviations([1.5 * s for s in spacing])
        field = method.Execute(*coarse) if field is None else method.Execute(*coarse, sitk.Resample(field, frame))
    array = np.moveaxis(sitk.GetArrayFromImage(field), -1, 0)[::-1].copy()
    return torch.from_numpy(array).float()[None]


def judge(case: Case, u: Tensor) -> dict[str, float]:
    """Overlap of the labels warped by u, what is left of the squared difference, folds, smallest determinant."""
    grid = td.Grid(tuple(case.fixed.shape[2:]))
    moved = td.warp(case.moving_labels, u, grid, mode="nearest")
    left = (td.warp(case.moving, u, grid) - case.fixed).square().sum()
    found = td.diagnose(u, grid)
    return {
        "dice": dice(case.fixed_labels, case.moving_labels, moved),
        "before": dice(case.fixed_labels, case.moving_labels, case.moving_labels),
        "ratio": float(left / (case.moving - case.fixed).square().sum()),
        "folds": float(found.folds),
        "determinant": float(found.det_min),
    }


def run(name: str, folder: Path) -> None:
    preset, cases = SETS[name]
    ours, theirs = [], []
    for case in cases(folder / name):
        start = perf_counter()
        result = td.register(case.fixed, case.moving, td.load_settings(preset))
        seconds = perf_counter() - start
        error = float(result.inverse_error_mean)
        ours.append(judge(case, result.displacement) | {"seconds": seconds, "inverse": error})
        start = perf_counter()
        u = demons(case)
        theirs.append(judge(case, u) | {"seconds": perf_counter() - start, "inverse": float("nan")})
    for tool, rows in ((f"torchdeform, {preset}", ours), ("SimpleITK demons", theirs)):
        means = {key: mean(row[key] for row in rows) for key in rows[0]}
        print(
            f"| {name} | {tool} | {means['before']:.3f} | {means['dice']:.4f} | {means['ratio']:.4f} "
            f"| {sum(r['folds'] for r in rows):.0f} | {min(r['determinant'] for r in rows):.3f} "
            f"| {means['inverse']:.1e} | {means['seconds']:.2f} "
            f"| {means['seconds'] / mean(r['seconds'] for r in theirs):.2f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", default=os.environ.get("TORCHDEFORM_DATA", "../shared/data"), type=Path)
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    arguments = parser.parse_args()
    columns = "set", "tool", "Dice before", "Dice", "squared difference left", "folds", "det min", "inverse error", "s"
    print("|", " | ".join((*columns, "time / demons")), "|")
    print("|", " | ".join("---" for _ in range(len(columns) + 1)), "|")
    for name in arguments.sets:
        run(name, arguments.data)


if __name__ == "__main__":
    main()
