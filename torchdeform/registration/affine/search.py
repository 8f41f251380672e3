"""The coarse search of an alignment: many starts are tried, the best are optimised, mirror images are compared."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.grid import limit_threads
from torchdeform.core.image import background, box_corners, centre_of_mass
from torchdeform.registration.affine.bfgs import maximise
from torchdeform.registration.affine.lie import angle, generators, homogeneous, rotations, scale_of
from torchdeform.registration.affine.objective import AffineObjective, MaskedImage, NormalisedFrame
from torchdeform.registration.affine.parts import part_places

# Starts that are optimised, mirrored ones among them, and those that go on to the next level.
_OPTIMISED, _MIRRORED, _KEPT = 10, 3, 3

# Maps nearer to each other than this (norm of the difference of their matrices over their scale) count as one.
_SAME_START, _SAME_END = 0.3, 0.05

# Places in the moving image that are tried for a fixed image that shows a part of it: without rotations, with each of
# them, and all together.
_PLACES, _PLACES_TURNED, _PARTS = 8, 3, 40

# Shortest step in voxels here; the maps are optimised again.
_SHORTEST = 0.05

# A map that turns further than this many degrees has to be better than the others by this share.
_TURNED, _TURNED_GAIN = 45.0, 1.1

# A mirror image has to be better by this share before it is mentioned.
_MIRROR_GAIN = 1.2

# A ratio of sizes nearer to 1 than this is no reason to start with another scale.
_SAME_SIZE = 1.1


@dataclass(frozen=True)
class Candidate:
    """A map on its way to the alignment.

    Attributes:
        name: the start it comes from.
        map: matrix ``(D + 1, D + 1)`` in the coordinates of the `NormalisedFrame`.
        value: its similarity on the last level.
        turned: whether the start is more than a shift and a scale.
    """

    name: str
    map: Tensor
    value: float = 0.0
    turned: bool = False


@dataclass(frozen=True)
class SearchResult:
    """The result of the coarse search.

    Attributes:
        candidates: the best maps, the best first.
        mirror: merit of the best mirrored map over that of the best map, see `search`; 1 is equally good.
    """

    candidates: list[Candidate]
    mirror: float = 0.0

    @property
    def value(self) -> float:
        """Similarity of the best map, less what does not overlap; −∞ without one."""
        return self.candidates[0].value if self.candidates else -math.inf

    @property
    def size(self) -> float:
        """How much larger things are in the moving image, by the best map; 1 without one."""
        return float(scale_of(self.candidates[0].map[:-1, :-1])) if self.candidates else 1.0

    @property
    def mirrored(self) -> bool:
        """Whether a mirrored map is clearly better."""
        return self.mirror > _MIRROR_GAIN


def _apart(maps: Tensor) -> Tensor:
    """Return the norms ``(n, n)`` of the differences of maps over their scale, which makes them shares of the image."""
    size = scale_of(maps[:, :-1, :-1])
    difference = (maps.unsqueeze(0) - maps.unsqueeze(1)).flatten(2).norm(dim=2)
    return difference / (size.unsqueeze(0) * size.unsqueeze(1)).sqrt()


def optimised(
    objective: AffineObjective, candidates: Sequence[Candidate], moves: Tensor, steps: int, shortest: float
) -> list[Candidate]:
    """Return the candidates after some steps of `maximise`, the most similar first."""
    starts = torch.stack([c.map for c in candidates])
    with limit_threads(len(candidates) * objective.fields, objective.fixed.image.grid):
        maps, values = maximise(objective, starts, moves, steps=steps, shortest=shortest)
    moved = [replace(c, map=m, value=float(v)) for c, m, v in zip(candidates, maps, values, strict=True)]
    return sorted(moved, key=lambda c: -c.value)


def search(
    objective: AffineObjective, kind: str, *, turn: bool, steps: int, size: float | None = None, part: bool = False
) -> SearchResult:
    """Return the best maps found from the files' geometry, the centres, the moments, and rotations of them.

    Args:
        objective: of the coarsest level.
        kind: ``translation`` to ``affine``; ``affine`` is searched as ``similarity``.
        turn: try rotations, and mirror images.
        steps: evaluations at most.
        size: how much larger things are in the moving image; None for as large, and for what the moments say.
        part: whether the fixed image may show a part of the moving one.

    Notes:
        Maps are ranked by their merit (S − median of S over all starts) · overlap: what is common to bad maps does not
        count, and a small overlap counts little. A map that turns by more than 45° needs 1.1 times the merit of all
        that turn less.
    """
    rough = "similarity" if kind == "affine" else kind
    moments = [image_moments(image, objective.frame) for image in (objective.fixed, objective.moving)]
    sizes = _sizes(*moments, scale=rough == "similarity") if size is None else [size]
    starts = make_starts(*moments, turn=turn, sizes=sizes)
    if part:
        starts += part_starts(objective, sizes[0], turn=turn)
    found, median = _try(objective, starts, rough, steps, _OPTIMISED)
    if not turn or not found:
        return SearchResult(_best(found, median))
    flipped = make_starts(*moments, turn=True, sizes=sizes, mirror=True)
    mirrored, _ = _try(objective, flipped, rough, steps, _MIRRORED)
    merit, rival = (max((c.value - median for c in some), default=0.0) for some in (found, mirrored))
    return SearchResult(_best(found, median), rival / max(merit, 1e-12))


def _try(
    objective: AffineObjective, starts: list[Candidate], kind: str, steps: int, most: int
) -> tuple[list[Candidate], float]:
    """Return the maps found from the most promising starts, median + merit being their value, and the median."""
    maps = torch.stack([start.map for start in starts])
    value, overlap = objective.values(maps)
    finite = value.isfinite()
    if not bool(finite.any()):
        return [], 0.0
    median = float(value[finite].median())
    merit = (value - median) * overlap.clamp(max=1.0)
    chosen = [starts[i] for i in _promising(starts, maps, merit, most)]
    ends = optimised(objective, chosen, generators(kind, objective.dim), steps, _SHORTEST)
    value, overlap = objective.values(torch.stack([c.map for c in ends]))
    merit = (value - median) * overlap.clamp(max=1.0)
    return [replace(c, value=median + float(m)) for c, m in zip(ends, merit, strict=True)], median


def _promising(starts: list[Candidate], maps: Tensor, merit: Tensor, most: int) -> list[int]:
    """Return the starts to optimise: all without a rotation, then the best of the others that are not alike."""
    chosen = [i for i, start in enumerate(starts) if not start.turned and merit[i] > -torch.inf]
    alike = _apart(maps) < _SAME_START
    for i in merit.argsort(descending=True, stable=True).tolist():
        if not bool(alike[i, chosen].any()) and merit[i] > -torch.inf and len(chosen) < most:
            chosen.append(i)
    return chosen


def _best(candidates: list[Candidate], median: float) -> list[Candidate]:
    """Return a few candidates that differ, by merit, which counts for less where a map turns far."""

    def merit(candidate: Candidate) -> float:
        gain = candidate.value - median
        return gain / _TURNED_GAIN if float(angle(candidate.map[:-1, :-1])) > _TURNED else gain

    ranked = sorted((c for c in candidates if c.value > -torch.inf), key=merit, reverse=True)
    if not ranked:
        return []
    alike, kept = _apart(torch.stack([candidate.map for candidate in ranked])) < _SAME_END, []
    for i in range(len(ranked)):
        if not bool(alike[i, kept].any()) and len(kept) < _KEPT:
            kept.append(i)
    return [ranked[i] for i in kept]


def part_starts(objective: AffineObjective, size: float, *, turn: bool) -> list[Candidate]:
    """Return maps that take the fixed image to a part of the moving one, the best places for each rotation.

    Args:
        objective: of the coarsest level.
        size: how much larger things are in the moving image.
        turn: try rotations all around, in 2D; there are too many nodes for it in 3D.
    """
    frame, fixed, moving = objective.frame, objective.fixed, objective.moving
    turns = rotations(objective.dim)[: None if turn and objective.dim == 2 else 1]
    centre = fixed.image.to_world(box_corners(fixed.image.grid))[0].mean(1)
    start, found = frame.from_world(centre.view(1, -1, 1)).flatten(), []
    for r in turns:
        for fit, place in part_places(fixed, moving, size * r, _PLACES if len(turns) == 1 else _PLACES_TURNED):
            end = frame.from_world(place.view(1, -1, 1)).flatten()
            found.append((fit, replace(_about("part", size * r, start, end), turned=True)))
    best = sorted(found, key=lambda pair: -pair[0])[:_PARTS]
    return [candidate for _, candidate in best]


@dataclass(frozen=True)
class Moments:
    """Where the content of an image is, in the coordinates of a frame.

    Attributes:
        mass: centre of what is not background ``(D,)``.
        covariance: its second moments about that centre ``(D, D)``.
        box: centre of the image's box ``(D,)``.
    """

    mass: Tensor
    covariance: Tensor
    box: Tensor


def image_moments(part: MaskedImage, frame: NormalisedFrame) -> Moments:
    """Return the moments of |image − background|, or of the mask where there is one.

    Args:
        part: one or more channels; the background is the median over the faces of the box.
        frame: coordinates of the result.
    """
    grid = part.image.grid
    data = part.image.data
    weight = (data - background(data)).abs().mean(1, keepdim=True) + 1e-6 if part.weight is None else part.weight
    weight = weight.double().cpu()
    mass = frame.from_world(centre_of_mass(part.image, weight).unsqueeze(2))[0]
    points = frame.from_world(part.image.to_world(grid.points(dtype=torch.float64)).flatten(2))[0]
    away = points - mass
    covariance = (away * (weight / weight.sum()).flatten()) @ away.T
    return Moments(mass.squeeze(1), covariance, (points[:, 0] + points[:, -1]) / 2)


def _sizes(fixed: Moments, moving: Moments, *, scale: bool) -> list[float]:
    """Return how much larger things may be in the moving image: as large, or as the spread of the contents says."""
    ratio = contents_ratio(fixed, moving)
    return [1.0, ratio] if scale and max(ratio, 1 / ratio) > _SAME_SIZE else [1.0]


def contents_ratio(fixed: Moments, moving: Moments) -> float:
    """Return how much wider the content of the moving image spreads."""
    return float((moving.covariance.trace() / fixed.covariance.trace()).sqrt())


def make_starts(
    fixed: Moments, moving: Moments, *, turn: bool, sizes: Sequence[float] = (1.0,), mirror: bool = False
) -> list[Candidate]:
    """Return the maps to try, those without a rotation first.

    Args:
        fixed: moments of the fixed image.
        moving: moments of the moving image, in the same frame.
        turn: try rotations about each centre, and the principal axes.
        sizes: how much larger things may be in the moving image.
        mirror: return mirror images of the same maps, which no alignment may end at.
    """
    anchors = {
        "geometry": (fixed.box, fixed.box),
        "centres": (fixed.box, moving.box),
        "mass": (fixed.mass, moving.mass),
    }
    turns = rotations(len(fixed.box)) if turn else rotations(len(fixed.box))[:1]
    flip = torch.ones(len(fixed.box), dtype=torch.float64, device="cpu")
    flip[0] = -1.0 if mirror else 1.0
    found = []
    for (name, (start, end)), size, r in itertools.product(anchors.items(), sizes, turns):
        found.append(_about(name, size * r * flip, start, end))
    if turn:
        found += [_about("moments", sizes[0] * r * flip, fixed.mass, moving.mass) for r in _axes(fixed, moving)]
    return sorted(found, key=lambda s: s.turned)


def _about(name: str, linear: Tensor, start: Tensor, end: Tensor) -> Candidate:
    degrees = float(angle(linear)) if torch.linalg.det(linear) > 0 else 180.0
    turned = degrees > 1.0
    full = f"{name}, turned by {degrees:.0f}°" if turned else name
    return Candidate(full, homogeneous(linear, end - linear @ start), turned=turned)


def _axes(fixed: Moments, moving: Moments) -> list[Tensor]:
    """Return the rotations that take principal axes to principal axes: 2 in 2D, 4 in 3D."""
    frames = [torch.linalg.eigh(b.covariance).eigenvectors for b in (fixed, moving)]
    signs = itertools.product((1.0, -1.0), repeat=len(fixed.box))
    every = [frames[1] @ torch.diag(torch.tensor(s, dtype=torch.float64, device="cpu")) @ frames[0].T for s in signs]
    return [r for r in every if torch.linalg.det(r) > 0]
