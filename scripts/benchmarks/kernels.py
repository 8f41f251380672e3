"""Bytes per second of the main kernels of a registration, compared with a plain copy of the displacement field.

    python scripts/benchmarks/kernels.py [--quick] [--threads N]

Every kernel is charged with the least that any implementation must move: each input read once, each output written
once, float32. The copy reads and writes the displacement field. "Of copy" is therefore the share of the memory's speed
that a kernel reaches, and "copies" how many such copies it takes. Median over repetitions, after two to warm up; where
there is a CUDA device it is measured too.
"""

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import date
from functools import partial
from statistics import median
from time import perf_counter

import torch
from machine import describe_machine
from torch import Tensor

import torchdeform as td
from torchdeform.core.derivatives import derivative
from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.fem import Weights
from torchdeform.fem.fast_transform import FastTransform
from torchdeform.fem.system import DivCurlSystem
from torchdeform.metrics.similarity import make_similarity

_SHAPES = ((128, 128, 128), (1024, 1024))
_QUICK = ((32, 32, 32), (128, 128))
_FLOAT = 4  # bytes
_LENGTH = 12.0  # √(w_div / w_zero) in voxels


@dataclass(frozen=True)
class Kernel:
    """Something to time.

    Attributes:
        name: what it does.
        run: does it.
        fields: scalar fields that must be read and written.
    """

    name: str
    run: Callable[[], object]
    fields: int


def kernels(grid: td.Grid, device: str) -> Iterator[Kernel]:
    """Yield the copy, and then the kernels, on tensors of a smooth random map and images."""
    u, load = (_smooth(grid, grid.dim, device) for _ in range(2))
    fixed, moving = (_smooth(grid, 1, device) for _ in range(2))
    target, dim = torch.empty_like(u), grid.dim
    yield Kernel("copy of the displacement", lambda: target.copy_(u), 2 * dim)
    for name, curl in (("div-curl solve, equal weights", 1.0), ("div-curl solve, w_curl = 3 w_div", 3.0)):
        system = DivCurlSystem(grid, Weights(div=1.0, curl=curl, zero=_LENGTH**-2), "slip")
        yield Kernel(name, partial(FastTransform().init(system, load), load), 2 * dim)
    yield Kernel("warp of one channel", lambda: td.warp(moving, u, grid), dim + 2)
    similarity = make_similarity("lncc", fixed, 9, grid=grid)
    yield Kernel("LNCC and its derivative, window 9", lambda: similarity.evaluate(moving), 3)
    yield Kernel("one-sided determinant", lambda: one_sided_determinant(u, grid), dim + 1)
    yield Kernel("composition of two maps", lambda: td.compose(u, load, grid), 3 * dim)
    for by in ("shifts", "convolution"):
        differences = partial(derivative, moving, grid, dim - 1, by=by)
        yield Kernel(f"differences of one channel by {by}", differences, 2)


def _smooth(grid: td.Grid, channels: int, device: str) -> Tensor:
    """Return a smooth random field with values from −1 to 1."""
    coarse = 2 * torch.rand(1, channels, *(max(4, n // 16) for n in grid.shape)) - 1
    mode = {2: "bilinear", 3: "trilinear"}[grid.dim]
    return torch.nn.functional.interpolate(coarse, size=grid.shape, mode=mode).to(device).contiguous()


def seconds(run: Callable[[], object], device: str, budget: float) -> float:
    """Return the median time of a run, from as many as fit into so many seconds, three at least."""
    times: list[float] = []
    for _ in range(2):
        run()
    while len(times) < 3 or (sum(times) < budget and len(times) < 200):
        _wait(device)
        start = perf_counter()
        run()
        _wait(device)
        times.append(perf_counter() - start)
    return median(times)


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def lines(shape: tuple[int, ...], device: str, budget: float) -> Iterator[str]:
    """Yield the rows of the table for one grid on one device."""
    torch.manual_seed(0)
    grid, copy = td.Grid(shape), 0.0
    for kernel in kernels(grid, device):
        with torch.inference_mode():
            time = seconds(kernel.run, device, budget)
        copy = copy or time
        moved = kernel.fields * math.prod(shape) * _FLOAT
        share = moved / time / (2 * grid.dim * math.prod(shape) * _FLOAT / copy)
        size = "×".join(map(str, shape))
        figures = f"{1e3 * time:.3g} | {moved / time / 1e9:.3g} | {share:.1%} | {time / copy:.3g}"
        yield f"| {device} | {size} | {kernel.name} | {figures} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small grids, to see that it works")
    parser.add_argument("--threads", type=int, help="of torch on the CPU; what it chooses itself by default")
    options = parser.parse_args()
    if options.threads:
        torch.set_num_threads(options.threads)
    where = [describe_machine(), f"torch {torch.__version__}", f"{torch.get_num_threads()} threads"]
    devices = ["cpu"]
    if torch.cuda.is_available():
        devices.append("cuda")
        where.append(torch.cuda.get_device_name())
    print(f"Made {date.today()} on {', '.join(where)}.\n")
    print("| device | grid | kernel | ms | GB/s | of copy | copies |\n|---|---|---|---|---|---|---|")
    for device in devices:
        for shape in _QUICK if options.quick else _SHAPES:
            for line in lines(shape, device, 0.1 if options.quick else 2.0):
                print(line, flush=True)


if __name__ == "__main__":
    main()
