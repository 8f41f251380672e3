"""Registration by flows, from the images to the result: check, scale, place, optimise, invert, measure."""

from dataclasses import dataclass, replace
from time import perf_counter

import torch
from torch import Tensor

from torchdeform.core.diagnostics import Diagnosis, diagnose, inverse_error, smallest_determinant
from torchdeform.core.fold_free import repair_folds
from torchdeform.core.grid import Grid, limit_threads
from torchdeform.core.image import Image, resample, same_place
from torchdeform.core.intensities import require_finite
from torchdeform.core.resampling import prolong
from torchdeform.core.stages import begin
from torchdeform.core.transform import Affine
from torchdeform.core.warp import invert, warp
from torchdeform.errors import ComputationError, InputError
from torchdeform.metrics.evaluation import evaluate_images, evaluate_tensors
from torchdeform.metrics.similarity import mark
from torchdeform.registration.absence import Regions, let_go, moved_with
from torchdeform.registration.agreement import disagreement
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.channels import count_features, settled, with_channels
from torchdeform.registration.discrete import discrete_start
from torchdeform.registration.evidence import gather_evidence, to_compare, with_labels
from torchdeform.registration.keypoints import Keypoints, anchors_of, keypoint_start, too_few
from torchdeform.registration.objective import common_mask, forward_objective
from torchdeform.registration.optimise import best_map, held_still, optimise_levels
from torchdeform.registration.placement import Placement, place, problem_at
from torchdeform.registration.problem import (
    PlacedImage,
    RegistrationProblem,
    moved,
    placed_images,
    problem_of_tensors,
)
from torchdeform.registration.result import Callback, LevelRecord, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.sliding import optimise_sides
from torchdeform.registration.symmetric import (
    MidSpace,
    common_axes,
    midspace_of_images,
    midspace_of_tensors,
    optimise_symmetric,
)
from torchdeform.registration.tissue import Tissue, TissueOutcome


@torch.no_grad()
def register(
    fixed: Tensor | Image,
    moving: Tensor | Image,
    config: RegistrationSettings | None = None,
    *,
    annotations: Annotations | None = None,
    affine: Affine | Placement | None = None,
    start: Tensor | None = None,
    callback: Callback | None = None,
) -> RegistrationResult:
    """Return the map φ that maximises S(fixed, moving ∘ A ∘ φ), grown as a composition of flows, coarse to fine.

    Args:
        fixed: image that stays: ``(B, C, *S)`` with a pair per item, or an `Image`.
        moving: image that is warped; a tensor of the same shape, or an `Image` anywhere in the same world.
        config: settings; those of the preset ``default`` when None.
        annotations: masks, landmarks, labels and features.
        affine: map A from the world of the fixed image to that of the moving one, for images, or what `place` returned
            for them; when None, that which `align` finds as ``config.align`` says.
        start: displacement ``(B, D, *S)`` in units of spacing to begin with, fold-free; what the coarsest level cannot
            hold of it is found again or lost. What ``config.start`` says when None.
        callback: is shown every step.

    Returns:
        `RegistrationResult`. For tensors the unit is the voxel. For images it is that of the files (mm), all channels
        are compared (see `corresponding_channels`), and ``warped`` is the moving image sampled once.

    Raises:
        InputError: shapes, NaN or constant images, 2D against 3D, channels that do not correspond, a start that folds,
            annotations that do not fit.
        ComputationError: the map is not finite.

    Notes:
        One step: force = N ∂S/∂warped ∇warped, evened; K v = M force + load of a divergence where the map is nearly
        folded, K being the div-curl least squares with w_d, w_c and w_0 = w_d / length²; φ ← φ ∘ flow(v), the longest
        move being ``step_length`` voxels, less where a one-sided determinant would fall below ``min_determinant``. A
        level keeps its most similar map, and the result is never less similar than its start, over the same voxels.
        Items of a batch do not influence each other. Liu, Liao & Xue 2007, section 2, with the controls driven by the
        images.
        Landmarks add the force of their squared distance at the points. With ``symmetric`` two maps from a space
        between move against each other, and φ = φ_m ∘ φ_f⁻¹.
    """
    annotations = annotations or Annotations()
    settings = settled(config or RegistrationSettings(), annotations)
    if isinstance(fixed, Image) and isinstance(moving, Image):
        return _register_images(fixed, moving, settings, annotations, affine, start, callback)
    if isinstance(fixed, Image) or isinstance(moving, Image):
        raise InputError("register: fixed and moving must be two tensors or two Images, not one of each")
    if affine is not None:
        raise InputError("register: affine is a map of the world, so fixed and moving must be Images")
    return _register_tensors(fixed, moving, settings, annotations, start, callback)


def _register_tensors(
    fixed: Tensor,
    moving: Tensor,
    settings: RegistrationSettings,
    annotations: Annotations,
    start: Tensor | None,
    callback: Callback | None,
) -> RegistrationResult:
    grid = _checked_grid(fixed, moving, annotations)
    problem = problem_of_tensors(fixed, moving, grid, annotations)
    require_finite(problem.fixed, problem.moving, "register")
    settings = settings.decided()  # items of a batch may not choose for each other
    problem = replace(problem, tissue=_tissue(annotations.tissue, settings, fixed))
    problem, regions = _ready(problem, settings)
    space = midspace_of_tensors(problem) if settings.symmetric else None
    found, compared = _optimise(problem, space, settings, start, callback), to_compare(problem)
    del problem, space
    with limit_threads(len(found.u), grid):
        warped = warp(moving, found.u, grid)
        evaluation = evaluate_tensors(found.u, grid, labels=annotations.labels, points=annotations.points)
    absent = moved_with(regions, found.u, grid)
    result = replace(_result(found, grid, warped, settings), evaluation=evaluation, absent=absent)
    return _examined(result, compared, (fixed, moving), annotations.labels)


def _ready(problem: RegistrationProblem, settings: RegistrationSettings) -> tuple[RegistrationProblem, Regions | None]:
    """Return the problem on its scale, with all that is compared and without what is let go, and where that is."""
    problem = problem.scaled(settings)
    problem, regions = let_go(replace(problem, noise=problem.measured_noise()), settings)
    return with_channels(problem, settings), regions


def _on(labels: Tensor | Image | None, fixed: Image) -> Tensor | None:
    return resample(labels, fixed, mode="nearest").round() if isinstance(labels, Image) else None


def _tissue(labels: Tensor | Image | None, settings: RegistrationSettings, like: Tensor) -> Tissue | None:
    """Return what the fixed image is made of; None where nothing is said.

    Raises:
        InputError: labels without settings that say what they stand for, or the other way round, or ``symmetric``.
    """
    if (labels is None) == settings.knows_tissue:
        missing = "annotations.tissue" if labels is None else "the settings tissues or sliding"
        raise InputError(f"register: tissue needs both labels and what they stand for, but {missing} is not given")
    if not isinstance(labels, Tensor):
        return None
    if settings.symmetric:
        raise InputError("register: symmetric and tissue exclude each other, as tissue is that of the fixed image")
    return Tissue.of(labels, settings, like)


def _examined(
    result: RegistrationResult,
    compared: RegistrationProblem,
    images: tuple[Tensor, Tensor],
    labels: tuple[Tensor, Tensor] | None,
) -> RegistrationResult:
    """Return the result with its evidence, from images on a grid of few nodes, and labels on the images' own grids."""
    begin("judging")
    began = perf_counter()
    maps = (result.displacement, result.inverse, result.grid)
    apart = disagreement(compared, result.settings)
    evidence = gather_evidence(compared, *maps, disagreement=apart, absent=result.absent)
    if labels is not None:
        evidence = with_labels(evidence, images, labels)
    return replace(result, evidence=evidence, seconds=result.seconds | {"judge": perf_counter() - began})


def _checked_grid(fixed: Tensor, moving: Tensor, annotations: Annotations) -> Grid:
    if not isinstance(fixed, Tensor) or fixed.dim() not in (4, 5):
        raise InputError("register: fixed must be a tensor (B, C, *S) with 2 or 3 axes in S, or an Image")
    grid = Grid(tuple(fixed.shape[2:]))
    for name, image in (("fixed", fixed), ("moving", moving)):
        grid.check(image, f"register: {name}", components=fixed.shape[1])
    if fixed.shape[0] != moving.shape[0] or fixed.dtype != moving.dtype or fixed.device != moving.device:
        raise InputError("register: fixed and moving must agree in batch size, dtype and device")
    annotations.require_tensors(grid, fixed.shape[0])
    return grid


def _register_images(
    fixed: Image,
    moving: Image,
    settings: RegistrationSettings,
    annotations: Annotations,
    affine: Affine | Placement | None,
    start: Tensor | None,
    callback: Callback | None,
) -> RegistrationResult:
    """Take the moving image onto the fixed grid in its physical place, register, and sample the original once."""
    annotations.require_images(fixed.grid.dim)
    if isinstance(affine, Placement):
        placed = affine
    else:
        count_features(settings, fixed, moving, annotations)  # what a program cannot do shows before the alignment
        placed = place(fixed, moving, settings, annotations, affine)
    pulling = annotations if settings.labels_weight > 0 else replace(annotations, fixed_labels=None, moving_labels=None)
    both, settings, affine = placed_images(fixed, moving, pulling), placed.settings, placed.affine
    problem = replace(problem_at(*both, affine), tissue=_tissue(_on(annotations.tissue, fixed), settings, fixed.data))
    problem, regions = _ready(problem, settings)
    space = _midspace(*both, problem, affine, settings) if settings.symmetric else None
    found, compared = _optimise(problem, space, settings, start, callback), to_compare(problem)
    del problem, space
    warped = _warped(fixed, moving, affine, found.u, settings)
    alignment, result = placed.alignment, _result(found, fixed.grid, warped, settings)
    result = replace(
        result,
        affine=affine,
        alignment=alignment,
        warnings=(*(alignment.warnings if alignment else ()), *result.warnings),
        unit=fixed.unit,
        absent=moved_with(regions, found.u, fixed.grid),
        choice=placed.choice,
        similarity_before=result.similarity_before if placed.unaligned is None else placed.unaligned,
        similarity_aligned=result.similarity_before if alignment or placed.unaligned is not None else None,
        evaluation=evaluate_images(fixed, affine, found.u, labels=annotations.labels, points=annotations.points),
        seconds=({"align": alignment.seconds} if alignment else {}) | result.seconds,
    )
    given = annotations.labels
    labels = given and (resample(given[0], fixed, mode="nearest"), resample(given[1], moving, mode="nearest"))
    return _examined(result, compared, (fixed.data, moving.data), labels)


def _midspace(
    fixed: PlacedImage,
    moving: PlacedImage,
    problem: RegistrationProblem,
    affine: Affine | None,
    settings: RegistrationSettings,
) -> MidSpace:
    """Return the space between two images; where they share a grid and a place it is theirs."""
    if affine is None and same_place(fixed.image, moving.image):
        return midspace_of_tensors(problem)
    space = midspace_of_images(fixed, moving, affine, common_axes(fixed.image, moving.image))
    return replace(space, problem=_ready(space.problem, settings)[0])


def _warped(fixed: Image, moving: Image, affine: Affine | None, u: Tensor, settings: RegistrationSettings) -> Tensor:
    """Return the moving image on the fixed grid, sampled once."""
    seen = moving if affine is None else moved(moving, affine.inverse())
    return resample(seen, fixed, u, outside=settings.outside).to(moving.data.dtype)


@dataclass(frozen=True)
class _Optimised:
    """Where the loop ended: the displacement on the fixed grid, how each level went, S, its mark, seconds ..."""

    u: Tensor
    records: tuple[LevelRecord, ...]
    objective: tuple[Tensor, ...]
    marks: tuple[Tensor, ...]
    seconds: float
    tissue: tuple[TissueOutcome, ...]
    keypoints: tuple[Keypoints, ...]


def _optimise(
    problem: RegistrationProblem,
    space: MidSpace | None,
    settings: RegistrationSettings,
    start: Tensor | None,
    callback: Callback | None,
) -> _Optimised:
    """Optimise on the fixed grid or in the space between; the images as they are compared are needed no more then."""
    began = perf_counter()
    points: tuple[Keypoints, ...] = ()
    if start is not None:
        start = _checked_start(start, problem)
    else:
        start, points = _searched(problem, settings)
    if space is not None:
        u, records = optimise_symmetric(space, problem.grid, settings, start, callback)
    elif settings.sliding:
        u, records = optimise_sides(problem, settings, start, callback)
    else:
        anchored = replace(problem, anchors=anchors_of(points, problem.fixed))
        u, records = optimise_levels(anchored, settings, start, callback)
    kept: tuple[TissueOutcome, ...] = ()
    with limit_threads(len(u), problem.grid):
        objective = forward_objective(problem, problem.grid, settings)
        zero = torch.zeros_like(u)
        u, after, before = best_map(objective, settings, u, *([] if start is None else [start]), zero)
        values = before, after
        if problem.tissue is not None:
            u, kept = problem.tissue.corrected(u, problem.grid, settings.folds.min_determinant, problem.held)
            values = tuple(objective.on_common_voxels([zero, u], None))
        known = settings.similarity.measure == "lncc" and not problem.channels
        marks = values if known else _marks(problem, settings, zero, u)
    return _Optimised(u, records, values, marks, perf_counter() - began, kept, points)


def _searched(
    problem: RegistrationProblem, settings: RegistrationSettings
) -> tuple[Tensor | None, tuple[Keypoints, ...]]:
    """Return the map to begin with as the settings say, None for the identity, and the points that it joins."""
    images, points = (problem.fixed, problem.moving, problem.grid), ()
    if settings.decided_start == "identity":
        return None, points
    begin("searching")
    if settings.decided_start == "keypoints":
        masks = {"mask": problem.fixed_mask, "moving_mask": problem.moving_mask}
        start, points = keypoint_start(*images, **masks, settings=settings.keypoints)
    else:
        start = discrete_start(*images, mask=problem.fixed_mask, settings=settings.discrete)
    return repair_folds(held_still(start, problem.held), problem.grid) if problem.held else start, points


def _marks(problem: RegistrationProblem, settings: RegistrationSettings, *maps: Tensor) -> tuple[Tensor, ...]:
    """Return the `mark` of the images warped by each of the maps, over the voxels that all of them see."""
    grid, measure, window = problem.grid, settings.seen_by, settings.similarity.window
    mask = common_mask(problem.fixed_mask, problem.moving_mask, maps, grid)
    found = (warp(problem.moving, u, grid) for u in maps)
    return tuple(mark(measure, problem.fixed, w, mask=mask, window=window, grid=grid) for w in found)


def _checked_start(start: Tensor, problem: RegistrationProblem) -> Tensor:
    grid = problem.grid
    grid.check_vector(start, "register: start")
    if len(start) != len(problem.fixed):
        raise InputError(f"register: start must have {len(problem.fixed)} batch items, got {len(start)}")
    if not bool((smallest_determinant(start, grid) > 0).all()):
        raise InputError("register: start folds or is not finite; smooth it, or scale it down")
    return start.to(problem.fixed)


def _result(found: _Optimised, grid: Grid, warped: Tensor, settings: RegistrationSettings) -> RegistrationResult:
    """Invert the map and measure it."""
    begin("inverting")
    with limit_threads(len(found.u), grid):
        start = perf_counter()
        inverse = invert(found.u, grid)
        mean, largest = inverse_error(found.u, inverse, grid)
        inverted = perf_counter()
        return RegistrationResult(
            displacement=found.u,
            inverse=inverse,
            warped=warped,
            grid=grid,
            similarity_before=found.marks[0],
            similarity_after=found.marks[1],
            objective_before=found.objective[0],
            objective_after=found.objective[1],
            diagnosis=_require_sound(found.u, grid),
            inverse_error_mean=mean,
            inverse_error_max=largest,
            levels=found.records,
            seconds={"register": found.seconds, "invert": inverted - start, "diagnose": perf_counter() - inverted},
            settings=settings,
            tissue=found.tissue,
            keypoints=found.keypoints,
            warnings=too_few(found.keypoints),
        )


def _require_sound(u: Tensor, grid: Grid) -> Diagnosis:
    if not bool(u.isfinite().all()):
        raise ComputationError(
            "register: the map is not finite; check the images for extreme values, or lower optimiser.step_length"
        )
    return diagnose(u, grid)


@torch.no_grad()
def resample_result(
    result: RegistrationResult, fixed: Image, moving: Image, annotations: Annotations
) -> RegistrationResult:
    """Return the result on the grid of ``fixed``, everything that follows from its maps made anew.

    Args:
        result: of images, on a coarser grid of the same box.
        fixed: the fixed image, whose grid is wanted.
        moving: the moving image.
        annotations: labels and landmarks to measure.

    Returns:
        The result with both maps interpolated linearly, and repaired where that folds them; similarities are
        those of the grid on which it was found. Tissue is corrected again, as interpolation changes volumes.
    """
    grid = fixed.grid
    u, inverse = (repair_folds(prolong(w, grid), grid) for w in (result.displacement, result.inverse))
    kept, tissue = result.tissue, _tissue(_on(annotations.tissue, fixed), result.settings, u)
    if tissue is not None:
        held = [axis for axis, part in enumerate(u.unbind(1)) if not bool(part.any())]
        u, kept = tissue.corrected(u, grid, result.settings.folds.min_determinant, held)
        inverse = invert(u, grid)
    mean, largest = inverse_error(u, inverse, grid)
    return replace(
        result,
        displacement=u,
        inverse=inverse,
        grid=grid,
        absent=None if result.absent is None else prolong(result.absent, grid),
        warped=_warped(fixed, moving, result.affine, u, result.settings),
        diagnosis=diagnose(u, grid),
        inverse_error_mean=mean,
        inverse_error_max=largest,
        tissue=kept,
        evaluation=evaluate_images(fixed, result.affine, u, labels=annotations.labels, points=annotations.points),
    )
