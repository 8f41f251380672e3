"""Time and memory of the layers: prints the tables of the documentation.

    python scripts/benchmarks/layers.py [--parts head flow augmentation]

Times are CPU seconds of the process (GPU: elapsed), the best of three; compare the ratios. Peak memory is that of a
process of its own, less what it held before the first forward.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from torchdeform.core.grid import Grid  # noqa: E402
from torchdeform.nn import FlowIntegrator, JacobianCurlHead, RandomDeformation, SpatialTransformer  # noqa: E402

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
SHAPE, ITEMS, CHANNELS = (64, 64, 64), 4, (16, 32, 32)


class UNet(nn.Module):
    """A small U-Net, two convolutions a level, features as fine as the images."""

    def __init__(self, channels: tuple[int, ...] = CHANNELS) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            self.block(a, b, 1 if k == 0 else 2) for k, (a, b) in enumerate(zip((2, *channels), channels, strict=False))
        )
        coarse = list(channels[::-1])
        self.up = nn.ModuleList(self.block(a + b, b, 1) for a, b in pairwise(coarse))

    @staticmethod
    def block(before: int, after: int, stride: int) -> nn.Sequential:
        first, second = nn.Conv3d(before, after, 3, stride, 1), nn.Conv3d(after, after, 3, 1, 1)
        return nn.Sequential(first, nn.LeakyReLU(0.2), second, nn.LeakyReLU(0.2))

    def forward(self, pair: Tensor) -> Tensor:
        skips = []
        for down in self.down:
            pair = down(pair)
            skips.append(pair)
        features = skips.pop()
        for up in self.up:
            skip = skips.pop()
            features = nn.functional.interpolate(features, size=skip.shape[2:], mode="trilinear", align_corners=True)
            features = up(torch.cat([features, skip], dim=1))
        return features


class SquaringHead(nn.Module):
    """The usual diffeomorphic head: a convolution to a velocity, seven squarings."""

    def __init__(self, channels: int, grid: Grid) -> None:
        super().__init__()
        self.conv = nn.Conv3d(channels, grid.dim, 3, padding=1)
        self.flow = FlowIntegrator(grid, "squaring", steps=7)

    def forward(self, features: Tensor) -> Tensor:
        return self.flow(self.conv(features))


def seconds(run: Callable[[], object], repeats: int = 3) -> float:
    """Return the least time of a call, the first one left out."""
    run()
    clock = time.perf_counter if DEVICE.type == "cuda" else time.process_time
    times = []
    for _ in range(repeats):
        begin = clock()
        run()
        if DEVICE.type == "cuda":
            torch.cuda.synchronize()
        times.append(clock() - begin)
    return min(times)


def held(forward: Callable[[], Tensor]) -> float:
    """Return the megabytes that a forward keeps for its backward."""
    storages: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = forward()
    total = sum(storages.values()) / 2**20
    del result
    return total


def head_case(name: str) -> tuple[Callable[[], Tensor], nn.Module]:
    """Return a forward of network, head and warp of the moving image, and all of them."""
    torch.manual_seed(0)
    grid = Grid(SHAPE)
    head = JacobianCurlHead(CHANNELS[0], grid) if name == "JacobianCurlHead" else SquaringHead(CHANNELS[0], grid)
    nn.init.normal_(head.conv.weight, std=0.05)
    network = nn.Sequential(UNet(), head).to(DEVICE)
    warp, pair = SpatialTransformer(grid), torch.rand(ITEMS, 2, *SHAPE, device=DEVICE)
    return lambda: warp(pair[:, 1:], network(pair)).square().mean(), network


def flow_case(name: str) -> tuple[Callable[[], Tensor], nn.Module]:
    method, steps, adjoint = {
        "squaring, 7": ("squaring", 7, False),
        "rk4, 4 steps": ("rk4", 4, False),
        "rk4, 8 steps": ("rk4", 8, False),
        "rk4, 4 steps, adjoint": ("rk4", 4, True),
        "rk4, 8 steps, adjoint": ("rk4", 8, True),
    }[name]
    flow = FlowIntegrator(Grid(SHAPE), method, steps=steps, adjoint=adjoint)
    v = torch.randn(ITEMS, 3, *SHAPE, device=DEVICE).requires_grad_()
    return lambda: flow(v).square().mean(), flow


HEADS = ("SquaringHead", "JacobianCurlHead")
FLOWS = ("squaring, 7", "rk4, 4 steps", "rk4, 8 steps", "rk4, 4 steps, adjoint", "rk4, 8 steps, adjoint")
CASES = {"head": (head_case, HEADS), "flow": (flow_case, FLOWS)}


def peak(part: str, name: str) -> float:
    """Return the peak megabytes of one forward and backward, in a process of its own."""
    command = [sys.executable, __file__, "--peak", part, name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(done.stdout)


def print_peak(part: str, name: str) -> None:
    forward, _ = CASES[part][0](name)
    if DEVICE.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated() / 2**20
        forward().backward()
        print(torch.cuda.max_memory_allocated() / 2**20 - before)
        return
    before = high_water()
    forward().backward()
    print(high_water() - before)


def high_water() -> float:
    """Return the most megabytes that this process has held. (`getrusage` would count those of its parent.)"""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1]) / 1024


def compare(part: str) -> None:
    """Print time and memory of each case, and their ratio to the first."""
    make, names = CASES[part]
    print(f"\n{part}: {ITEMS} × {SHAPE}, float32, forward and backward, {DEVICE}\n")
    print("| case | s | ratio | kept for backward, MiB | peak, MiB | ratio |\n|---|---|---|---|---|---|")
    first: tuple[float, float] | None = None
    for name in names:
        forward, _ = make(name)
        row = seconds(lambda forward=forward: forward().backward()), peak(part, name)
        first = first or row
        ratios = [own / base for own, base in zip(row, first, strict=True)]
        cells = (f"{row[0]:.2f}", f"{ratios[0]:.2f}", f"{held(forward):.0f}", f"{row[1]:.0f}", f"{ratios[1]:.2f}")
        print("|", " | ".join((name, *cells)), "|", flush=True)


def augmentation() -> None:
    """Print the time of 32 images of 256², ours and kornia's."""
    import kornia

    image = torch.rand(32, 1, 256, 256, device=DEVICE)
    ours, theirs = RandomDeformation(Grid((256, 256))), kornia.augmentation.RandomElasticTransform(p=1.0)
    torch.manual_seed(0)
    times = {name: seconds(lambda run=run: run(image), 5) for name, run in (("kornia", theirs), ("ours", ours))}
    print(f"\naugmentation: 32 images of 256², {DEVICE}\n\n| case | s | ratio |\n|---|---|---|")
    for name, value in times.items():
        print(f"| {name} | {value:.3f} | {value / times['kornia']:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=["head", "flow", "augmentation"])
    parser.add_argument("--peak", nargs=2, metavar=("PART", "NAME"), help="print the peak memory of one case")
    arguments = parser.parse_args()
    if arguments.peak:
        print_peak(*arguments.peak)
        return
    for part in arguments.parts:
        augmentation() if part == "augmentation" else compare(part)


if __name__ == "__main__":
    main()
