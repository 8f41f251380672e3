"""Alignment: the rigid, similarity or affine map of the world that brings two images together, from any start."""

import math
from dataclasses import dataclass, replace
from time import perf_counter

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, luminance, require_registrable, resample
from torchdeform.core.intensities import fill, to_common_scale
from torchdeform.core.resampling import with_voxels
from torchdeform.core.transform import Affine
from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.metrics.correlation import DetailCorrelation
from torchdeform.metrics.similarity import Similarity, features, make_similarity, needs_common_scale, similarity_weights
from torchdeform.registration.affine.lie import generators
from torchdeform.registration.affine.objective import Frame, Level, Masked
from torchdeform.registration.affine.search import Candidate, Found, climbed, search
from torchdeform.registration.affine.settings import ALIGNMENTS, COARSEST_NODES, AlignmentSettings

# How much finer the next voxels are that are tried for the finest level.
_FINER = 1.02

# Voxels around a mask that belong to the picture.
_MARGIN = 4

# Voxels within which the summit of a level is found, and that of the finest.
_NEAR, _NEAREST = 0.02, 0.01

# Levels on which several candidates are climbed.
_CONTEST = 2

# A ratio of sizes nearer to 1 than this needs no other voxels.
_SAME_SIZE = 1.05

# An overlap, and changes of length, that are worth a warning.
_LITTLE_OVERLAP = 0.5
_LENGTHS = (0.5, 2.0)


@dataclass(frozen=True)
class Alignment:
    """The map that aligns two images.

    Attributes:
        affine: φ from points of the fixed world to the moving world; warped(x) = moving(φ(x)). Its determinant is
            positive.
        similarity_before: similarity in the files' own geometry, on the finest level; None without overlap.
        similarity_after: similarity through the map, higher is better; None without overlap, which only kind ``none``
            leaves.
        start: where the climb began.
        seconds: wall time.
        warnings: sentences about what looks wrong.
    """

    affine: Affine
    similarity_before: float | None
    similarity_after: float | None
    start: str
    seconds: float
    warnings: tuple[str, ...] = ()


@torch.no_grad()
def align(
    fixed: Image,
    moving: Image,
    kind: str | None = None,
    *,
    fixed_mask: Image | None = None,
    moving_mask: Image | None = None,
    settings: AlignmentSettings | None = None,
) -> Alignment:
    """Return the map φ(x) = M x + t of the world that maximises S(fixed, moving ∘ φ), from wherever the images lie.

    Args:
        fixed: image that stays, grey or colour.
        moving: image to be aligned with it; another grid, direction or spacing does not matter.
        kind: as in `AlignmentSettings`; that of the settings when None.
        fixed_mask: where the fixed image counts, not 0; anywhere in the world.
        moving_mask: the same for the moving image.
        settings: defaults when None.

    Returns:
        `Alignment`.

    Raises:
        InputError: kind; 2D against 3D; NaN or constant images; numbers of channels; a mask without a voxel.
        ComputationError: no start gives enough overlap.

    Notes:
        Starts are the files' geometry, the centres of the boxes, the centres of mass and the principal axes, each with
        rotations all around (36 in 2D, the 60 of the icosahedron in 3D), on a grid of some 4000 nodes. The best are
        climbed by BFGS on the group of maps, coarse to fine; the files' geometry competes again on the second level,
        and is kept at the end if nothing is more similar. The map depends on the world positions of the voxels, not
        on the order of the axes in the file. Determinants are positive: maps grow from rotations by exponentials.
        Runs on the images' device, in float32; not differentiable.
    """
    settings, began = settings or AlignmentSettings(), perf_counter()
    kind = settings.kind if kind is None else kind
    require_choice(kind, ALIGNMENTS, "align: kind")
    pair = _prepared((fixed, fixed_mask), (moving, moving_mask), settings)
    frame = Frame.of(pair[0].image)
    levels, found = _levels(*pair, frame, settings), Found([])
    still = Candidate("geometry", torch.eye(fixed.grid.dim + 1, dtype=torch.float64), 0.0)
    best = still
    if kind != "none":
        turn = settings.rotations and kind != "translation"
        found = search(levels[0], kind, turn=turn, steps=settings.steps)
        if abs(math.log(found.size)) > math.log(_SAME_SIZE):
            levels = _levels(*pair, frame, settings, found.size)
        best = _descend(levels, [*found.candidates, still], kind, settings)
    before = _valued(levels[-1], still)
    best = before if kind == "none" else best
    if best.value <= before.value:
        best = before
    return Alignment(
        Affine(*frame.to_affine(best.map)),
        _finite(before.value),
        _finite(best.value),
        best.name,
        perf_counter() - began,
        _warnings(levels[-1], best, found, (fixed.name, moving.name)),
    )


def _descend(levels: list[Level], candidates: list[Candidate], kind: str, settings: AlignmentSettings) -> Candidate:
    """Climb all levels; the last candidate, the files' geometry, has been tried and joins again on the second level."""
    moves = generators(kind, levels[0].dim)
    *candidates, still = candidates
    for index, level in enumerate(levels):
        if index == 1 or not candidates:
            candidates = [*candidates, still]
        if index >= _CONTEST:
            candidates = candidates[:1]  # the most similar on the level before
        near = _NEAREST if level is levels[-1] else _NEAR
        candidates = [c for c in climbed(level, candidates, moves, settings.steps, near) if c.value > -math.inf]
    if not candidates:
        raise ComputationError(
            "align: no start brings enough of the images together; check that they show the same, or lower min_overlap"
        )
    return candidates[0]


def _valued(level: Level, candidate: Candidate) -> Candidate:
    return replace(candidate, value=float(level.values(candidate.map.unsqueeze(0))[0]))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _warnings(level: Level, best: Candidate, found: Found, names: tuple[str, str]) -> tuple[str, ...]:
    """Return sentences about a mirror image, a change of size, little overlap."""
    fixed, moving = names
    said = []
    if found.mirrored:
        said.append(
            f"{moving} looks like a mirror image of {fixed}: mirrored it would fit clearly better; check the "
            "directions in both headers, or flip it and align again"
        )
    lengths = torch.linalg.svdvals(best.map[:-1, :-1])
    if float(lengths.min()) < _LENGTHS[0] or float(lengths.max()) > _LENGTHS[1]:
        said.append(
            f"the alignment changes lengths by factors from {float(lengths.min()):.2g} to {float(lengths.max()):.2g}; "
            f"check the spacing of {fixed} and {moving}"
        )
    shared = float(level.values(best.map.unsqueeze(0))[1])
    if shared < _LITTLE_OVERLAP:
        said.append(f"{fixed} and {moving} share only {shared:.0%} of the smaller one; check the result")
    return tuple(said)


def _prepared(
    fixed: tuple[Image, Image | None], moving: tuple[Image, Image | None], settings: AlignmentSettings
) -> tuple[Masked, Masked]:
    """Return both images grey, cropped to their masks, with the bulk of their intensities between 0 and 1."""
    if fixed[0].grid.dim != moving[0].grid.dim:
        kinds = f"{fixed[0].name} is {fixed[0].grid.dim}D but {moving[0].name} is {moving[0].grid.dim}D"
        raise InputError(f"{kinds}; give two images of the same dimension")
    pair = [_masked(luminance(image), mask).cropped(_MARGIN) for image, mask in (fixed, moving)]
    scaled = to_common_scale(
        (pair[0].image.data, pair[1].image.data),
        (pair[0].weight, pair[1].weight),
        jointly=needs_common_scale(settings.similarity),
    )
    first, second = (_filled(part.with_data(data.clamp(0, 1).float())) for part, data in zip(pair, scaled, strict=True))
    return first, second


def _filled(part: Masked) -> Masked:
    """Return the image with new values where it has no weight: smoothing would spread the old ones."""
    return part if part.weight is None else part.with_data(fill(part.image.data, part.weight))


def _masked(image: Image, mask: Image | None) -> Masked:
    require_registrable(image)
    if mask is None:
        return Masked(image)
    if mask.grid.dim != image.grid.dim:
        raise InputError(f"{mask.name} is {mask.grid.dim}D but {image.name} is {image.grid.dim}D; give a mask like it")
    inside = resample(replace(mask, data=(luminance(mask).data != 0).to(mask.data.dtype)), image, mode="nearest")
    if not bool(inside.any()):
        raise InputError(f"{mask.name} marks no voxel of {image.name}; check that it is the right mask")
    return Masked(image, inside.to(image.data))


def _levels(fixed: Masked, moving: Masked, frame: Frame, settings: AlignmentSettings, size: float = 1.0) -> list[Level]:
    """Return the levels, coarse to fine, each with twice the voxels' width of the next.

    ``size`` is how much larger things are in the moving image: voxels larger by as much blur both images alike.
    """
    voxel = min(fixed.image.grid.spacing)
    while math.prod(with_voxels(fixed.image.grid, voxel).shape) > settings.nodes_in(fixed.image.grid.dim):
        voxel *= _FINER
    levels = []
    while True:
        fixed, moving = fixed.coarser(voxel), moving.coarser(voxel * size)
        levels.insert(0, _level(fixed, moving, frame, settings))
        voxel *= 2
        shape = fixed.image.grid.shape
        if math.prod(shape) <= COARSEST_NODES or with_voxels(fixed.image.grid, voxel).shape == shape:
            return levels


def _level(fixed: Masked, moving: Masked, frame: Frame, settings: AlignmentSettings) -> Level:
    def compared(part: Masked) -> Masked:
        return part.with_data(features(settings.similarity, part.image.data))

    def make(image: Tensor, grid: Grid) -> Similarity:
        if similarity_weights(settings.similarity).keys() == {"lncc"}:
            return DetailCorrelation(image, settings.window_in(grid.dim))
        return make_similarity(settings.similarity, image, settings.window_in(grid.dim), grid=grid)

    return Level(compared(fixed), compared(moving), frame, make, settings.min_overlap)
