"""What is compared beside the intensities, or in their place: features of both images, and labels that pull."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdeform.core.grid import Grid, per_item
from torchdeform.core.image import Image
from torchdeform.core.intensities import corresponding_channels, fill, intensity_range, to_common_scale
from torchdeform.core.resampling import restrict, with_nodes
from torchdeform.errors import InputError
from torchdeform.io.programs import load_program, quiet
from torchdeform.metrics.base import mean, relative_weight, weighted
from torchdeform.metrics.evaluation import common_labels
from torchdeform.metrics.mind import mind_ssc, neighbour_pairs
from torchdeform.metrics.similarity import needs_common_scale, similarity_weights
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.problem import Channels, RegistrationProblem
from torchdeform.registration.settings import FILES, INTENSITIES, MIND, RegistrationSettings

# Images are taken through a program in tiles of this width, which begin at multiples of _STEP so that what a network
# pools falls together as in the whole image. What is nearer than _OVERLAP to the edge of a tile is taken from its
# neighbour: a network that sees no farther gives the same in tiles as in one.
TILE = {2: 512, 3: 128}
OVERLAP = 16

# Of this width is the part of an image that shows whether a program does what it must, before any long work.
_TRIED = {2: 128, 3: 48}

# Vectors shorter than this share of the longest are not made unit vectors: they are noise.
_SHORT = 1e-3

# Probabilities of labels that are held of each image, at most, and labels that are compared at once. 32 labels are on
# 2^19 nodes (80³): both images take 134 MB.
MOST_PROBABILITIES, _AT_ONCE = 2**24, 8


def contradiction(
    settings: RegistrationSettings, *, features: bool, labels: bool, options: tuple[str, str] = ("features", "labels")
) -> str:
    """Return what is wrong with settings where files of features and of labels are given or not; empty if nothing is.

    Args:
        settings: of the registration.
        features: whether features of both images are given.
        labels: whether labels of both images are.
        options: what these are called where they are given.
    """
    if features and settings.sources and FILES not in settings.sources:
        return (
            f"features are given twice, by {options[0]} and by the setting features; give one, or weigh both as "
            "{files: 1, mind: 0.5}"
        )
    if not features and FILES in settings.sources:
        return f"features: files are channels of both images, but there are none; give {options[0]}"
    if settings.labels_weight > 0 and not labels:
        return f"labels_weight needs labels of both images, but there are none; give {options[1]}, or leave it 0"
    return ""


def settled(settings: RegistrationSettings, annotations: Annotations) -> RegistrationSettings:
    """Return the settings with ``features: files`` where features are given; `InputError` as `contradiction` says."""
    given = annotations.features is not None
    if problem := contradiction(settings, features=given, labels=annotations.labels is not None):
        raise InputError(f"register: {problem}")
    return replace(settings, features=FILES) if given and not settings.sources else settings


def with_channels(problem: RegistrationProblem, settings: RegistrationSettings) -> RegistrationProblem:
    """Return the problem with all that is compared beside its intensities, or in their place.

    Args:
        problem: images scaled to about [0, 1] in the place where the deformation begins, with features and labels as
            they are given.
        settings: decided.

    Raises:
        InputError: as `run_program`, or features without contrast.
    """
    channels = [*_of_features(problem, settings)]
    if settings.labels_weight > 0:
        channels += _of_labels(problem, settings.labels_weight)
    return replace(
        problem, features=None, labels=None, channels=tuple(channels), intensities=not settings.only_features
    )


def _of_features(problem: RegistrationProblem, settings: RegistrationSettings) -> Iterator[Channels]:
    """Yield the features that the settings ask for, as each measure compares them."""
    sources, alone = settings.sources, settings.only_features
    measures = similarity_weights(settings.similarity.measure) if alone else {"ssd": 1.0}
    weights = {(s, m): sources[s] * measures[m] for s, m in product(sources, measures) if s != INTENSITIES}
    first = next(iter(weights.values()), 1.0) if alone else sources.get(INTENSITIES, 1.0)
    for source in sources:
        if source == INTENSITIES:
            continue
        made = _made(source, problem)
        _require_contrast(made, name_of(source))
        for measure in measures:
            yield Channels(
                problem.grid, *_prepared(made, measure, source, problem), measure, weights[source, measure] / first
            )


def _made(source: Any, problem: RegistrationProblem) -> tuple[Tensor, Tensor]:
    """Return features of both images ``(B, K, *S)``."""
    fixed, moving = problem.fixed, problem.moving
    if source == FILES:
        if problem.features is None:
            raise InputError("register: features: files are channels of both images, but there are none")
        return _filled([field.to(fixed) for field in problem.features], problem)
    if source == MIND:
        return mind_ssc(fixed), mind_ssc(moving)
    program = program_of(source, fixed.device)
    return run_program(program, fixed, name_of(source)), run_program(program, moving, name_of(source))


def _require_contrast(features: tuple[Tensor, Tensor], name: str) -> None:
    for side, values in zip(("fixed", "moving"), features, strict=True):
        varies = values.flatten(2).amax(2) > values.flatten(2).amin(2)
        if not bool(varies.any(1).all()):
            raise InputError(
                f"features: those of {name} are the same in every voxel of the {side} image, so there is nothing to "
                "compare; choose others"
            )


def _filled(fields: list[Tensor], problem: RegistrationProblem) -> tuple[Tensor, Tensor]:
    """Return a field of each image without what the masks leave out, as the images are."""
    masks = problem.fixed_mask, problem.moving_mask
    fixed, moving = (f if mask is None else fill(f, mask) for f, mask in zip(fields, masks, strict=True))
    return fixed, moving


def _prepared(
    features: tuple[Tensor, Tensor], measure: str, source: Any, problem: RegistrationProblem
) -> tuple[Tensor, Tensor]:
    """Return features as a measure compares them: by ``ssd`` unit vectors, by others channels from 0 to 1.

    Notes:
        The mean over K channels of the squared difference of vectors of length √(K/2) is 1 − cos of their angle. One
        channel alone has no direction, and self-similarities are vectors of one scale already.
    """
    if source == MIND:
        return features
    if measure != "ssd" or features[0].shape[1] == 1:
        masks = problem.fixed_mask, problem.moving_mask
        return to_common_scale(features, masks, jointly=needs_common_scale(measure))
    first, second = (_unit(vectors) for vectors in features)
    return first, second


def _unit(vectors: Tensor) -> Tensor:
    length = vectors.norm(dim=1, keepdim=True)
    longest = length.flatten(1).amax(1).view(-1, *[1] * (length.dim() - 1))
    floor = (_SHORT * longest).clamp(min=torch.finfo(length.dtype).tiny)
    return vectors * (math.sqrt(vectors.shape[1] / 2) / length.maximum(floor))


def program_of(source: Any, device: torch.device) -> Callable[[Tensor], Tensor]:
    """Return what can be called: the program in a file, or what is given."""
    program: Any = source if callable(source) else load_program(Path(source), device)
    return program


def name_of(source: Any) -> str:
    """Return what a source of features is called in sentences and records."""
    if not callable(source):
        return str(source)
    return getattr(source, "__name__", type(source).__name__)


def described(features: Any) -> Any:
    """Return the setting ``features`` with names in place of what can be called."""
    if isinstance(features, dict):
        return {name_of(source): weight for source, weight in features.items()}
    return None if features is None else name_of(features)


@torch.no_grad()
def run_program(program: Callable[[Tensor], Tensor], images: Tensor, name: str) -> Tensor:
    """Return the features of images ``(B, K, *S)``, one image and one tile after another.

    Args:
        program: takes ``(1, C, *T)`` float32, returns ``(1, K, *T)`` for every size T.
        images: ``(B, C, *S)``, scaled to about [0, 1].
        name: of the program, for messages.

    Raises:
        InputError: the program fails, or returns something else, or values that are not finite.

    Notes:
        A module runs where its parameters are. Memory is bounded by that for a tile, and by the result.
    """
    size, found = TILE[images.dim() - 2], None
    for item in range(len(images)):
        for tile, kept in _tiles(images.shape[2:], size):
            values = _called(program, images[item : item + 1][(..., *tile)], name)
            if found is None:
                found = images.new_empty(len(images), values.shape[1], *images.shape[2:])
            _require_channels(values, found.shape[1], name)
            inner = tuple(slice(k.start - t.start, k.stop - t.start) for k, t in zip(kept, tile, strict=True))
            found[item][(slice(None), *kept)] = values[0][(slice(None), *inner)].to(found)
    return images[:, :0] if found is None else found


def _tiles(shape: tuple[int, ...], size: int) -> Iterator[tuple[tuple[slice, ...], tuple[slice, ...]]]:
    """Yield tiles of an image, and the part of each that is kept; these make up the whole."""
    for tile in product(*(_pieces(nodes, size) for nodes in shape)):
        yield tuple(whole for whole, _ in tile), tuple(kept for _, kept in tile)


def _pieces(nodes: int, size: int) -> list[tuple[slice, slice]]:
    """Return pieces of an axis that overlap, and the part of each that is kept."""
    step = size - 2 * OVERLAP
    starts = range(0, max(nodes - 2 * OVERLAP, 1), step)
    ends = [start + OVERLAP for start in starts[1:]]
    kept = zip([0, *ends], [*ends, nodes], strict=True)
    return [(slice(a, min(a + size, nodes)), slice(*inner)) for a, inner in zip(starts, kept, strict=True)]


def _called(program: Callable[[Tensor], Tensor], tile: Tensor, name: str) -> Tensor:
    """Return what a program makes of a tile; `InputError` unless that is of its size and finite."""
    weights = next(iter(program.parameters()), tile) if isinstance(program, nn.Module) else tile
    what = f"an image of {tile.shape[1]} channel{'s' * (tile.shape[1] > 1)} and {tile.dim() - 2} axes"
    try:
        with quiet():
            values = program(tile.to(weights.device, torch.float32, copy=True))  # which it may write into
    except Exception as error:
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or "allocate" in str(error):
            raise
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"features: {name} fails on {what} of size {_sized(tile)} ({reason[-1].strip()}); it must take (1, C, *S) "
            "of any size"
        ) from error
    if not isinstance(values, Tensor) or values.dim() != tile.dim() or values.shape[2:] != tile.shape[2:]:
        got = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        wanted = f"(1, K, {', '.join(map(str, tile.shape[2:]))})"
        raise InputError(f"features: {name} must return {wanted} for {what} of that size, but returns {got}")
    if len(values) != 1 or values.shape[1] == 0:
        raise InputError(f"features: {name} must return one image with channels, but returns {tuple(values.shape)}")
    if values.is_complex():
        raise InputError(f"features: {name} returns complex numbers; return their parts as channels of their own")
    if not bool(values.isfinite().all()):
        raise InputError(f"features: {name} returns values that are NaN or infinite; choose another program")
    return values


def _sized(image: Tensor) -> str:
    return "×".join(map(str, image.shape[:1:-1]))


def _require_channels(values: Tensor, count: int, name: str) -> None:
    if values.shape[1] != count:
        raise InputError(
            f"features: {name} returns {count} channels for one image or tile and {values.shape[1]} for another; "
            "their number must not depend on the image"
        )


@torch.no_grad()
def count_features(
    settings: RegistrationSettings, fixed: Tensor | Image, moving: Tensor | Image, annotations: Annotations
) -> int:
    """Return how many channels of features are compared, after a trial of all programs on a part of both images.

    Raises:
        InputError: as `run_program`.
    """
    if not settings.sources:
        return 0
    if isinstance(fixed, Image) and isinstance(moving, Image):
        images = tuple(image.data for image in corresponding_channels(fixed, moving))
    else:
        images = fixed, moving
    parts = [_tried(image) for image in images if isinstance(image, Tensor)]
    measures = len(similarity_weights(settings.similarity.measure)) if settings.only_features else 1
    return measures * sum(_count(source, parts, annotations) for source in settings.sources)


def _tried(image: Tensor) -> Tensor:
    """Return the middle of an image, scaled to about [0, 1], what is not finite being 0."""
    width = _TRIED[image.dim() - 2]
    middle = tuple(slice(max((n - width) // 2, 0), max((n - width) // 2, 0) + width) for n in image.shape[2:])
    part = image[:1][(..., *middle)].float().nan_to_num(0, 0, 0)
    low, high = (end.view(1, -1, *[1] * (part.dim() - 2)) for end in intensity_range(part[0].flatten(1)))
    return (part - low) / torch.where(high > low, high - low, 1)


def _count(source: Any, parts: list[Tensor], annotations: Annotations) -> int:
    """Return the number of channels of one source of features."""
    if source == INTENSITIES:
        return 0
    if source == FILES:
        given = annotations.fixed_features
        return 0 if given is None else (given.data if isinstance(given, Image) else given).shape[1]
    if source == MIND:
        return parts[0].shape[1] * len(neighbour_pairs(parts[0].dim() - 2))
    program, name = program_of(source, parts[0].device), name_of(source)
    found = [run_program(program, part, name) for part in parts]
    _require_channels(found[1], found[0].shape[1], name)
    return found[0].shape[1]


def _of_labels(problem: RegistrationProblem, weight: float) -> Iterator[Channels]:
    """Yield smooth probabilities p and q of the labels that both images have, some at a time.

    Notes:
        Those of a label are divided by √E(p² + q²), so that −E(p − q)² is −1 where it does not overlap and 0 where it
        does, whatever its size. No item of a batch depends on others.
    """
    if problem.labels is None:
        raise InputError("register: labels_weight needs labels of both images, but there are none")
    names = common_labels(*problem.labels)
    grid = with_nodes(problem.grid, max(MOST_PROBABILITIES // len(names), 2**problem.grid.dim))
    fixed_mask, moving_mask = problem.masks_on(grid)
    mask = moving_mask if fixed_mask is None else weighted(fixed_mask, moving_mask)
    known = torch.stack([_in_both(problem.labels, name) for name in names]).to(problem.fixed)  # labels of items
    known *= (len(names) / known.sum(0).clamp(min=1)).sqrt()
    for some in (slice(k, k + _AT_ONCE) for k in range(0, len(names), _AT_ONCE)):
        pairs = [_probabilities(problem, name, grid, mask) for name in names[some]]
        fixed, moving = (
            torch.cat([field * per_item(scale, field) for field, scale in zip(fields, known[some], strict=True)], dim=1)
            for fields in zip(*pairs, strict=True)
        )
        yield Channels(grid, fixed, moving, "ssd", weight * fixed.shape[1] / len(names))


def _in_both(labels: tuple[Tensor, Tensor], name: int) -> Tensor:
    """Return for each item whether both of its images have the label, ``(B,)``."""
    return (labels[0] == name).flatten(1).any(1) & (labels[1] == name).flatten(1).any(1)


def _probabilities(problem: RegistrationProblem, name: int, grid: Grid, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return those of one label in both images, divided as they are to be, both ``(B, 1, *S)``."""
    regions = [(labels == name).to(problem.fixed) for labels in problem.labels or ()]
    fixed, moving = (restrict(region, problem.grid, grid) for region in _filled(regions, problem))
    size = mean(fixed.square() + moving.square(), relative_weight(mask, fixed))
    scale = per_item(torch.where(size > 0, size, 1).rsqrt(), fixed)
    return fixed * scale, moving * scale
