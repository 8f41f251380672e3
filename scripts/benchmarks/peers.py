"""Register pairs of real images with this project and with other tools, from the raw files, and judge the maps alike.

    python scripts/benchmarks/peers.py --sets mouse_brain_3d --tools torchdeform greedy ants_syn --json peers.json

Each run is a process of its own on two cores with two threads. The tools take turns pair by pair, so that changes
of the machine's speed affect all alike. Runs that are in the JSON file are not done again, so a long benchmark can be
made in pieces, and printed without running anything (``--print``).

Clock. Every file is first made an image of one channel of float32, without compression (colours as their luminance),
the same files for all. *Start-up* runs from the start of the interpreter until the tool is imported. *Seconds* run from
then until its map lies on disk in the tool's own form: files read, images aligned, map found and written. Nobody warps
images or labels, draws, or judges within them; ours finds the inverse and the certificate too, because `register`
always does. *GiB* is the peak of the process at that moment.

Judgement. A map is read off as positions of the fixed voxels, by the tool's own resampler or from the field it wrote
(see `peer_tools`). Labels are warped by one nearest-neighbour code for all. Folds are those of the whole map.
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from datetime import date
from importlib import import_module, metadata
from pathlib import Path
from statistics import mean, median
from tempfile import TemporaryDirectory
from typing import Any

from machine import describe_machine, peak_bytes
from pairs import SETS, WHOLE_BRAINS, Pair
from peer_tools import TOOLS, Job, limit_threads, load

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT))
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS")

Row = dict[str, Any]

# What a `Pair` or a `Job` holds that is a text and no path.
_PLAIN = ("name", "device")

# What the table shows of a figure over the pairs.
_COLUMNS = {
    "Dice": ("dice", lambda v: f"{median(v):.4f} ({mean(v):.4f})"),
    "all labels as one": ("union", lambda v: f"{median(v):.4f} ({mean(v):.4f})"),
    "landmarks, mean": ("landmark_mean", lambda v: f"{median(v):.2f} ({mean(v):.2f})"),
    "landmarks, median": ("landmark_median", lambda v: f"{median(v):.2f} ({mean(v):.2f})"),
    "folds": ("folds", lambda v: f"{max(v):.0f}"),
    "central folds": ("central_folds", lambda v: f"{max(v):.0f}"),
    "sd log J": ("log_det_std", lambda v: f"{median(v):.3f}"),
    "seconds": ("seconds", lambda v: f"{median(v):.1f}"),
    "start-up": ("startup", lambda v: f"{median(v):.1f}"),
    "GiB": ("GiB", lambda v: f"{max(v):.2f}"),
}
_EACH = (("dice", ".4f"), ("landmark_mean", ".2f"))


def prepare(pair: Pair, folder: Path, shrink: float = 1, shift: Sequence[float] = ()) -> Job:
    """Write the images of a pair, and its masks, as every tool gets them.

    Args:
        pair: the files.
        folder: where to.
        shrink: see `reading.images`.
        shift: how far the moving image is moved in the world, (x, y, z).
    """
    from reading import images

    import torchdeform as td
    from torchdeform.io.images import read_labels, write_labels

    files: dict[str, Any] = {}
    for side, image, by in zip(("fixed", "moving"), images(pair, shrink), ((), shift), strict=True):
        files[side] = folder / f"{side}.nii"
        td.write_image(_moved(image, by), files[side])
        if source := getattr(pair, f"{side}_mask"):
            mask = read_labels(source)
            files[f"{side}_mask"] = folder / f"{side}_mask.nii"
            counts = replace(mask, data=(mask.data != 0).float(), pixel_type="uint8")
            write_labels(_moved(counts, by), files[f"{side}_mask"])
    return Job(files.pop("fixed"), files.pop("moving"), folder, **files)


def _moved(image: Any, by: Sequence[float]) -> Any:
    """Return an image elsewhere in the world."""
    return replace(image, origin=tuple(x + d for x, d in zip(image.origin, by, strict=True))) if by else image


def run_here(order: Row) -> Row:
    """Register a pair in this process, which is fresh, and judge the map; ``order`` as `run_apart` writes it."""
    tool, job = TOOLS[order["tool"]], Job(**_paths(order["job"]))
    limit_threads(job.threads)
    try:
        load(tool)
    except ImportError as error:
        return {"failed": f"not installed: {error}"}
    startup, start = time.time() - order["started"], time.perf_counter()
    mapped = tool.register(job)
    figures = {"startup": startup, "seconds": time.perf_counter() - start, "GiB": peak_bytes() / 2**30}
    from judge import judge

    import torchdeform as td

    positions = mapped()
    positions -= order.get("shift") or [0.0] * positions.shape[-1]
    return figures | judge(Pair(**_paths(order["pair"])), td.read_image(job.fixed), positions)


def _paths(files: Row) -> Row:
    """Return the arguments of a `Pair` or a `Job` with their paths as such again."""
    return {key: Path(value) if isinstance(value, str) and key not in _PLAIN else value for key, value in files.items()}


def run_apart(name: str, pair: Pair, job: Job, limit: float, shift: Sequence[float] = ()) -> Row:
    """Run one tool on one pair, whose moving image `prepare` has shifted, in a process of its own."""
    order, answer = job.folder / "order.json", job.folder / "answer.json"
    content = {"tool": name, "pair": asdict(pair), "job": asdict(job), "started": time.time(), "shift": list(shift)}
    order.write_text(json.dumps(content, default=str), encoding="utf-8")
    command = [sys.executable, __file__, "--one", str(order), str(answer)]
    environment = os.environ | _environment(job)
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, errors="replace", check=False, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return {"failed": f"not done after {limit:.0f} s"}
    if answer.exists():
        return json.loads(answer.read_text(encoding="utf-8"))
    last = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
    return {"failed": f"exit {done.returncode}: {last[:200]}"}


def _environment(job: Job) -> dict[str, str]:
    """Return the variables that a tool's process is given."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    return dict.fromkeys(_THREADS, str(job.threads)) | {"PYTHONPATH": path, "TMPDIR": str(job.folder)}


def version(package: str) -> str:
    """Return the version of a distribution; of ours, which need not be installed, the commit too."""
    if package == "torchdeform":
        return f"{import_module(package).__version__} {_commit()}".strip()
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _commit() -> str:
    """Return the commit of this folder, with a mark if files differ from it; nothing where git does not know it."""
    if shutil.which("git") is None:
        return ""
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


class Book:
    """The runs so far, in a JSON file if one is given.

    Args:
        file: read if it exists, written after every run.
    """

    def __init__(self, file: Path | None) -> None:
        self.file = file
        self.rows: list[Row] = json.loads(file.read_text(encoding="utf-8")) if file and file.exists() else []

    def drop(self, tools: Sequence[str]) -> None:
        """Forget the runs of these tools."""
        self.rows = [row for row in self.rows if row["tool"] not in tools]

    def holds(self, key: Row) -> bool:
        return any(key.items() <= row.items() for row in self.rows)

    def add(self, row: Row) -> None:
        self.rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
        if self.file:
            fresh = self.file.with_suffix(".part")
            fresh.write_text(json.dumps(self.rows, indent=1), encoding="utf-8")
            fresh.replace(self.file)


def run_all(options: argparse.Namespace, book: Book) -> None:
    """Run what the book does not hold yet."""
    for which in options.sets:
        for pair in SETS[which](options.data)[: options.pairs]:
            todo = {name: key for name, key in _keys(options, which, pair) if not book.holds(key)}
            if not todo:
                continue
            with TemporaryDirectory() as folder:
                job = replace(prepare(pair, Path(folder)), device=options.device, threads=options.threads)
                for name, key in todo.items():
                    book.add(key | about(name) | run_in_folder(name, pair, job, options.limit))


def _keys(options: argparse.Namespace, which: str, pair: Pair) -> Iterator[tuple[str, Row]]:
    for name in options.tools:
        how = {"device": options.device, "threads": options.threads}
        yield name, {"set": which, "pair": pair.name, "tool": name} | how


def about(name: str) -> Row:
    """Return what ran, where and when."""
    tool = TOOLS[name]
    what = {"package": tool.package, "version": version(tool.package), "settings": tool.settings}
    return what | {"date": str(date.today()), "machine": describe_machine()}


def run_in_folder(name: str, pair: Pair, job: Job, limit: float, shift: Sequence[float] = ()) -> Row:
    """Run a tool in a folder of its own."""
    with TemporaryDirectory() as folder:
        return run_apart(name, pair, replace(job, folder=Path(folder)), limit, shift)


def table(rows: Sequence[Row]) -> str:
    """Return one line for each set and tool, as Markdown."""
    lines = ["| set | tool | pairs | " + " | ".join(_COLUMNS) + " | each pair |", "|---" * (len(_COLUMNS) + 4) + "|"]
    for which, tool in dict.fromkeys((row["set"], row["tool"]) for row in rows):
        own = [row for row in rows if (row["set"], row["tool"]) == (which, tool)]
        good = [row for row in own if "failed" not in row]
        cells = [_cell(good, key, show) for key, show in _COLUMNS.values()]
        lines.append(f"| {which} | {tool} | {len(good)} | " + " | ".join([*cells, _each(own)]) + " |")
    return "\n".join(lines)


def _cell(rows: Sequence[Row], key: str, show: Any) -> str:
    values = [row[key] for row in rows if key in row]
    return show(values) if values else ""


def _each(rows: Sequence[Row]) -> str:
    """Return the main figure of every pair, or why there is none."""
    told = []
    for row in rows:
        told += [format(row[key], how) for key, how in _EACH if key in row] or [row.get("failed", "")]
    return ", ".join(dict.fromkeys(told) if all("failed" in row for row in rows) else told)


def circumstances(rows: Sequence[Row]) -> str:
    """Return when, where, with what and how the runs were made, as Markdown."""
    days = sorted({row["date"] for row in rows})
    how = sorted({f"{row['threads']} threads, {row['device']}" for row in rows})
    lines = [f"Made {' to '.join(dict.fromkeys((days[0], days[-1])))} on {'; '.join(_unique(rows, 'machine'))};"]
    lines += [f"{'; '.join(how)}. Quality: median over the pairs (mean); folds, memory: the largest; time: median.", ""]
    for tool in _unique(rows, "tool"):
        row = next(row for row in reversed(rows) if row["tool"] == tool)
        lines.append(f"* {tool}: {row['package']} {row['version']}; {row['settings']}.")
    return "\n".join(lines)


def _unique(rows: Sequence[Row], key: str) -> list[str]:
    return list(dict.fromkeys(row[key] for row in rows))


def parse() -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", default=os.environ.get("TORCHDEFORM_DATA", "../shared/data"), type=Path)
    small = [name for name in SETS if name not in WHOLE_BRAINS]
    parser.add_argument("--sets", nargs="+", default=small, choices=list(SETS))
    parser.add_argument("--tools", nargs="+", default=list(TOOLS), choices=list(TOOLS))
    parser.add_argument("--pairs", type=int, help="at most so many of each set")
    parser.add_argument("--json", type=Path, help="file of all runs; runs that it has are not done again")
    parser.add_argument("--again", nargs="+", default=[], choices=list(TOOLS), help="run these again all the same")
    parser.add_argument("--retry", action="store_true", help="run again what failed")
    parser.add_argument("--print", action="store_true", help="only print the table of the runs in the file")
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"), help="for the tools that can choose")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--limit", type=float, default=3600, help="seconds a run may take")
    parser.add_argument("--one", nargs=2, type=Path, help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Run all and print the table."""
    options = parse()
    if options.one:
        order, answer = options.one
        figures = run_here(json.loads(order.read_text(encoding="utf-8")))
        answer.write_text(json.dumps(figures), encoding="utf-8")
        return
    book = Book(options.json)
    book.drop(options.again)
    if options.retry:
        book.rows = [row for row in book.rows if "failed" not in row]
    if not options.print:
        run_all(options, book)
    command = shlex.join(["python", *sys.argv])
    print(f"`{command}`\n\n{circumstances(book.rows)}\n\n{table(book.rows)}" if book.rows else "nothing was run")


if __name__ == "__main__":
    main()
