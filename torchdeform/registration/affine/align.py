"""Alignment: the rigid, similarity or affine map of the world that brings two images together, from any start."""

import math
from dataclasses import dataclass, replace
from time import perf_counter

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, luminance, require_registrable, require_same_dimension, resample
from torchdeform.core.intensities import fill, to_common_scale
from torchdeform.core.resampling import with_spacing
from torchdeform.core.transform import Affine
from torchdeform.errors import ComputationError, InputError, require_choice
from torchdeform.metrics.correlation import ForegroundLNCC
from torchdeform.metrics.similarity import Similarity, features, make_similarity, needs_common_scale, similarity_weights
from torchdeform.registration.affine.guesses import Guess, guessed
from torchdeform.registration.affine.lie import generators
from torchdeform.registration.affine.objective import AffineObjective, MaskedImage, NormalisedFrame
from torchdeform.registration.affine.search import Candidate, SearchResult, optimised, search
from torchdeform.registration.affine.settings import ALIGNMENTS, COARSEST_NODES, AlignmentSettings

# Factor by which voxels grow until the finest level has few enough nodes.
_COARSER = 1.02

# Voxels around a mask that are kept.
_MARGIN = 4

# Shortest step in voxels, on all levels and on the finest.
_SHORTEST, _SHORTEST_AT_LAST = 0.02, 0.01

# Levels on which several candidates are optimised.
_LEVELS_OF_SEVERAL = 2

# A ratio of sizes nearer to 1 than this needs no other voxels.
_SAME_SIZE = 1.05

# There is a warning about a smaller overlap, and about factors of length beyond these.
_LITTLE_OVERLAP = 0.5
_LENGTH_FACTORS = (0.5, 2.0)


@dataclass(frozen=True)
class Alignment:
    """The map that aligns two images.

    Attributes:
        affine: φ from points of the fixed world to the moving world; warped(x) = moving(φ(x)). Its determinant is
            positive.
        similarity_before: similarity in the files' own geometry, on the finest level; None without overlap, and where
            things are of another size than the files say.
        similarity_after: similarity through the map, higher is better; None without overlap, which only kind ``none``
            leaves.
        start: name of the start from which it was found.
        seconds: wall time.
        warnings: sentences about what looks wrong.
        mirror: merit of the best mirrored map over that of the best map, on the coarsest level; 0 if none was tried.
    """

    affine: Affine
    similarity_before: float | None
    similarity_after: float | None
    start: str
    seconds: float
    warnings: tuple[str, ...] = ()
    mirror: float = 0.0


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
    """Return the map φ(x) = M x + t of the world that maximises S(fixed, moving ∘ φ), wherever the images are.

    Args:
        fixed: image that stays, grey or colour.
        moving: image to be aligned with it; another grid, direction or spacing does not matter.
        kind: as in `AlignmentSettings`; that of the settings when None.
        fixed_mask: where the fixed image counts, not 0; on any grid.
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
        optimised by BFGS on the group of maps, coarse to fine. The files' geometry is tried again on the second level,
        and is the result if nothing is more similar. Where fields of view or voxels differ much in size, several sizes
        are tried, see `guessed`, and all places of the smaller image in the larger one. The map depends on the world positions of the voxels, not on the
        order of the axes in the file. Determinants are positive: maps are rotations times exponentials.
        Runs on the images' device, in float32; not differentiable, but `Transform.image` is, in the map and the pixels.
    """
    settings, began = settings or AlignmentSettings(), perf_counter()
    kind = settings.kind if kind is None else kind
    require_choice(kind, ALIGNMENTS, "align: kind")
    pair = _prepared((fixed, fixed_mask), (moving, moving_mask), settings)
    guesses = [Guess(*pair)] if kind == "none" else guessed(*pair, scale=kind in ("similarity", "affine"))
    trials = [_try(guess, kind, settings) for guess in guesses]
    trial = max(trials, key=lambda trial: trial.found.value)
    objectives, frame = trial.objectives(settings), trial.frame
    identity = torch.eye(fixed.grid.dim + 1, dtype=torch.float64, device="cpu")
    before = Candidate("geometry", identity, float(objectives[-1].values(identity.unsqueeze(0))[0]))
    best = before
    if kind != "none":
        after = _optimise_levels(objectives, [*trial.found.candidates, before], kind, settings)
        best = after if after.value > before.value else before
    affine = Affine(*frame.to_affine(best.map))
    return Alignment(
        affine.inverse() if trial.guess.swapped else affine,
        _finite(before.value),
        _finite(best.value),
        best.name,
        perf_counter() - began,
        _warnings(objectives[-1], best, trial, (fixed.name, moving.name)),
        trial.found.mirror,
    )


@dataclass(frozen=True)
class _Trial:
    """What the coarse search found where things are as large as a guess says."""

    guess: Guess
    frame: NormalisedFrame
    levels: list[tuple[MaskedImage, MaskedImage]]
    found: SearchResult = SearchResult([])

    def objectives(self, settings: AlignmentSettings) -> list[AffineObjective]:
        """Return those of all levels, coarse to fine, both images blurred alike by the best map."""
        levels, known = self.levels, self.guess.size or 1.0
        if abs(math.log(self.found.size / known)) > math.log(_SAME_SIZE):
            levels = _pyramid(self.guess, settings, self.found.size)
        return [_make_objective(level, self.frame, self.guess, settings) for level in levels]


def _try(guess: Guess, kind: str, settings: AlignmentSettings) -> _Trial:
    """Return the best maps of the coarsest level, nothing being searched for ``none``."""
    trial = _Trial(guess, NormalisedFrame.of(guess.fixed.image), _pyramid(guess, settings, guess.size or 1.0))
    if kind == "none":
        return trial
    objective = _make_objective(trial.levels[0], trial.frame, guess, settings)
    turn = settings.rotations and kind != "translation"
    found = search(objective, kind, turn=turn, steps=settings.steps, size=guess.size, part=guess.part)
    return replace(trial, found=found)


def _optimise_levels(
    objectives: list[AffineObjective], candidates: list[Candidate], kind: str, settings: AlignmentSettings
) -> Candidate:
    """Return the most similar candidate after all levels; the last one, the files' geometry, joins on the second."""
    moves = generators(kind, objectives[0].dim)
    *candidates, identity = candidates
    for index, objective in enumerate(objectives):
        if index == 1 or not candidates:
            candidates = [*candidates, identity]
        if index >= _LEVELS_OF_SEVERAL:  # only one goes on, which details decide
            values, _ = objective.values(torch.stack([candidate.map for candidate in candidates]))
            candidates = [candidates[int(values.argmax())]]
        shortest = _SHORTEST_AT_LAST if objective is objectives[-1] else _SHORTEST
        found = optimised(objective, candidates, moves, settings.steps, shortest)
        candidates = [candidate for candidate in found if candidate.value > -math.inf]
    if not candidates:
        raise ComputationError(
            "align: no start brings enough of the images together; check that they show the same, or lower min_overlap"
        )
    return candidates[0]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _warnings(objective: AffineObjective, best: Candidate, trial: _Trial, names: tuple[str, str]) -> tuple[str, ...]:
    """Return sentences about a mirror image, a change of size, little overlap."""
    fixed, moving = names
    sentences = []
    if trial.found.mirrored:
        sentences.append(
            f"{moving} looks like a mirror image of {fixed}: mirrored it would fit clearly better; check the "
            "directions in both headers, or flip it and align again"
        )
    longest, *_, shortest = torch.linalg.svdvals(best.map[:-1, :-1]).tolist()
    if trial.guess.swapped:
        longest, shortest = 1 / shortest, 1 / longest
    if shortest < _LENGTH_FACTORS[0] or longest > _LENGTH_FACTORS[1]:
        sentences.append(
            f"the alignment changes lengths by factors from {shortest:.2g} to {longest:.2g}; "
            f"check the spacing of {fixed} and {moving}"
        )
    overlap = float(objective.values(best.map.unsqueeze(0))[1])
    if overlap < _LITTLE_OVERLAP:
        sentences.append(f"{fixed} and {moving} share only {overlap:.0%} of the smaller one; check the result")
    return tuple(sentences)


def _prepared(
    fixed: tuple[Image, Image | None], moving: tuple[Image, Image | None], settings: AlignmentSettings
) -> tuple[MaskedImage, MaskedImage]:
    """Return both images grey, cropped to their masks, with most of their intensities between 0 and 1."""
    require_same_dimension(fixed[0], moving[0])
    pair = [_masked(luminance(image), mask).cropped(_MARGIN) for image, mask in (fixed, moving)]
    scaled = to_common_scale(
        (pair[0].image.data, pair[1].image.data),
        (pair[0].weight, pair[1].weight),
        jointly=needs_common_scale(settings.similarity),
    )
    first, second = (_filled(part.with_data(data.clamp(0, 1).float())) for part, data in zip(pair, scaled, strict=True))
    return first, second


def _filled(part: MaskedImage) -> MaskedImage:
    """Return the image with new values where it has no weight: smoothing would spread the old ones."""
    return part if part.weight is None else part.with_data(fill(part.image.data, part.weight))


def _masked(image: Image, mask: Image | None) -> MaskedImage:
    require_registrable(image)
    if mask is None:
        return MaskedImage(image)
    if mask.grid.dim != image.grid.dim:
        raise InputError(f"{mask.name} is {mask.grid.dim}D but {image.name} is {image.grid.dim}D; give a mask like it")
    inside = resample(replace(mask, data=(luminance(mask).data != 0).to(mask.data.dtype)), image, mode="nearest")
    if not bool(inside.any()):
        raise InputError(f"{mask.name} marks no voxel of {image.name}; check that it is the right mask")
    return MaskedImage(image, inside.to(image.data))


def _pyramid(guess: Guess, settings: AlignmentSettings, size: float) -> list[tuple[MaskedImage, MaskedImage]]:
    """Return both images on the levels, coarse to fine; voxels are twice as wide as those of the next level.

    ``size`` is how much larger things are in the moving image: its voxels are larger by as much, to blur both alike.
    """
    fixed, moving = guess.fixed, guess.moving
    voxel = min(fixed.image.grid.spacing)
    while math.prod(with_spacing(fixed.image.grid, voxel).shape) > settings.nodes_in(fixed.image.grid.dim):
        voxel *= _COARSER
    levels = []
    while True:
        fixed, moving = fixed.coarser(voxel), moving.coarser(voxel * size)
        levels.insert(0, (fixed, moving))
        voxel *= 2
        shape = fixed.image.grid.shape
        if math.prod(shape) <= COARSEST_NODES or with_spacing(fixed.image.grid, voxel).shape == shape:
            return levels


def _make_objective(
    level: tuple[MaskedImage, MaskedImage], frame: NormalisedFrame, guess: Guess, settings: AlignmentSettings
) -> AffineObjective:
    """Return the objective of two images at one resolution."""

    def compared(part: MaskedImage) -> MaskedImage:
        return part.with_data(features(settings.similarity, part.image.data))

    def make(image: Tensor, grid: Grid) -> Similarity:
        if similarity_weights(settings.similarity).keys() == {"lncc"}:
            return ForegroundLNCC(image, settings.window_in(grid.dim))
        return make_similarity(settings.similarity, image, settings.window_in(grid.dim), grid=grid)

    fixed, moving = map(compared, level)
    return AffineObjective(fixed, moving, frame, make, settings.min_overlap, guess.sizes)
