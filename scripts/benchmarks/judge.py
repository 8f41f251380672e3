"""What a map did to a pair: overlap of labels, distance of landmarks, folds; the same code for the maps of every tool.

A map is given as positions φ(x) of the fixed voxels, ``(*S, D)`` in array order, each (x, y, z) in the moving image's
world.
"""

from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from pairs import Pair

Positions = NDArray[np.float64]


def judge(pair: Pair, positions: Positions) -> dict[str, float]:
    """Return overlap, landmark error and folds of a map, as far as the pair's files say what is right."""
    fixed = sitk.ReadImage(str(pair.fixed))
    figures = folds(fixed, positions)
    if pair.fixed_labels and pair.moving_labels:
        figures |= overlap(pair.fixed_labels, pair.moving_labels, positions)
    if pair.fixed_points and pair.moving_points:
        figures |= landmarks((pair.fixed_points, pair.moving_points), fixed, positions)
    return figures


def overlap(fixed_path: Path, moving_path: Path, positions: Positions) -> dict[str, float]:
    """Return the mean Dice over the labels that both files have, those of moving warped to the nearest voxel."""
    first = _first_channel(sitk.ReadImage(str(fixed_path)))
    moving = sitk.ReadImage(str(moving_path))
    warped = nearest(moving, positions)
    common = (set(np.unique(first)) & set(np.unique(_first_channel(moving)))) - {0}
    both = [(first == label, warped == label) for label in common]
    return {"dice": mean(2 * float((a & b).sum()) / float(a.sum() + b.sum()) for a, b in both)}


def nearest(image: sitk.Image, positions: Positions) -> NDArray[Any]:
    """Return the values of the voxels that the positions fall into, 0 outside of the image."""
    values, dim = _first_channel(image), image.GetDimension()
    direction = np.array(image.GetDirection()).reshape(dim, dim)
    index = (positions - image.GetOrigin()) @ np.linalg.inv(direction).T / image.GetSpacing()
    index = np.rint(index)[..., ::-1]
    inside = ((index >= 0) & (index < values.shape)).all(-1)
    safe = np.where(inside[..., None], index, 0).astype(int)
    return np.where(inside, values[tuple(np.moveaxis(safe, -1, 0))], 0)


def _first_channel(image: sitk.Image) -> NDArray[Any]:
    array = sitk.GetArrayFromImage(image)
    return array[..., 0] if image.GetNumberOfComponentsPerPixel() > 1 else array


def read_points(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return points by name: elastix' text (world), or `number,X,Y` in pixels of size 1."""
    lines = path.read_text(encoding="utf-8").split("\n")
    if path.suffix == ".csv":
        rows = [line.split(",") for line in lines[1:] if line.strip()]
        return {row[0]: np.array(row[1:], dtype=float) for row in rows}
    return {str(k): np.array(line.split(), dtype=float) for k, line in enumerate(lines[2:]) if line.strip()}


def landmarks(files: tuple[Path, Path], fixed: sitk.Image, positions: Positions) -> dict[str, float]:
    """Return mean and median distance of the moved fixed points from their partners."""
    first, second = map(read_points, files)
    frame = sitk.GetImageFromArray(positions, isVector=True)
    frame.CopyInformation(fixed)
    errors = []
    for name in (name for name in first if name in second):
        index = np.clip(fixed.TransformPhysicalPointToContinuousIndex(first[name]), 0, np.array(fixed.GetSize()) - 1)
        place = fixed.TransformContinuousIndexToPhysicalPoint(index.tolist())
        errors.append(float(np.linalg.norm(frame.EvaluateAtPhysicalPoint(place) - second[name])))
    return {"landmark_mean": mean(errors), "landmark_median": median(errors)}


def folds(fixed: sitk.Image, positions: Positions) -> dict[str, float]:
    """Return folds by the certificate and by central differences, and the standard deviation of log J."""
    import torch

    import torchdeform as td

    dim = fixed.GetDimension()
    direction = np.array(fixed.GetDirection()).reshape(dim, dim)
    own = ((positions - fixed.GetOrigin()) @ np.linalg.inv(direction).T)[..., ::-1]
    grid = td.Grid(fixed.GetSize()[::-1], fixed.GetSpacing()[::-1])
    phi = torch.from_numpy(np.moveaxis(own, -1, 0).copy())[None]
    found = td.diagnose(phi - grid.points(dtype=phi.dtype), grid)
    return {
        "folds": float(found.folds),
        "central_folds": float(found.central_folds),
        "log_det_std": float(found.det_log_std),
    }
