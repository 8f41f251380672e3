"""No more threads than the work is worth."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torchdeform.grid import Grid

# Fewer nodes than this are not worth more than one thread: with two, a pair of 216×291 gains a tenth on a quiet machine
# and takes three times as long beside another busy program.
_NODES_PER_THREAD = 2**16


@contextmanager
def threads_worth(fields: int, grid: Grid) -> Iterator[None]:
    """Use no more of torch's threads than so many fields are worth: on a shared machine they wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, min(before, fields * math.prod(grid.shape) // _NODES_PER_THREAD)))
    try:
        yield
    finally:
        torch.set_num_threads(before)
