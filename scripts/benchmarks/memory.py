"""Peak memory of registrations from files to files, beside what `torchdeform.pipeline.memory.estimate` says.

Each case runs in a process of its own: python scripts/benchmarks/memory.py [--quick]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

# Dimension, voxels along an axis, channels, similarity, start.
QUICK = ((2, 512, 1, "lncc", "identity"), (3, 64, 1, "lncc", "identity"), (3, 96, 1, "ssd", "discrete"))
CASES = (
    *((2, n, 1, "lncc", "identity") for n in (512, 1024, 2048, 4096)),
    *((2, 1024, c, s, "identity") for c, s in ((1, "ssd"), (1, "mi"), (1, "ngf"), (1, "mind"), (3, "lncc"))),
    *((3, n, 1, "lncc", "identity") for n in (64, 96, 128, 160, 256)),
    *((3, 96, c, s, "identity") for c, s in ((1, "ssd"), (1, "ncc"), (1, "mi"), (1, "ngf"), (1, "mind"), (3, "lncc"))),
    *((2, n, 1, "lncc", "discrete") for n in (512, 1024, 1536)),
    *((3, n, c, s, "discrete") for n, c, s in ((64, 1, "lncc"), (96, 1, "ssd"), (96, 3, "lncc"), (128, 1, "lncc"))),
)

Case = tuple[int, int, int, str, str]


def run(case: Case) -> int:
    """Register one case in this process and return the peak of its resident memory in bytes."""

    import torch

    from torchdeform.cli.main import main as register
    from torchdeform.core.grid import Grid
    from torchdeform.core.image import Image
    from torchdeform.io import write_image

    dim, n, channels, similarity, start = case
    torch.manual_seed(0)
    coarse = torch.rand(1, channels, *[n // 8] * dim)
    mode = {2: "bilinear", 3: "trilinear"}[dim]
    data = torch.nn.functional.interpolate(coarse, size=(n,) * dim, mode=mode)
    settings = ("steps=[1, 1, 2]", f"similarity={similarity}", f"start={start}")
    choices = (*(word for setting in settings for word in ("--set", setting)), "--device", "cpu", "--quiet")
    with tempfile.TemporaryDirectory() as folder:
        names = [Path(folder) / f"{name}.nrrd" for name in ("fixed", "moving")]
        for name, shift in zip(names, (0, 1), strict=True):
            write_image(Image(data.roll(shift, 2), Grid((n,) * dim)), name)
        del data
        if register([*map(str, names), "--out", f"{folder}/out", *choices]):
            raise SystemExit(f"{case} could not be registered")
    return _peak()


def _peak() -> int:
    """Return the peak of this process in bytes; getrusage would count its parent's, whose memory it was forked from."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024


def measure(case: Case) -> int:
    """Return the peak of a fresh process that registers one case, in bytes."""
    command = [sys.executable, str(Path(__file__)), "--case", json.dumps(case)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return int(done.stdout.split()[-1])


def estimated(case: Case) -> int:
    """Return what the package expects of a case, in bytes."""
    from torchdeform.core.grid import Grid
    from torchdeform.pipeline.memory import estimate

    dim, n, channels, similarity, start = case
    return estimate(Grid((n,) * dim), channels=channels, similarity=similarity, start=start)


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two small cases only")
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.case:
        print(run(tuple(arguments.case)))
        return
    for case in QUICK if arguments.quick else CASES:
        found, expected = measure(case), estimated(case)
        print(f"{case!s:38} measured {found / 1e6:8.1f} MB  expected {expected / 1e6:8.1f} MB  {expected / found:.2f}")


if __name__ == "__main__":
    main()
