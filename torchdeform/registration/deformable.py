"""Registration by flows: forces ask for divergence and curl, least squares give the velocity, its flow moves φ."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from time import perf_counter

import torch
from torch import Tensor

from torchdeform.diagnostics import Diagnosis, diagnose, inverse_error, one_sided_determinant
from torchdeform.errors import ComputationError, InputError
from torchdeform.fem.form import Form, Row, Term
from torchdeform.fem.operator import assemble_load
from torchdeform.fem.spectral import TransformSolver
from torchdeform.fem.weights import Weights
from torchdeform.flow import integrate
from torchdeform.grid import Grid
from torchdeform.image import Image, luminance, require_registrable, resample
from torchdeform.registration.pyramid import MIN_NODES, prolong, pyramid_grids, restrict
from torchdeform.registration.result import Callback, LevelRecord, Progress, RegistrationResult
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.similarity import Similarity, make_similarity, scale_intensities
from torchdeform.stencil import derivative, jacobian_determinant
from torchdeform.warp import compose, invert, max_voxels, warp

# Steps over which a level must have gained, see `RegistrationSettings.tolerance`.
_PATIENCE = 10

# The step falls to this share of itself over a level.
_LAST_STEP = 0.1

# Fewer nodes than this are not worth more than one thread: with two threads beside another busy program, a pair of
# 291×216 took twice as long as with one.
_NODES_PER_THREAD = 2**16

# Weight of the divergence that opens up nearly folded places, against a force of 1 at its strongest.
_RESISTANCE = 3.0

# A step that is still too bold at this fraction of itself is not taken.
_SHORTEST = 2.0**-6


@torch.no_grad()
def register(
    fixed: Tensor | Image,
    moving: Tensor | Image,
    config: RegistrationSettings | None = None,
    *,
    callback: Callback | None = None,
) -> RegistrationResult:
    """Return the map φ that maximises S(fixed, moving ∘ φ), grown as a composition of flows, coarse to fine.

    Args:
        fixed: image that stays: ``(B, C, *S)`` with a pair per item, or an `Image`.
        moving: image that is warped; a tensor of the same shape, or an `Image` anywhere in the same world.
        config: settings; those of the preset ``default`` when None.
        callback: is shown every step.

    Returns:
        `RegistrationResult`. For tensors the unit is the voxel. For images it is that of the files (mm), colours are
        registered on their luminance, and ``warped`` is the moving image, colours and all, sampled once.

    Raises:
        InputError: shapes, fewer than 8 nodes on an axis, NaN or constant images, 2D against 3D.
        ComputationError: the map is not finite.

    Notes:
        One step: force = N ∂S/∂warped ∇warped; K v = M force + load of a divergence where the map is nearly folded, K
        being the div-curl least squares with w_d, w_c and w_0 = w_d / length²; φ ← φ ∘ flow(v), the longest move being
        ``step_length`` voxels, less where a one-sided determinant would fall below ``min_determinant``. A level keeps
        its most similar map. Items of a batch do not influence each other. Liu, Liao & Xue 2007, section 2, with the
        controls driven by the images.
    """
    settings = config or RegistrationSettings()
    if isinstance(fixed, Image) and isinstance(moving, Image):
        return _register_images(fixed, moving, settings, callback)
    if isinstance(fixed, Image) or isinstance(moving, Image):
        raise InputError("register: fixed and moving must be two tensors or two Images, not one of each")
    grid = _checked_grid(fixed, moving)
    scaled = scale_intensities(fixed, moving, jointly=settings.similarity == "ssd")
    return _optimise(*scaled, moving, grid, settings, callback)


def _checked_grid(fixed: Tensor, moving: Tensor) -> Grid:
    if not isinstance(fixed, Tensor) or fixed.dim() not in (4, 5):
        raise InputError("register: fixed must be a tensor (B, C, *S) with 2 or 3 axes in S, or an Image")
    grid = Grid(tuple(fixed.shape[2:]))
    for name, image in (("fixed", fixed), ("moving", moving)):
        grid.check(image, f"register: {name}", components=fixed.shape[1])
        if not bool(image.isfinite().all()):
            raise InputError(f"register: {name} has values that are NaN or infinite; replace them first")
    if fixed.shape[0] != moving.shape[0] or fixed.dtype != moving.dtype or fixed.device != moving.device:
        raise InputError("register: fixed and moving must agree in batch size, dtype and device")
    _require_size(grid)
    return grid


def _require_size(grid: Grid) -> None:
    if min(grid.shape) < MIN_NODES:
        raise InputError(f"register: every axis must have at least {MIN_NODES} voxels, got {grid.shape}")


def _register_images(
    fixed: Image, moving: Image, settings: RegistrationSettings, callback: Callback | None
) -> RegistrationResult:
    """Take the moving image onto the fixed grid in its physical place, register, and sample the original once."""
    _require_size(fixed.grid)
    grey = luminance(fixed), luminance(moving)
    for image in grey:
        require_registrable(image)
    placed = resample(grey[1], grey[0], outside=None).to(grey[0].data.dtype)
    scaled = scale_intensities(grey[0].data, placed, jointly=settings.similarity == "ssd")
    result = _optimise(*scaled, placed, fixed.grid, settings, callback)
    warped = resample(moving, fixed, result.displacement).to(moving.data.dtype)
    return replace(result, warped=warped)


@dataclass(frozen=True)
class _Level:
    """What stays the same during the steps of one level."""

    index: int
    grid: Grid
    moving: Tensor
    similarity: Similarity
    metric: TransformSolver
    controls: Form
    power: int


def _make_level(index: int, grid: Grid, images: tuple[Tensor, Tensor], settings: RegistrationSettings) -> _Level:
    fixed, moving = images
    voxel = grid.cell_volume ** (1 / grid.dim)
    weights = Weights(
        div=settings.weight_div,
        curl=settings.weight_curl,
        zero=settings.weight_div / (settings.length * voxel) ** 2,
    )
    divergence = Row(_RESISTANCE, tuple(Term(1.0, k, k) for k in range(grid.dim)))
    force = tuple(Row(1.0, (Term(1.0, k, None),)) for k in range(grid.dim))
    return _Level(
        index=index,
        grid=grid,
        moving=moving,
        similarity=make_similarity(settings.similarity, fixed, settings.window),
        metric=TransformSolver(grid, weights, "slip", dtype=fixed.dtype, device=fixed.device),
        controls=(divergence, *force),
        power=settings.power,
    )


def _optimise(
    fixed: Tensor,
    moving: Tensor,
    original: Tensor,
    grid: Grid,
    settings: RegistrationSettings,
    callback: Callback | None,
) -> RegistrationResult:
    """Run the levels on scaled images."""
    grids = pyramid_grids(grid, len(settings.steps))
    steps = settings.steps[-len(grids) :]
    u = fixed.new_zeros(fixed.shape[0], grid.dim, *grids[0].shape)
    records = []
    for index, (coarse, count) in enumerate(zip(grids, steps, strict=True)):
        images = restrict(fixed, grid, coarse), restrict(moving, grid, coarse)
        level = _make_level(index, coarse, images, settings)
        with _threads_worth(fixed.shape[0], coarse):
            u, record = _run_level(level, _unfold(prolong(u, coarse), coarse), count, len(grids), settings, callback)
        records.append(record)
    with _threads_worth(fixed.shape[0], grid):
        return _finish((fixed, moving, original), u, grid, settings, records)


@contextmanager
def _threads_worth(items: int, grid: Grid) -> Iterator[None]:
    """Use no more of torch's threads than the fields are worth: on a shared machine small ones wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, items * math.prod(grid.shape) // _NODES_PER_THREAD)))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _finish(
    images: tuple[Tensor, Tensor, Tensor],
    u: Tensor,
    grid: Grid,
    settings: RegistrationSettings,
    records: list[LevelRecord],
) -> RegistrationResult:
    """Invert the map and judge it."""
    fixed, moving, original = images
    start = perf_counter()
    similarity = make_similarity(settings.similarity, fixed, settings.window)
    before, after = (similarity.evaluate(image)[0] for image in (moving, warp(moving, u, grid)))
    middle = perf_counter()
    inverse = invert(u, grid)
    mean, largest = inverse_error(u, inverse, grid)
    inverted = perf_counter()
    return RegistrationResult(
        displacement=u,
        inverse=inverse,
        warped=warp(original, u, grid),
        grid=grid,
        similarity_before=before,
        similarity_after=after,
        diagnosis=_require_sound(u, grid),
        inverse_error_mean=mean,
        inverse_error_max=largest,
        levels=tuple(records),
        seconds={
            "register": sum(record.seconds for record in records) + middle - start,
            "invert": inverted - middle,
            "diagnose": perf_counter() - inverted,
        },
        settings=settings,
    )


def _require_sound(u: Tensor, grid: Grid) -> Diagnosis:
    if not bool(u.isfinite().all()):
        raise ComputationError(
            "register: the map is not finite; check the images for extreme values, or lower step_length"
        )
    return diagnose(u, grid)


def _run_level(
    level: _Level, u: Tensor, steps: int, levels: int, settings: RegistrationSettings, callback: Callback | None
) -> tuple[Tensor, LevelRecord]:
    """Climb one level; every item ends at the most similar map it met."""
    start, shortened = perf_counter(), 0
    best, values = u, []
    top = u.new_full((u.shape[0],), -torch.inf)
    active = torch.ones_like(top, dtype=torch.bool)
    tops, lowest = [], _lowest(u, level.grid)
    for step in range(steps + 1):
        warped = warp(level.moving, u, level.grid)
        value, gradient = level.similarity.evaluate(warped)
        best, top = _keep(value > top, (u, value), (best, top))
        values.append(value)
        tops.append(top)
        if callback:
            callback(Progress(level.index, levels, step, steps, value, level.grid.shape))
        active &= ~_stalled(tops, settings.tolerance)
        if step == steps or not bool(active.any()):
            break
        pace = settings.step_length * (1 - (1 - _LAST_STEP) * step / steps)
        divergence = (settings.soft_determinant / lowest - 1).clamp_(min=0)
        move = _move(level, warped, gradient, divergence) * _column(pace * active, u)
        u, lowest, moved, short = _advance((u, lowest), move, level.grid, settings.min_determinant)
        active &= moved
        shortened += short
    return best, LevelRecord(level.grid.shape, tuple(values), shortened, perf_counter() - start)


def _stalled(tops: list[Tensor], tolerance: float) -> Tensor:
    """True for the items whose last steps raised the best similarity by too small a share of the whole rise."""
    if len(tops) <= _PATIENCE:
        return torch.zeros_like(tops[0], dtype=torch.bool)
    return tops[-1] - tops[-1 - _PATIENCE] <= tolerance * (tops[-1] - tops[0])


def _move(level: _Level, warped: Tensor, gradient: Tensor, divergence: Tensor) -> Tensor:
    """Return the velocity that least squares find for the force and the divergence, its longest move being one voxel.

    The force is scaled to 1 at its strongest, so the divergence needs no unit of similarity.
    """
    grid = level.grid
    force = torch.cat([(gradient * derivative(warped, grid, a)).sum(1, keepdim=True) for a in range(grid.dim)], dim=1)
    tiny = torch.finfo(force.dtype).tiny
    force = force / _column(force.square().sum(1).flatten(1).amax(1).sqrt().clamp(min=tiny), force)
    v = level.metric.solve(
        assemble_load(level.controls, torch.cat([divergence, force], dim=1), grid), power=level.power
    )
    return v / _column(max_voxels(v, grid).clamp(min=tiny), v)


def _advance(
    state: tuple[Tensor, Tensor], move: Tensor, grid: Grid, limit: float
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Return u ∘ flow(move) and its `_lowest`, which items moved, and how often a step was halved.

    No determinant falls below ``limit``, or below the smallest one there was if that was less. Along the halvings the
    trial tends to u, so a bold step ends as a short one.
    """
    u, lowest = state
    floor = lowest.flatten(1).amin(1).clamp(max=limit)
    fraction, halved = torch.ones_like(floor), 0
    while True:
        trial = compose(u, integrate(move * _column(fraction, u), grid, steps=1, method="midpoint"), grid)
        trial_lowest = _lowest(trial, grid)
        low = ~(trial_lowest.flatten(1).amin(1) >= floor)
        count = int(low.sum())
        if count == 0:
            return trial, trial_lowest, ~low, halved
        if bool((fraction[low] <= _SHORTEST).all()):
            (u, lowest) = _keep(~low, (trial, trial_lowest), state)
            return u, lowest, ~low, halved
        halved += count
        fraction = torch.where(low, fraction / 2, fraction)


def _lowest(u: Tensor, grid: Grid) -> Tensor:
    """Return at each node the smallest determinant ``(B, 1, *S)``, one-sided or by `jacobian_determinant`.

    Inside Ω the latter is a mean of one-sided ones. On the faces, where it extrapolates, it has to be looked at.
    """
    lowest = one_sided_determinant(u, grid)
    for axis, n in zip(grid.axes, grid.shape, strict=True):
        layers = torch.cat([u.narrow(axis, 0, 3), u.narrow(axis, n - 3, 3)])
        first, last = jacobian_determinant(layers, Grid(tuple(layers.shape[2:]), grid.spacing)).chunk(2)
        for node, det in ((0, first), (n - 1, last)):
            face = lowest.select(axis, node)
            torch.minimum(face, det.select(axis, 0 if node == 0 else 2), out=face)
    return lowest


def _unfold(u: Tensor, grid: Grid) -> Tensor:
    """Return u, drawn towards 0 until it does not fold: interpolation to a finer grid may, rarely, fold a map."""
    while bool((low := ~(_lowest(u, grid).flatten(1).amin(1) > 0)).any()):
        u = torch.where(_column(low, u), 0.9 * u, u)
    return u


def _keep(chosen: Tensor, new: tuple[Tensor, Tensor], old: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return both new tensors for the chosen items, the old ones for the others."""
    if bool(chosen.all()):
        return new
    first, second = (torch.where(_column(chosen, n), n, o) for n, o in zip(new, old, strict=True))
    return first, second


def _column(per_item: Tensor, like: Tensor) -> Tensor:
    """Return ``(B,)`` as ``(B, 1, 1, ..)``, to go with a field."""
    return per_item.view(-1, *([1] * (like.dim() - 1)))
