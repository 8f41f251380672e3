"""Cohorts under load and ill treatment, through ``torchdeform batch`` as a user runs it.

Usage: python scripts/benchmarks/cohort.py overhead|kill|dask|broken [--pairs N] [--folder DIR]

overhead  time per pair beyond its registration, and memory of the main process, on pairs of 64²
kill      the same, that process killed ten times at random moments, then resumed: compared with an undisturbed run
dask      two worker processes of a Dask cluster, one killed in the middle: compared with the local engine
broken    one pair in twenty broken, in ten ways: every other is done, each of these has its sentence

Exits with 1 if a check fails.
"""

import argparse
import csv
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from skimage.io import imsave

SIZE = 64
KILLS = 10
OVERHEAD, PARENT, GROWTH = 0.050, 300, 20  # seconds a pair; MiB of the parent; MiB that it may grow meanwhile
TIMES = ("seconds",)  # keys of a record that differ from run to run
LOCAL = "{kind: local, workers: 2, threads: 1}"
DASK = "{kind: dask, threads: 1, cluster: {kind: local, jobs: 2}}"

COHORT = """\
out: out
pairs: {{table: {{file: pairs.csv}}}}
preset: fast
settings: {{align: none, similarity: ssd, metric: {{length_scale: 8}}, optimiser: {{steps: [5, 3]}}}}
device: cpu
engine: {engine}
"""


def blob(row: float, column: float, width: float) -> NDArray[np.uint8]:
    """A smooth spot on a ramp, as bytes."""
    y, x = np.mgrid[:SIZE, :SIZE]
    spot = np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * width**2))
    return (200 * spot + 0.25 * (x + y)).astype(np.uint8)


def make_pairs(folder: Path, count: int) -> list[dict[str, str]]:
    """Write pairs of images and return their table."""
    images, chance = folder / "images", np.random.default_rng(0)
    images.mkdir(parents=True)
    rows = []
    for number in range(count):
        centre, width = chance.uniform(26, 38, 2), chance.uniform(6, 10)
        shift = chance.uniform(-2, 2, 2)
        names = [f"images/{number:04d}_{side}.png" for side in ("fixed", "moving")]
        for name, place in zip(names, (centre, centre + shift), strict=True):
            imsave(folder / name, blob(place[0], place[1], width), check_contrast=False)
        rows.append({"name": f"pair-{number:04d}", "fixed": names[0], "moving": names[1]})
    return rows


def write_cohort(folder: Path, rows: Sequence[dict[str, str]], engine: str) -> Path:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with (folder / "pairs.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)
    path = folder / "cohort.yaml"
    path.write_text(COHORT.format(engine=engine), encoding="utf-8")
    return path


def start(cohort: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "torchdeform.cli.main", "batch", str(cohort)]
    log = (cohort.parent / "batch.log").open("ab")
    return subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)


def resident(pid: int) -> int:
    """Memory of a process in MiB, 0 if it is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) // 1024 for line in lines if line.startswith("VmRSS")), 0)


def watch(process: subprocess.Popen[bytes]) -> list[int]:
    """Wait for a process and return its memory, twice a second."""
    seen = []
    while process.poll() is None:
        seen.append(resident(process.pid))
        time.sleep(0.5)
    return seen


def summary(out: Path) -> list[dict[str, str]]:
    with (out / "summary.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def entries(out: Path) -> list[dict[str, Any]]:
    """The journal's whole lines about pairs."""
    found = []
    for line in (out / "journal.jsonl").read_text(encoding="utf-8").splitlines():
        try:
            found.append(json.loads(line))
        except ValueError:
            continue
    return [entry for entry in found if "pair" in entry]


def outputs(out: Path) -> dict[str, str]:
    """Hashes of all results but the page, without what tells the time."""
    paths = sorted(path for path in out.glob("pair-*/*") if path.suffix != ".html")
    return {str(path.relative_to(out)): hashlib.sha256(content(path)).hexdigest() for path in paths}


def content(path: Path) -> bytes:
    """The content of a file; records without seconds, HDF5 without the times of writing that it keeps."""
    if path.suffix == ".json":
        return json.dumps(timeless(json.loads(path.read_bytes())), sort_keys=True).encode()
    if path.suffix == ".h5":
        transform = sitk.ReadTransform(str(path))
        return np.array([*transform.GetParameters(), *transform.GetFixedParameters()]).tobytes()
    return path.read_bytes()


def timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: timeless(item) for key, item in value.items() if key not in TIMES}
    return [timeless(item) for item in value] if isinstance(value, list) else value


def holds(what: str, true: bool) -> bool:
    print(f"{'ok  ' if true else 'FAIL'} {what}")
    return true


def all_done(out: Path, count: int) -> bool:
    rows = summary(out)
    names = Counter(row["name"] for row in rows)
    statuses = Counter(row["status"] for row in rows)
    once = len(names) == len(rows) == count
    return holds(
        f"{count} pairs, each once in the summary, all done: {dict(statuses)}", once and statuses["done"] == count
    )


def same(out: Path, undisturbed: Path) -> bool:
    one, other = outputs(out), outputs(undisturbed)
    differing = [name for name in one.keys() | other.keys() if one.get(name) != other.get(name)]
    detail = f", but {len(differing)} differ, as {sorted(differing)[0]}" if differing else ""
    return holds(f"{len(other)} files as those of the undisturbed run{detail}", not differing)


def undisturbed(folder: Path, count: int) -> Path:
    """Run a cohort to its end and put its results aside; an earlier one in this folder is taken."""
    aside = folder / "undisturbed"
    if not aside.is_dir():
        if not (folder / "images").is_dir():
            write_cohort(folder, make_pairs(folder, count), LOCAL)
        start(folder / "cohort.yaml").wait()
        (folder / "out").rename(aside)
    return aside


def overhead(folder: Path, count: int) -> bool:
    cohort = write_cohort(folder, make_pairs(folder, count), LOCAL)
    begun = time.perf_counter()
    memory = watch(start(cohort))
    wall = time.perf_counter() - begun
    busy = sum(float(row["seconds"]) for row in summary(folder / "out"))
    beyond = (2 * wall - busy) / count
    third = len(memory) // 3
    early, late = (max(part) for part in (memory[third : 2 * third], memory[2 * third :]))
    good = [
        all_done(folder / "out", count),
        holds(
            f"{wall:.0f} s on two workers, {busy / count:.3f} s a pair, {1e3 * beyond:.1f} ms beyond", beyond < OVERHEAD
        ),
        holds(f"parent: {max(memory)} MiB at most", max(memory) < PARENT),
        holds(f"parent: {early} MiB in the second third, {late} in the last", late - early < GROWTH),
    ]
    (folder / "out").rename(folder / "undisturbed")
    return all(good)


def kill(folder: Path, count: int) -> bool:
    aside, chance = undisturbed(folder, count), random.Random(0)
    events = [json.loads(line) for line in (aside / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    mean = events[-1]["elapsed"] / (KILLS + 1)
    for number in range(KILLS):
        process = start(folder / "cohort.yaml")
        time.sleep(chance.uniform(0, 2 * mean))
        process.send_signal(signal.SIGKILL)
        process.wait()
        journal = folder / "out" / "journal.jsonl"
        known = len({entry["pair"] for entry in entries(folder / "out")}) if journal.exists() else 0
        print(f"kill {number + 1}: {known} pairs done")
    code = start(folder / "cohort.yaml").wait()
    lines = Counter(entry["pair"] for entry in entries(folder / "out"))
    good = [
        holds("exit code 0 after all", code == 0),
        all_done(folder / "out", count),
        holds(f"no pair registered again once it was done ({len(lines)} lines)", max(lines.values()) == 1),
        same(folder / "out", aside),
        holds("nothing left of what was begun", not list((folder / "out").rglob(".torchdeform-*"))),
    ]
    return all(good)


def children(pid: int) -> Iterator[int]:
    """Processes that a process started, and is told of by their parent."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            yield int(status.parent.name)


def dask_workers(pid: int) -> list[int]:
    found = []
    for child in children(pid):
        command = Path(f"/proc/{child}/cmdline").read_bytes()
        if b"spawn_main" in command:
            found.append(child)
    return found


def dask(folder: Path, count: int) -> bool:
    aside = undisturbed(folder, count)
    cohort = folder / "cohort.yaml"
    cohort.write_text(COHORT.format(engine=DASK), encoding="utf-8")
    process = start(cohort)
    journal = folder / "out" / "journal.jsonl"
    while process.poll() is None and (not journal.exists() or len(entries(folder / "out")) < count // 2):
        time.sleep(0.2)
    victims = dask_workers(process.pid)
    os.kill(victims[0], signal.SIGKILL)
    code = process.wait()
    good = [
        holds(f"one of {len(victims)} worker processes killed in the middle, exit code {code}", code == 0),
        all_done(folder / "out", count),
        same(folder / "out", aside),
    ]
    return all(good)


def break_table(folder: Path, rows: list[dict[str, str]]) -> None:
    ramp = np.arange(SIZE**3, dtype=np.float32).reshape(SIZE, SIZE, SIZE)

    def volume(path: Path) -> None:
        sitk.WriteImage(sitk.GetImageFromArray(ramp), str(path))

    def not_a_number(path: Path) -> None:
        sitk.WriteImage(sitk.GetImageFromArray(np.where(ramp[0] == 5, np.nan, ramp[0])), str(path))

    def series(path: Path) -> None:
        slices = [sitk.GetImageFromArray(ramp[:8, :16, :16]) for _ in range(3)]
        sitk.WriteImage(sitk.JoinSeries(slices), str(path))

    def tiny(path: Path) -> None:
        imsave(path, np.full((3, 3), 7, np.uint8), check_contrast=False)

    def torn(path: Path) -> None:
        imsave(path, np.random.default_rng(0).integers(0, 255, (SIZE, SIZE), np.uint8), check_contrast=False)
        path.write_bytes(path.read_bytes()[:1500])

    kinds: list[tuple[str, str, Callable[[Path], object] | None]] = [
        ("fixed", "missing.png", None),
        ("fixed", "empty.png", lambda path: path.write_bytes(b"")),
        ("moving", "torn.png", torn),
        ("moving", "text.png", lambda path: path.write_text("no image\n" * 50)),
        ("moving", "volume.nii.gz", volume),
        ("fixed", "nan.nii", not_a_number),
        ("fixed", "series.nii.gz", series),
        ("moving", "folder", lambda path: path.mkdir()),
        ("fixed", "tiny.png", tiny),
        ("fixed_mask", "black.png", lambda path: imsave(path, np.zeros((SIZE, SIZE), np.uint8), check_contrast=False)),
    ]
    step = len(rows) // (len(rows) // 20)
    for number, row in enumerate(rows[::step]):
        column, name, make = kinds[number % len(kinds)]
        path = folder / "images" / f"{number}_{name}"
        row[column] = f"images/{path.name}"
        if make is not None:
            make(path)


def broken(folder: Path, count: int) -> bool:
    rows = make_pairs(folder, count)
    whole = [dict(row) for row in rows]
    break_table(folder, rows)
    bad = {row["name"] for row, good in zip(rows, whole, strict=True) if row != good}
    code = start(write_cohort(folder, rows, LOCAL)).wait()
    statuses = {row["name"]: row["status"] for row in summary(folder / "out")}
    with (folder / "out" / "failures.csv").open(encoding="utf-8", newline="") as file:
        sentences = {row["name"]: row["sentence"] for row in csv.DictReader(file)}
    for name, sentence in sentences.items():
        print(f"     {name}: {sentence}")
    good = [
        holds(f"exit code 1, got {code}", code == 1),
        holds(f"{count - len(bad)} good ones done", all((statuses[n] == "done") == (n not in bad) for n in statuses)),
        holds(f"{len(bad)} broken ones, each with its sentence", sentences.keys() == bad and all(sentences.values())),
    ]
    return all(good)


CASES = {"overhead": (overhead, 1000), "kill": (kill, 1000), "dask": (dask, 200), "broken": (broken, 200)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--pairs", type=int)
    parser.add_argument("--folder", type=Path, help="kept afterwards; kill and dask take over what overhead left in it")
    options = parser.parse_args()
    measure, count = CASES[options.case]
    folder = options.folder or Path(mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return 0 if measure(folder, options.pairs or count) else 1
    finally:
        if options.folder is None:
            shutil.rmtree(folder)


if __name__ == "__main__":
    sys.exit(main())
