"""The images of a pair as every tool gets them: one channel, labels painted, whole brains coarser if asked for."""

import sys
from dataclasses import replace
from pathlib import Path

from pairs import Pair

import torchdeform as td
from torchdeform.core.image import luminance
from torchdeform.core.resampling import coarsened, restrict
from torchdeform.io.images import read_labels

sys.path.append(str(Path(__file__).resolve().parents[1]))  # painting

# Images of more nodes are whole brains.
_WHOLE = 2**22


def images(pair: Pair, shrink: float = 1) -> tuple[td.Image, td.Image]:
    """Return both images of a pair, grey.

    Args:
        pair: the files.
        shrink: how much coarser the grids of whole brains are made along each axis.
    """
    fixed, moving = (_image(pair, side) for side in range(2))
    return _coarser(fixed, shrink), _coarser(moving, shrink)


def _image(pair: Pair, side: int) -> td.Image:
    path = (pair.fixed, pair.moving)[side]
    if not pair.contrasts:
        return luminance(td.read_image(path))
    from painting import paint  # needs more than registration does

    labels = read_labels(path)
    seed = sum(path.name.encode()) + side  # noise that both images shared would be a clue
    return replace(labels, data=paint(labels.data, pair.contrasts[side], seed), pixel_type="float32")


def _coarser(image: td.Image, factor: float) -> td.Image:
    if factor == 1 or image.data.numel() <= _WHOLE:
        return image
    grid = coarsened(image.grid, factor)
    return replace(image, data=restrict(image.data, image.grid, grid), grid=grid)
