"""What is drawn over the slices: outlines, masks, landmarks, regions without data, the place to look at first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchdeform.report.contours import Lines, edge_lines, outlines
from torchdeform.report.landmarks import Landmarks
from torchdeform.report.places import Place, slice_of
from torchdeform.report.planes import Plane
from torchdeform.report.sampling import FIXED, WARPED, Sampled

OUTLINES, MASKS, TISSUE, LANDMARKS = "outlines", "masks", "tissue", "landmarks"
NO_DATA, ABSENT, WORST = "no-data", "absent", "worst"
REGIONS = (NO_DATA, ABSENT)
# Sky blue, orange, reddish purple, yellow and bluish green of Okabe and Ito, distinct with any colour blindness.
FIXED_COLOUR, MOVING_COLOUR, ABSENT_COLOUR, WORST_COLOUR, TISSUE_COLOUR, EMPTY_COLOUR = (
    "#56b4e9", "#e69f00", "#cc79a7", "#f0e442", "#009e73", "#888888",
)  # fmt: skip
LANDMARK_COLOURS = "plasma"
_CLASSES = 6  # colours of landmarks
_FEW = 0.95  # share of the landmarks that are told apart by them
_DOT, _HEAD, _RING = 0.006, 0.012, 0.04  # radius of a dot, length of an arrow's head, radius of the ring, in sides

_CIRCLE = np.stack([f(np.linspace(0, 2 * np.pi, 17)) for f in (np.cos, np.sin)], axis=1)


@dataclass(frozen=True)
class Mark:
    """What lines over slices show.

    Attributes:
        kind: one of the names above.
        image: whose place they show.
        colour: of the lines, as in CSS.
    """

    kind: str
    image: str
    colour: str


Marks = dict[Mark, tuple[Lines, ...]]  # lines by slice


@dataclass(frozen=True)
class Known:
    """What is known of a pair besides its images.

    Attributes:
        worst: the place to look at first.
        landmarks: None without.
        absent: weight ``(1, 1, *S)`` of what is in the fixed image only; None without.
    """

    worst: Place
    landmarks: Landmarks | None = None
    absent: Tensor | None = None

    @property
    def limit(self) -> float:
        """Distance of landmarks from which on they have the last colour; few are farther apart in the end."""
        return max(float(self.landmarks.distances[WARPED].quantile(_FEW)), 1e-6) if self.landmarks else 1.0


def marks_of(plane: Plane, numbers: Sequence[int], sampled: Mapping[str, Sampled], known: Known) -> Marks:
    """Return everything that is drawn over the slices of a plane.

    Args:
        plane: the plane.
        numbers: of its slices.
        sampled: both images in the slices, by name.
        known: the rest.
    """
    found: Marks = {Mark(WORST, FIXED, WORST_COLOUR): _rings(plane, numbers, known.worst)}
    if known.absent is not None:
        found[Mark(ABSENT, FIXED, ABSENT_COLOUR)] = _regions(plane.cut(known.absent, numbers) > 0.5)
    for name, image in sampled.items():
        found |= _of_image(plane, name, image)
        if known.landmarks is not None and name != FIXED:
            found |= _arrows(plane, numbers, name, known.landmarks, known.limit)
    return {mark: lines for mark, lines in found.items() if any(lines)}


def _of_image(plane: Plane, name: str, image: Sampled) -> Marks:
    """Return the ends of an image, its mask and tissue, and its labels or the edges of the fixed image."""
    colour = FIXED_COLOUR if name == FIXED else MOVING_COLOUR
    found: Marks = {Mark(NO_DATA, name, EMPTY_COLOUR): _regions(~image.inside)}
    if image.mask is not None:
        found[Mark(MASKS, name, colour)] = _regions(image.mask != 0)
    if image.tissue is not None:
        found[Mark(TISSUE, name, TISSUE_COLOUR)] = tuple(outlines(_flat(image.tissue)))
    if image.labels is not None:
        found[Mark(OUTLINES, name, colour)] = tuple(outlines(_flat(image.labels)))
    elif name == FIXED:
        spacing = [plane.grid.spacing[axis] for axis in plane.axes]
        found[Mark(OUTLINES, name, colour)] = tuple(edge_lines(_flat(image.grey), spacing))
    return found


def _flat(values: Tensor) -> NDArray:
    return values[:, 0].numpy()


def _regions(inside: Tensor) -> tuple[Lines, ...]:
    return tuple(outlines(_flat(inside)))


def nearest_slice(plane: Plane, numbers: Sequence[int], node: Sequence[float]) -> int:
    """Return the position among the slices of that which is nearest to a node."""
    if plane.through is None:
        return 0
    return int(np.abs(np.asarray(numbers) - node[plane.through]).argmin())


def _rings(plane: Plane, numbers: Sequence[int], worst: Place) -> tuple[Lines, ...]:
    """Return a ring around the place, in the slice through it."""
    lines: list[Lines] = [[] for _ in numbers]
    lines[list(numbers).index(slice_of(plane, worst))].append(_circle(plane, _flattened(plane, worst.node), _RING))
    return tuple(lines)


def _flattened(plane: Plane, node: Sequence[float]) -> NDArray[np.floating]:
    """Return a node as (across, down)."""
    return np.array([node[plane.axes[1]], node[plane.axes[0]]])


def _side(plane: Plane) -> NDArray[np.floating]:
    """Return the longer side of the plane in the nodes (across, down)."""
    spacing = np.array([plane.grid.spacing[axis] for axis in plane.axes[::-1]])
    return (np.array(plane.shape[::-1]) * spacing).max() / spacing


def _circle(plane: Plane, middle: NDArray[np.floating], radius: float) -> NDArray[np.floating]:
    return middle + radius * _side(plane) * _CIRCLE


def landmark_colours() -> list[str]:
    """Return the colours of landmarks, the nearest first."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps[LANDMARK_COLOURS]((k + 0.5) / _CLASSES)) for k in range(_CLASSES)]


def _arrows(plane: Plane, numbers: Sequence[int], stage: str, landmarks: Landmarks, limit: float) -> Marks:
    """Return dots at the fixed landmarks with arrows to where those of the moving image are, by colour."""
    shades = (landmarks.distances[stage] / limit * _CLASSES).long().clamp(0, _CLASSES - 1).tolist()
    drawn: list[list[Lines]] = [[[] for _ in numbers] for _ in range(_CLASSES)]
    for start, end, shade in zip(landmarks.fixed.tolist(), landmarks.moved[stage].tolist(), shades, strict=True):
        lines = drawn[shade][nearest_slice(plane, numbers, start)]
        lines += _arrow(plane, _flattened(plane, start), _flattened(plane, end))
    return {
        Mark(LANDMARKS, stage, colour): tuple(lines) for colour, lines in zip(landmark_colours(), drawn, strict=True)
    }


def _arrow(plane: Plane, start: NDArray[np.floating], end: NDArray[np.floating]) -> Lines:
    """Return a dot, and where the arrow leaves it, the arrow."""
    side = _side(plane)
    dot, way = _circle(plane, start, _DOT), (end - start) / side
    length = np.hypot(*way)
    if length < _DOT:
        return [dot]
    along = way / length
    head = end - side * min(_HEAD, length / 2) * (along + np.outer((0.6, -0.6), (-along[1], along[0])))
    return [dot, np.stack((start + side * _DOT * along, end)), np.stack((head[0], end, head[1]))]
