"""Time and memory per voxel of `register` as images grow, each size in a process of its own.

    python scripts/benchmarks/scale.py [--quick] [--device cuda] [--preset default]

Two tensors of smooth random values are registered with one step on each level but the finest, which takes two, so
that the finest level decides. Seconds are those of `register`, with the inverse map and the certificate at its end;
"µs a step" is what one step of the finest level takes per voxel. Memory is the peak of the process (of the device with
CUDA) less what it held when everything was imported and a small pair had been registered, in float32 numbers per
voxel; the two images and the results are included. The limits: 40 floats a voxel, 12 GiB at 8192². Exits with 1
where one is broken.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

from machine import describe_machine, peak_bytes

ROOT = Path(__file__).resolve().parents[2]
_STEPS = (1, 1, 3)  # the first step of a level also looks at where it starts
_FLOATS, _BYTES, _LARGEST = 40, 12 * 2**30, (8192, 8192)
_QUICK = ((32, 32, 32), (48, 48, 48), (256, 256), (512, 512))
_SHAPES = (*((n,) * 3 for n in (64, 96, 128, 192, 256, 384)), *((n,) * 2 for n in (512, 1024, 2048, 4096, 8192)))
_NEEDED = 50 * 4  # bytes a voxel that must be free before a size is tried

Shape = tuple[int, ...]


def run(shape: Shape, device: str, preset: str, similarity: str | None) -> dict[str, float]:
    """Register one pair in this process, which is fresh, and return seconds and bytes."""
    from time import perf_counter

    import torch

    import torchdeform as td

    choices: dict[str, object] = {"optimiser.steps": list(_STEPS), "optimiser.tolerance": 0.0}
    if similarity:
        choices["similarity"] = similarity
    settings = td.load_settings(preset, overrides=choices)
    td.register(*_pair((24,) * len(shape), device), settings)
    before, start = _held(device), perf_counter()
    result = td.register(*_pair(shape, device), settings)
    if device == "cuda":
        torch.cuda.synchronize()
    total, finest = perf_counter() - start, result.levels[-1]
    peak = torch.cuda.max_memory_allocated() if device == "cuda" else peak_bytes()
    steps = max(1, len(finest.similarity) - 1)
    return {"seconds": total, "step": finest.seconds / steps, "bytes": peak - before, "process": peak}


def _pair(shape: Shape, device: str) -> tuple[Any, Any]:
    """Return two smooth random images, one shifted by a voxel."""
    import torch

    torch.manual_seed(0)
    coarse = torch.rand(1, 1, *(max(3, n // 8) for n in shape), device=device)
    mode = {2: "bilinear", 3: "trilinear"}[len(shape)]
    fixed = torch.nn.functional.interpolate(coarse, size=shape, mode=mode)
    return fixed, fixed.roll(1, 2)


def _held(device: str) -> int:
    """Return the bytes that are held now, so that what comes can be told from them."""
    import torch

    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    return peak_bytes()


def measure(shape: Shape, options: argparse.Namespace) -> dict[str, Any]:
    """Return what a fresh process finds for one size, or why it finds nothing."""
    from torchdeform.core.memory import available

    free = available(options.device)
    if free is not None and free < _NEEDED * math.prod(shape):
        return {"failed": f"not tried: {free / 2**30:.1f} GiB free"}
    order = json.dumps([shape, options.device, options.preset, options.similarity])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, __file__, "--one", order]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        return {"failed": f"exit {done.returncode}: {(done.stderr.strip().splitlines() or ['killed'])[-1][:120]}"}
    return json.loads(done.stdout.splitlines()[-1])


def row(shape: Shape, found: dict[str, Any]) -> str:
    """Return a line of the table."""
    size, voxels = "×".join(map(str, shape)), math.prod(shape)
    if "failed" in found:
        return f"| {size} | | | | | {found['failed']} |"
    cells = (
        f"{found['seconds']:.2f}",
        f"{1e6 * found['seconds'] / voxels:.2f}",
        f"{1e6 * found['step'] / voxels:.3f}",
        f"{found['process'] / 2**30:.2f}",
        f"{found['bytes'] / 4 / voxels:.1f}",
    )
    return f"| {size} | {' | '.join(cells)} |"


def complaints(shape: Shape, found: dict[str, Any]) -> Iterator[str]:
    """Yield the limits that are broken; small grids say little of memory per voxel."""
    if "failed" in found:
        return
    floats, size = found["bytes"] / 4 / math.prod(shape), "×".join(map(str, shape))
    if floats > _FLOATS and math.prod(shape) >= 2**21:
        yield f"{size}: {floats:.1f} floats a voxel, more than {_FLOATS}"
    if shape == _LARGEST and found["process"] > _BYTES:
        yield f"{size}: {found['process'] / 2**30:.1f} GiB, more than {_BYTES / 2**30:.0f}"


def parse() -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it works")
    parser.add_argument("--most", type=int, help="no more voxels than this")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--preset", default="default")
    parser.add_argument("--similarity", help="instead of the preset's")
    parser.add_argument("--one", type=json.loads, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Print the table."""
    options = parse()
    if options.one:
        shape, *how = options.one
        print(json.dumps(run(tuple(shape), *how)))
        return
    shapes = _QUICK if options.quick else _SHAPES
    shapes = [shape for shape in shapes if not options.most or math.prod(shape) <= options.most]
    threads = os.environ.get("OMP_NUM_THREADS", "as many as torch likes")
    how = f"{options.device}; preset {options.preset}; threads: {threads}"
    print(f"Made {date.today()} on {describe_machine()}, {how}.")
    print("\n| grid | seconds | µs a voxel | µs a step and voxel | GiB | floats a voxel |\n|---|---|---|---|---|---|")
    wrong: list[str] = []
    for shape in shapes:
        found = measure(shape, options)
        print(row(shape, found), flush=True)
        wrong += complaints(shape, found)
    if wrong:
        raise SystemExit("\n".join(["", *wrong]))


if __name__ == "__main__":
    main()
