"""Runs of small cohorts in processes of their own, and what must hold of the folder that they leave."""

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import SimpleITK as sitk

COHORT = """\
out: out
pairs: {{list: [{pairs}]}}
preset: fast
settings: {{align: none, similarity: ssd, metric: {{length_scale: 8}}, optimiser: {{steps: [2]}}}}
device: cpu
engine: {engine}
"""
_MARK = "TORCHDEFORM_COHORT_RUN"  # in the environment of every process of a run
ENGINES = {
    "one": "{workers: 1, threads: 1}",
    "local": "{workers: 2, threads: 1}",
    "dask": "{kind: dask, threads: 1, cluster: {kind: local, jobs: 2, memory: 2GB}}",
}


def write_cohort(folder: Path, names: str, engine: str = "local", size: int = 16, ending: str = "png") -> Path:
    """Write a cohort file with a pair for each letter, all of the same two images; return its path."""
    nodes = np.stack(np.meshgrid(*[np.linspace(-1, 1, size)] * 2, indexing="ij"))
    for name, shift in (("fixed", 0.0), ("moving", 0.1)):
        picture = (255 * np.exp(-3 * ((nodes - shift) ** 2).sum(0))).astype(np.uint8)
        sitk.WriteImage(sitk.GetImageFromArray(picture), str(folder / f"{name}.{ending}"))
    pairs = ", ".join(f"{{name: {name}, fixed: fixed.{ending}, moving: moving.{ending}}}" for name in names)
    path = folder / "cohort.yaml"
    path.write_text(COHORT.format(pairs=pairs, engine=ENGINES[engine]), encoding="utf-8")
    return path


def start(cohort: Path, *options: str, **how: object) -> "subprocess.Popen[str]":
    """Start ``torchdeform batch`` in a process of its own."""
    command = [sys.executable, "-m", "torchdeform.cli.main", "batch", str(cohort), *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = os.environ | {_MARK: str(cohort)}
    return subprocess.Popen(command, text=True, env=environment, **(pipes | how))  # type: ignore[call-overload]


def finish(cohort: Path, *options: str) -> tuple[int, str, str]:
    """Run ``torchdeform batch`` to its end; return its exit code and what it said on standard output and error."""
    process = start(cohort, *options)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


def journal(cohort: Path) -> list[dict[str, object]]:
    """Return the whole lines about pairs in the journal."""
    path = cohort.parent / "out" / "journal.jsonl"
    found = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return [line for line in found if "pair" in line]


def done(cohort: Path) -> list[str]:
    """Return the names in the journal, as often as they are there."""
    return [str(line["pair"]) for line in journal(cohort)]


def wait_for(cohort: Path, count: int, process: "subprocess.Popen[str]") -> None:
    """Wait until the journal has so many pairs, or the process has ended."""
    while len(done(cohort)) < count and process.poll() is None:
        time.sleep(0.02)


def summary(cohort: Path) -> dict[str, str]:
    """Return the status of every pair in the summary, where each must be once."""
    with (cohort.parent / "out" / "summary.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if len({row["name"] for row in rows}) != len(rows):
        raise ValueError(f"a pair is twice in the summary of {cohort}")
    return {row["name"]: row["status"] for row in rows}


def displacements(cohort: Path) -> dict[str, bytes]:
    """Return the displacement file of every pair, which holds no dates."""
    return {path.parent.name: path.read_bytes() for path in (cohort.parent / "out").glob("*/displacement.nii.gz")}


def faults(cohort: Path, names: str, right: bytes | None = None) -> list[str]:
    """Return what is wrong with the folder of a finished cohort: lost, doubled, different or left behind.

    Args:
        cohort: the file of the cohort.
        names: of its pairs.
        right: what every displacement file must hold; by default that of the first pair.
    """
    found, names_in_journal, fields = [], done(cohort), displacements(cohort)
    if sorted(set(names_in_journal)) != sorted(names) or sorted(fields) != sorted(names):
        found.append("lost")
    if len(names_in_journal) != len(set(names_in_journal)):
        found.append("doubled")
    if set(fields.values()) != {right or next(iter(fields.values()), b"")}:
        found.append("different")
    if summary(cohort) != dict.fromkeys(names, "done"):
        found.append("summary")
    if list(cohort.parent.rglob(".torchdeform-*")):
        found.append("left behind")
    return found


def living(cohort: Path, seconds: float) -> list[int]:
    """Return the processes of runs of a cohort that are still there after some seconds; Linux only."""
    end = time.monotonic() + seconds
    while (found := _started(cohort)) and time.monotonic() < end:
        time.sleep(0.1)
    return found


def _started(cohort: Path) -> list[int]:
    mark, found = f"{_MARK}={cohort}".encode(), []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (place / "environ").read_bytes().split(b"\0"):
                found.append(int(place.name))
        except OSError:
            continue
    return found
