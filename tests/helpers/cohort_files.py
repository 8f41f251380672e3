"""What tests of cohorts compare: the files that a pair left."""

import math
from pathlib import Path

import torch

from torchdeform.cohort.plan import Job
from torchdeform.cohort.schema import Cohort, read_cohort
from torchdeform.core.flow import integrate
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.warp import warp
from torchdeform.io import write_image, write_labels


def results(job: Job) -> dict[str, bytes]:
    """The files that hold no times: HDF5 keeps when it was written; the displacement is the same as the transform."""
    return {path.name: path.read_bytes() for path in job.files.out.iterdir() if path.suffix in (".png", ".gz")}


GRID = Grid((32, 36))


COHORT = """
out: out
images:
  files: images/sub-{{subject}}.nii.gz
  labels: images/labels-{{subject}}.nii.gz
settings:
  {{align: none, optimiser: {{steps: [30, 10]}}, metric: {{length_scale: 12}}, similarity: {{window: 5}}}}
template: {{rounds: {rounds}, {more}}}
engine: {{workers: 1, threads: 1}}
"""


def write_images(folder: Path, count: int = 3) -> None:
    """Write warps of one picture, whose flows have the mean 0, and of its regions."""
    unit = GRID.points() / GRID.along(GRID.extent, GRID.points())
    fade = torch.sin(math.pi * unit).prod(1, keepdim=True)
    values = (torch.cos(9 * unit + 5 * unit.flip(1) ** 2).sum(1, keepdim=True) + 2) * 40 * (3 * fade).clamp(max=1)
    regions = (values > 80).float()
    for i in range(count):
        turn = 2 * math.pi * i / count
        v = 2.5 * fade * torch.tensor([math.cos(turn), math.sin(turn)]).view(1, 2, 1, 1)
        u = integrate(v, GRID)
        write_image(Image(warp(values, u, GRID), GRID), folder / f"sub-{i}.nii.gz")
        write_labels(Image(warp(regions, u, GRID, mode="nearest"), GRID), folder / f"labels-{i}.nii.gz")


def cohort(folder: Path, rounds: int = 2, more: str = "pose: reference") -> Cohort:
    path = folder / "template.yaml"
    path.write_text(COHORT.format(rounds=rounds, more=more), encoding="utf-8")
    return read_cohort(path)


BIDS = [
    f"sub-{subject}/ses-{session}/anat/sub-{subject}_ses-{session}_T1w.nii.gz"
    for subject in ("01", "02")
    for session in (1, 2, 10)
]
