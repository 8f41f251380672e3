"""Memory of a registration: how much it takes, and which grid fits."""

import math
from dataclasses import dataclass

from torchdeform.core.grid import Grid
from torchdeform.core.memory import at_least, readable
from torchdeform.core.resampling import MIN_NODES, with_spacing
from torchdeform.errors import InputError
from torchdeform.fem.solver import LARGEST_MATRIX
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.metrics.similarity import Measure, measures_in
from torchdeform.registration.channels import MOST_PROBABILITIES
from torchdeform.registration.settings import RegistrationSettings

_SHRINK = 0.97  # steps in which the grid that fits is sought, per axis

# Measured by ``scripts/benchmarks/memory.py``: bytes of a process that has imported everything; and per node of the
# fixed grid, whatever the similarity, by dimension. To these come those of `Measure.memory` per node and channel.
_PROCESS_BYTES = 4.5e8
_PER_NODE = {2: 100.0, 3: 80.0}
# The same of a start that is searched for, discrete or keypoints, whatever the similarity: per node, and per node and
# channel. What holds more counts.
_SEARCH = {2: (130.0, 75.0), 3: (100.0, 65.0)}
# And of an assembled matrix while it is made: per entry.
_PER_ENTRY = 90
# And of the map of each label that glides: as a share of the first map.
_PER_SIDE = 0.65
# And of each channel of features: per node, whatever the measure.
_PER_FEATURE = {2: 30.0, 3: 25.0}
# And of the labels that pull: per probability that is held of each image, of which there are at most so many a node.
_PER_PROBABILITY, _PROBABILITIES = 12.0, 32
# And of reading, joining, judging and writing on the fixed grid, however coarse the finest level is.
_FILES = {2: (65.0, 48.0), 3: (80.0, 26.0)}


@dataclass(frozen=True)
class Channels:
    """How many channels the images have, and the features that are compared."""

    images: int
    features: int = 0


def choices(settings: RegistrationSettings) -> tuple[dict[str, Measure], str, bool]:
    """Return what the cost of a registration depends on: its measures, its start, symmetric or not."""
    return measures_in(settings.similarity.measure), settings.decided_start, settings.symmetric


def footprint(grid: Grid, channels: int | Channels, settings: RegistrationSettings) -> int:
    """Return about how many bytes a process holds at most that registers images on this grid, from files to files.

    Args:
        grid: of the fixed image, which the finest level has.
        channels: of the images, and of features.
        settings: of the registration.

    Notes:
        Affine in the number of nodes; coarser levels are smaller by 2^D and do not count. Measured in float32 on a CPU,
        within 25 % from 64³ to 256³ and from 512² to 4096², and rather more than is taken beyond.
    """
    _, start, symmetric = choices(settings)
    maps = (2 if symmetric else 1) + _PER_SIDE * len(set(settings.sliding))
    per_channel = sum(measure.memory[grid.dim - 2] for measure in measures_in(settings.seen_by).values())
    per_node = maps * (_PER_NODE[grid.dim] + _counted(channels).features * _PER_FEATURE[grid.dim])
    rates = [(per_node, maps * per_channel), *([] if start == "identity" else [_SEARCH[grid.dim]])]
    return max(_affine(grid, channels, rate) for rate in rates) + _matrix(grid, settings) + _labels(grid, settings)


def _labels(grid: Grid, settings: RegistrationSettings) -> int:
    """Return the bytes of the labels that pull, 0 where none does."""
    held = min(MOST_PROBABILITIES, _PROBABILITIES * math.prod(grid.shape))
    return round(_PER_PROBABILITY * held) if settings.labels_weight > 0 else 0


def _counted(channels: int | Channels) -> Channels:
    return Channels(channels) if isinstance(channels, int) else channels


def _matrix(grid: Grid, settings: RegistrationSettings) -> int:
    """Return the bytes of the largest matrix that is assembled, 0 where none is."""
    entries = DivCurlSystem(grid, Weights()).matrix_entries
    return _PER_ENTRY * min(entries, LARGEST_MATRIX) if settings.solver.method == "assembled" else 0


def _affine(grid: Grid, channels: int | Channels, rate: tuple[float, float]) -> int:
    """Return the bytes of a process that holds so many for a node, and so many for a node and channel."""
    node, channel = rate
    return round(_PROCESS_BYTES + (node + _counted(channels).images * channel) * math.prod(grid.shape))


def least_for(grid: Grid, channels: int | Channels, settings: RegistrationSettings) -> int:
    """Return the bytes that a registration takes at least, however coarse its finest level is."""
    return min(_affine(grid, channels, _FILES[grid.dim]), footprint(grid, channels, settings))


def advice(grid: Grid, free: int, channels: int | Channels, settings: RegistrationSettings) -> str:
    """Return what to do about a registration that takes more than the ``free`` bytes."""
    least = least_for(grid, channels, settings)
    if free < least:
        return f"no --memory helps, as any grid takes {readable(least)}; resample it, or use a machine with more"
    return f"use --memory {at_least(free)} to register it on a coarser grid"


def fitting_grid(grid: Grid, limit: int, channels: int | Channels, settings: RegistrationSettings) -> Grid:
    """Return the finest grid of the same box on which a registration takes at most ``limit`` bytes.

    Args:
        grid: of the fixed image; returned as it is if it fits.
        limit: bytes, see `parse_size`.
        channels: of the images.
        settings: of the registration.

    Raises:
        InputError: files of this size take more, however coarse the finest level is.

    Notes:
        Voxels become larger until it fits, the small ones of thick slices first, as in `pyramid_grids`.
    """
    least = least_for(grid, channels, settings)
    if limit < least:
        raise InputError(
            f"--memory {readable(limit, spaced=False)} is too little for a fixed image of "
            f"{grid.size_text}: give at least {at_least(least)}, or resample it"
        )
    size, coarser = min(grid.spacing), grid
    while footprint(coarser, channels, settings) > limit and max(coarser.shape) > MIN_NODES:
        size /= _SHRINK
        coarser = with_spacing(grid, size)
    return coarser
