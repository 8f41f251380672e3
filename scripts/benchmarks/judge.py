"""What a map did to a pair: overlap of labels, distance of landmarks, folds; the same code for the maps of every tool.

A map is given as positions φ(x) of the fixed voxels, ``(*S, D)`` in array order, each (x, y, z) in the moving image's
world.
"""

from pathlib import Path
from statistics import mean, median

import numpy as np
import torch
from numpy.typing import NDArray
from pairs import Pair

import torchdeform as td
from torchdeform.core.warp import sample
from torchdeform.io.images import read_labels
from torchdeform.io.points import matched
from torchdeform.metrics.evaluation import common_labels

Positions = NDArray[np.float64]


def judge(pair: Pair, fixed: td.Image, positions: Positions) -> dict[str, float]:
    """Return overlap, landmark error and folds of a map, as far as the pair's files say what is right."""
    return folds(fixed, positions) | quality(pair, fixed, positions)


def quality(pair: Pair, fixed: td.Image, positions: Positions) -> dict[str, float]:
    """Return overlap and landmark error of a map.

    Args:
        pair: the files.
        fixed: the fixed image as it was registered, perhaps on a coarser grid than that of the labels.
        positions: where its voxels go.
    """
    figures = {}
    if pair.fixed_labels and pair.moving_labels:
        labels = [read_labels(path) for path in (pair.fixed_labels, pair.moving_labels)]
        here = to_array(fixed.to_world(fixed.grid.points(dtype=torch.float64)))
        counted = pair.counted or common_labels(labels[0].data, labels[1].data)
        figures |= overlap(nearest(labels[0], here), nearest(labels[1], positions), counted)
    if pair.fixed_points and pair.moving_points:
        figures |= landmarks((pair.fixed_points, pair.moving_points), fixed, positions)
    return figures


def to_array(world: torch.Tensor) -> Positions:
    """Return points ``(1, D, *S)`` as positions ``(*S, D)``."""
    return np.moveaxis(world[0].double().cpu().numpy(), 0, -1)


def to_tensor(positions: Positions) -> torch.Tensor:
    """Return positions ``(*S, D)`` as points ``(1, D, *S)``."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(positions, -1, 0)))[None]


def overlap(fixed: NDArray[np.int64], warped: NDArray[np.int64], counted: tuple[int, ...]) -> dict[str, float]:
    """Return the mean Dice of the labels ``counted`` that ``fixed`` has, and that of all labels except 0 as one.

    Args:
        fixed: labels.
        warped: those of the moving image on the same voxels.
        counted: labels that both images have.
    """
    most = int(max(fixed.max(), warped.max(), *counted)) + 1
    sizes, others, both = (
        np.bincount(values.ravel(), minlength=most) for values in (fixed, warped, fixed[fixed == warped])
    )
    each = [2 * float(both[k]) / float(sizes[k] + others[k]) for k in counted if sizes[k]]
    union = 2 * float(((fixed > 0) & (warped > 0)).sum()) / float(sizes[1:].sum() + others[1:].sum())
    return {"dice": mean(each), "union": union}


def nearest(image: td.Image, positions: Positions) -> NDArray[np.int64]:
    """Return the labels of the voxels that the positions fall into, 0 outside of the image."""
    values = image.data[0, 0].numpy()
    index = np.rint(to_array(image.to_grid(to_tensor(positions))) / image.grid.spacing)
    inside = ((index >= 0) & (index < values.shape)).all(-1)
    index = np.where(inside[..., None], index, 0).astype(int)
    return np.where(inside, values[tuple(np.moveaxis(index, -1, 0))], 0).astype(np.int64)


def landmarks(files: tuple[Path, Path], fixed: td.Image, positions: Positions) -> dict[str, float]:
    """Return mean and median distance of the moved fixed points from their partners."""
    first, second, _ = matched(*(td.read_points(path, fixed) for path in files))
    moved = sample(to_tensor(positions), fixed.to_grid(first.T[None]), fixed.grid)
    errors = (moved[0].T - second).norm(dim=1).tolist()
    return {"landmark_mean": mean(errors), "landmark_median": median(errors)}


def folds(fixed: td.Image, positions: Positions) -> dict[str, float]:
    """Return folds by the certificate and by central differences, and the standard deviation of log J."""
    u = fixed.to_grid(to_tensor(positions)) - fixed.grid.points(dtype=torch.float64)
    found = td.diagnose(u, fixed.grid)
    return {
        "folds": float(found.folds),
        "central_folds": float(found.central_folds),
        "log_det_std": float(found.det_log_std),
    }
