"""Judge settings on all sets of real images at once, and choose one without looking at the subject it is judged on.

    python scripts/benchmarks/accuracy.py --json accuracy.json \\
        --settings "long=optimiser.steps=[80,60,48]" "fine=optimiser.map_spacing=1,optimiser.steps=[80,60,48]"
    python scripts/benchmarks/accuracy.py --json accuracy.json --sets brain_t1_3d --shrink 2 --peers greedy ants_syn
    python scripts/benchmarks/accuracy.py --json accuracy.json --print

A setting is ``NAME=PART,PART``, a part being ``key=value`` or a preset, ``default`` if there is none; a preset's name
alone will do. Those of ``--settings`` may become the default; those of ``--beside``, which have another price in time,
and the tools of ``--peers`` are only shown. To judge a change of the package, run the script with the old code, and
then with the new one and ``--settings before=@CODE``, which takes runs of the old code, named in its first line, from
the file.

Every pair is registered from ``--jitters`` starts: the alignment is found once, and moved by a random tenth of a voxel
along each axis (normal, seeded by pair and jitter). Other tools, which align for themselves, get a moving image whose
origin is moved as far. For ours that would do nothing: the alignment begins at the centres of the images and takes a
shift of the file back to the last digit.

The choice is made as `held_out` says: one setting for all sets, for each pair by all pairs that show neither of its
subjects. The default would change if all pairs together prefer another setting and the held-out mean rises.

Runs are kept in the JSON file by pair, settings, jitter, device and the code of the package, and not done again, so a
long benchmark can be made in pieces. Labels are warped to the nearest voxel by one code for all.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import re
import zlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
import torch
from accuracy_tables import Run, Table, shown, verdict
from held_out import DEFAULT
from judge import quality, to_array
from machine import describe_machine
from pairs import SETS, Pair
from peer_tools import TOOLS
from peers import Book, Row, about, prepare, run_in_folder
from reading import images

import torchdeform as td
from torchdeform.core.transform import Affine
from torchdeform.io.images import read_optional
from torchdeform.pipeline.config import parse_override
from torchdeform.registration.placement import place

# Raise it when pairs, starts, painting or judgement change.
PROTOCOL = 1

# Standard deviation of a start, in voxels along each axis.
_JITTER = 0.1

CANDIDATES = (
    "long=optimiser.steps=[80,60,48]",
    "patient=optimiser.tolerance=0.01",
    "fine=optimiser.map_spacing=1",
    "smoother=metric.length_scale=[8,6,4]",
)
BESIDE = ("fast", "accurate")


@dataclass(frozen=True)
class Setting:
    """A candidate: a preset, what is changed of it, and the code that ran it before if it is not this one."""

    name: str
    preset: str = DEFAULT
    changes: dict[str, object] = field(default_factory=dict, hash=False)
    code: str = ""

    @classmethod
    def parse(cls, text: str) -> "Setting":
        """Read ``NAME=PART,PART`` or the name of a preset; commas in brackets part nothing."""
        name, equals, rest = text.partition("=")
        parts = re.split(r",(?![^\[{]*[\]}])", rest) if equals else [name]
        codes = [part[1:] for part in parts if part.startswith("@")]
        presets = [part for part in parts if "=" not in part and part[0] != "@"]
        changes = dict(parse_override(part) for part in parts if "=" in part)
        return cls(name, (presets or [DEFAULT])[-1], changes, "".join(codes))

    def load(self) -> td.RegistrationSettings:
        return td.load_settings(self.preset, None, self.changes)

    @property
    def words(self) -> str:
        """What is chosen, in words."""
        return ", ".join([self.preset, *(f"{key}={value}" for key, value in sorted(self.changes.items()))])

    @property
    def key(self) -> Row:
        """What tells its runs from those of others: all values, which older code may not know, and the code."""
        if self.code:
            return {"words": self.words, "code": self.code}
        values = json.dumps(asdict(self.load()), sort_keys=True, default=str)
        return {"settings": _digest(values.encode()), "code": _code()}


@dataclass(frozen=True)
class Task:
    """Runs of one setting on one pair from several starts; ``key`` is what they have in common in the file."""

    pair: Pair
    setting: Setting
    jitters: tuple[int, ...]
    key: Row = field(hash=False)


def _digest(*contents: bytes) -> str:
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content)
    return digest.hexdigest()[:12]


@lru_cache
def _code() -> str:
    """Return a digest of the package's code."""
    return _digest(*(path.read_bytes() for path in sorted(Path(td.__file__).parent.rglob("*.py"))))


@lru_cache(maxsize=1)
def _images(pair: Pair, shrink: float) -> tuple[td.Image, td.Image]:
    return images(pair, shrink)


def shift(pair: Pair, moving: td.Image, jitter: int) -> tuple[float, ...]:
    """Return how far a start is moved in the world, (x, y, z)."""
    drawn = np.random.default_rng([zlib.crc32(pair.name.encode()), jitter]).standard_normal(moving.grid.dim)
    return tuple((np.array(moving.direction) @ (_JITTER * drawn * moving.grid.spacing[::-1])).tolist())


def measure(task: Task) -> list[Row]:
    """Align a pair, register it from each start, and judge the maps."""
    key, pair = task.key | {"words": task.setting.words}, task.pair
    fixed, moving = (image.to(key["device"]) for image in _images(pair, key["shrink"]))
    masks = (read_optional(path) for path in (pair.fixed_mask, pair.moving_mask))
    known = td.Annotations(**_present(zip(("fixed_mask", "moving_mask"), masks, strict=True), key["device"]))
    began, rows = perf_counter(), []
    placed = place(fixed, moving, task.setting.load(), known)
    aligned = perf_counter() - began
    for jitter in task.jitters:
        there = placed.affine or Affine.identity(fixed.grid.dim)
        step = torch.tensor(shift(pair, moving, jitter)).to(there.offset)
        start = replace(placed, affine=Affine(there.matrix, there.offset + step))
        began = perf_counter()
        result = td.register(fixed, moving, placed.settings, annotations=known, affine=start)
        seconds = aligned + perf_counter() - began
        figures = {"seconds": seconds, "folds": float(result.diagnosis.folds)}
        rows.append(key | {"jitter": jitter} | figures | quality(pair, fixed.to("cpu"), _positions(fixed, result)))
    return rows


def _present(named: Iterable[tuple[str, td.Image | None]], device: str) -> dict[str, Any]:
    return {name: image.to(device) for name, image in named if image is not None}


def _positions(fixed: td.Image, result: td.RegistrationResult) -> np.ndarray:
    u = result.displacement.double().cpu()
    there = fixed.to_world(fixed.grid.points(dtype=torch.float64) + u)
    return to_array(there if result.affine is None else result.affine(there))


def attempt(task: Task) -> list[Row]:
    """As `measure`; a run that fails says why."""
    try:
        return measure(task)
    except (td.InputError, td.ComputationError, torch.OutOfMemoryError) as error:
        return [task.key | {"jitter": jitter, "failed": str(error)} for jitter in task.jitters]


def keys(options: argparse.Namespace) -> Iterator[Run]:
    """Yield what is asked for, pair by pair."""
    common = {"protocol": PROTOCOL, "shrink": options.shrink}
    ours = {s.name: {"tool": "torchdeform", "device": options.device} | s.key for s in options.all_settings}
    theirs = {name: {"tool": name, "settings": TOOLS[name].settings} for name in options.peers}
    for which in options.sets:
        for pair in SETS[which](options.data)[: options.pairs]:
            for name, key in (ours | theirs).items():
                yield which, pair, name, {"set": which, "pair": pair.name} | common | key


def missing(options: argparse.Namespace, book: Book) -> tuple[list[Task], list[tuple[Pair, str, Row]]]:
    """Return what is to be run of ours, and of others."""
    settings, tasks, others = {s.name: s for s in options.all_settings}, [], []
    for _, pair, name, key in keys(options):
        jitters = tuple(j for j in range(options.jitters) if not book.holds(key | {"jitter": j}))
        if name in settings and settings[name].code:
            continue  # only what is in the file already
        if jitters and name in settings:
            tasks.append(Task(pair, settings[name], jitters, key))
        elif name not in settings:
            others += [(pair, name, key | {"jitter": j}) for j in jitters]
    return tasks, others


def run(options: argparse.Namespace, book: Book) -> None:
    """Run what the book does not hold yet: ours in processes side by side, the others one by one."""
    tasks, others = missing(options, book)
    torch.set_num_threads(options.threads)
    if options.workers == 1:
        for task in tasks:
            _keep(book, attempt(task))
    else:
        start = {"mp_context": multiprocessing.get_context("spawn"), "initializer": torch.set_num_threads}
        with ProcessPoolExecutor(options.workers, initargs=(options.threads,), **start) as pool:
            for done in as_completed([pool.submit(attempt, task) for task in tasks]):
                _keep(book, done.result())
    for pair, name, key in others:
        _keep(book, [key | about(name) | _run_peer(name, pair, key, options)])


def _keep(book: Book, rows: Iterable[Row]) -> None:
    for row in rows:
        book.add({"machine": describe_machine()} | row)


def _run_peer(name: str, pair: Pair, key: Row, options: argparse.Namespace) -> Row:
    by = shift(pair, images(pair, options.shrink)[1], key["jitter"])
    with TemporaryDirectory() as folder:
        job = replace(prepare(pair, Path(folder), options.shrink, by), device=options.device, threads=options.threads)
        return run_in_folder(name, pair, job, options.limit, by)


def parse() -> argparse.Namespace:
    """Return the options; ``all_settings`` are the default, the candidates, and those beside."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", default=os.environ.get("TORCHDEFORM_DATA", "../shared/data"), type=Path)
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    parser.add_argument("--settings", nargs="*", default=list(CANDIDATES), help="candidates besides the default")
    parser.add_argument("--beside", nargs="*", default=list(BESIDE), help="settings that are only shown")
    parser.add_argument("--peers", nargs="*", default=[], choices=list(TOOLS), help="other tools")
    parser.add_argument("--jitters", type=int, default=3, help="starts of each pair")
    parser.add_argument("--shrink", type=float, default=1, help="how much coarser whole brains are made, 2 for trials")
    parser.add_argument("--pairs", type=int, help="at most so many of each set")
    parser.add_argument("--json", type=Path, help="file of all runs; runs that it has are not done again")
    parser.add_argument("--retry", action="store_true", help="run again what failed")
    parser.add_argument("--print", action="store_true", help="only print what the file has")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    parser.add_argument("--workers", type=int, default=1, help="pairs that are registered side by side")
    parser.add_argument("--threads", type=int, default=1, help="of each")
    parser.add_argument("--limit", type=float, default=3600, help="seconds that another tool may take")
    options = parser.parse_args()
    try:
        options.settings = [Setting.parse(text) for text in dict.fromkeys((DEFAULT, *options.settings))]
        others = [Setting.parse(text) for text in options.beside]
        names = [s.name for s in options.settings]
        options.all_settings = [*options.settings, *(s for s in others if s.name not in names)]
        for setting in options.all_settings:
            setting.load()
    except td.InputError as error:
        parser.error(str(error))
    return options


def main() -> None:
    """Run what is missing and print the tables."""
    options = parse()
    book = Book(options.json)
    if options.retry:
        book.rows = [row for row in book.rows if "failed" not in row]
    if not options.print:
        run(options, book)
    table = Table(keys(options), book.rows, options.jitters)
    print(
        f"code {_code()}, device {options.device}",
        shown(table),
        verdict(table, [s.name for s in options.settings]),
        *table.failed,
        sep="\n\n",
    )


if __name__ == "__main__":
    main()
