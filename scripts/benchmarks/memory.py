"""Peak memory of registrations from files to files, and the estimate of `torchdeform.pipeline.memory.footprint`.

Each case runs in a process of its own: python scripts/benchmarks/memory.py [--quick]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]

# Dimension, voxels along an axis, channels, settings.
QUICK = (
    (2, 512, 1, "similarity=lncc"),
    (3, 64, 1, "similarity=lncc"),
    (3, 96, 1, "similarity=ssd", "start=discrete"),
    (3, 96, 1, "similarity=lncc", "symmetric=true"),
)
CASES = (
    *((2, n, 1, "similarity=lncc") for n in (512, 1024, 2048, 4096)),
    *((2, 1024, 1, f"similarity={s}") for s in ("ssd", "mi", "ngf", "mind")),
    (2, 1024, 3, "similarity=lncc"),
    *((3, n, 1, "similarity=lncc") for n in (64, 96, 128, 160, 256)),
    *((3, 96, 1, f"similarity={s}") for s in ("ssd", "ncc", "mi", "ngf", "mind")),
    (3, 96, 3, "similarity=lncc"),
    *((2, n, 1, "similarity=lncc", "start=discrete") for n in (512, 1024, 1536)),
    *((3, n, 1, "similarity=lncc", "start=discrete") for n in (64, 128)),
    (3, 96, 1, "similarity=ssd", "start=discrete"),
    (3, 96, 3, "similarity=lncc", "start=discrete"),
    *((d, n, 1, "similarity=ssd", "start=keypoints") for d, n in ((2, 1024), (3, 64), (3, 128))),
    *((2, n, 1, "similarity=lncc", "symmetric=true") for n in (512, 1024, 2048)),
    *((3, n, 1, "similarity=lncc", "symmetric=true") for n in (64, 96, 128, 160)),
    *((3, 96, 1, f"similarity={s}", "symmetric=true") for s in ("ssd", "mi", "ngf", "mind")),
    (3, 96, 3, "similarity=lncc", "symmetric=true"),
    *(
        (d, n, 1, "similarity=lncc", f"sliding={labels}")
        for d, n in ((2, 1024), (3, 96))
        for labels in ([1], [1, 2, 3])
    ),
    *((d, n, 1, "similarity=lncc", "tissues.1=rigid") for d, n in ((2, 512), (3, 96))),
)

Case = tuple[Any, ...]


def run(case: Case) -> int:
    """Register one case in this process and return the peak of its resident memory in bytes."""

    import torch

    from torchdeform.cli.main import main as register
    from torchdeform.core.grid import Grid
    from torchdeform.core.image import Image
    from torchdeform.core.memory import peak
    from torchdeform.io import write_image

    dim, n, channels, *settings = case
    torch.manual_seed(0)
    coarse = torch.rand(1, channels, *[n // 8] * dim)
    mode = {2: "bilinear", 3: "trilinear"}[dim]
    data = torch.nn.functional.interpolate(coarse, size=(n,) * dim, mode=mode)
    choices = ["--device=cpu", "--quiet", *(f"--set={setting}" for setting in ("optimiser.steps=[1, 1, 2]", *settings))]
    with tempfile.TemporaryDirectory() as folder:
        names = [Path(folder) / f"{name}.nrrd" for name in ("fixed", "moving")]
        for name, shift in zip(names, (0, 1), strict=True):
            write_image(Image(data.roll(shift, 2), Grid((n,) * dim)), name)
        del data
        if any(setting.startswith(("tissues", "sliding")) for setting in settings):
            write_image(Image(_bars(dim, n), Grid((n,) * dim)), f"{folder}/tissue.nrrd")
            choices.append(f"--tissue={folder}/tissue.nrrd")
        if register([*map(str, names), "--out", f"{folder}/out", *choices]):
            raise SystemExit(f"{case} could not be registered")
    return peak() or 0


def _bars(dim: int, n: int) -> Any:
    """Return labels 1 to 3 in bars."""
    import torch

    labels, part = torch.zeros(1, 1, *[n] * dim), n // 8
    for k in range(3):
        labels[(..., slice((2 * k + 1) * part, (2 * k + 2) * part), *[slice(2 * part, 6 * part)] * (dim - 1))] = k + 1
    return labels


def measure(case: Case) -> int:
    """Return the peak of a fresh process that registers one case, in bytes."""
    command = [sys.executable, str(Path(__file__)), "--case", json.dumps(case)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return int(done.stdout.split()[-1])


def estimated(case: Case) -> int:
    """Return what the package expects of a case, in bytes."""
    from torchdeform.core.grid import Grid
    from torchdeform.pipeline.config import load_settings, parse_override
    from torchdeform.pipeline.memory import footprint

    dim, n, channels, *settings = case
    return footprint(Grid((n,) * dim), channels, load_settings(overrides=dict(map(parse_override, settings))))


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
        print(f"{case!s:60} measured {found / 1e6:8.1f} MB  expected {expected / 1e6:8.1f} MB  {expected / found:.2f}")


if __name__ == "__main__":
    main()
