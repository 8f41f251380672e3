"""Thousands of damaged files of every format: what becomes of each, and how to make those again that went wrong.

python scripts/benchmarks/fuzz.py [--count 1000] [--seed 0] [--only NAME ...] [--index N] [--jobs N] [--keep FOLDER]

Every file is read by a process that may take 4 GB and 10 seconds. One row per format counts its files: read, refused in
one sentence, any other error, a signal that ended the process, no end, numbers that are not finite, and more than 1 GB
of memory. The exit code is 1 if any but the first two occurred.
"""

import argparse
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random

from fuzz_attempt import Trial, attempt, prepare
from fuzz_files import FORMATS, Numbers
from fuzz_mutations import mutant

from torchdeform.core.memory import readable
from torchdeform.core.worker import TimeLimit, Worker, WorkerLost

OUTCOMES = ("ok", "typed", "untyped", "signal", "hang", "NaN", ">1 GB")
SOUND = ("ok", "typed")

_SHOWN, _WIDEST = 8, 160  # mutants of a kind, and characters of its sentence, that are printed

SECONDS = 10.0  # that a file may take
_FIRST = 300.0  # seconds in which a process imports the libraries


class Reader:
    """A process that reads one file after the other, and is started again when it was lost."""

    def __init__(self) -> None:
        self._worker, self._ready = Worker({"OMP_NUM_THREADS": "1"}), False

    def __call__(self, read: Callable[[Path], Numbers], path: Path) -> Trial:
        """Return what becomes of a file."""
        if not self._ready:
            self._worker.call(prepare, timeout=_FIRST)
        try:
            found = self._worker.call(attempt, read, path, timeout=SECONDS)
        except TimeLimit:
            found = Trial("hang", f"more than {SECONDS:g} s")
        except WorkerLost as error:
            found = Trial("signal", str(error))
        self._ready = found.outcome not in ("hang", "signal")
        return found

    def stop(self) -> None:
        """End the process."""
        self._worker.stop()


def content_of(name: str, seed: int, index: int, sound: bytes) -> bytes:
    """Return a mutant of a sound file; every other time of what its packing or its checksums hide."""
    random = Random(f"{name} {seed} {index}")
    if (coding := FORMATS[name].coding) is None or random.random() < 0.5:
        return mutant(sound, random)
    unpack, pack = coding
    return pack(mutant(unpack(sound), random))


def trials(name: str, indices: Sequence[int], seed: int, read: Reader, folder: Path) -> Iterator[tuple[int, Trial]]:
    """Read mutants of a format.

    Args:
        name: of the format, see `FORMATS`.
        indices: of the mutants.
        seed: of all.
        read: reads a file.
        folder: an empty folder, where the files are written.

    Yields:
        index and outcome of each.
    """
    kind = FORMATS[name]
    path = folder / kind.file
    kind.write(path)
    sound = path.read_bytes()
    beside = {other: other.read_bytes() for other in folder.iterdir() if other != path}
    for index in indices:
        for file, content in ({path: content_of(name, seed, index, sound)} | beside).items():
            file.write_bytes(content)
        yield index, read(kind.read, path)


def run(name: str, options: argparse.Namespace) -> list[tuple[int, Trial]]:
    """Return index and outcome of all mutants of a format; the bad ones are kept on request."""
    indices = range(options.count) if options.index is None else [options.index]
    read, found = Reader(), []
    try:
        with tempfile.TemporaryDirectory() as folder:
            for index, trial in trials(name, indices, options.seed, read, Path(folder)):
                found.append((index, trial))
                if options.keep is not None and (trial.outcome not in SOUND or options.index is not None):
                    _keep(Path(folder) / FORMATS[name].file, options.keep / f"{name} {options.seed} {index}")
    finally:
        read.stop()
    return found


def _keep(path: Path, folder: Path) -> None:
    """Copy a mutant and what lies beside it into a folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in path.parent.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())


def row(name: str, found: Sequence[tuple[int, Trial]]) -> str:
    """Return the row of a format: how many files had each outcome, and the most memory that one took."""
    counts = Counter(trial.outcome for _, trial in found)
    largest = readable(max((trial.memory for _, trial in found), default=0))
    return f"{name:22}" + "".join(f"{counts[outcome]:9}" for outcome in OUTCOMES) + f"{largest:>10}"


def _kinds(found: Sequence[tuple[int, Trial]], *, everything: bool) -> dict[tuple[str, str], list[int]]:
    """Return the mutants that went wrong, or all, by what became of them; numbers and quotations do not tell apart."""
    kinds: dict[tuple[str, str], list[int]] = {}
    for index, trial in found:
        if everything or trial.outcome not in SOUND:
            detail = re.sub(r"'[^']*'|\d+", "..", trial.detail)[:_WIDEST]
            kinds.setdefault((trial.outcome, detail), []).append(index)
    return kinds


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="mutants of a format")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers")
    parser.add_argument("--only", nargs="+", choices=FORMATS, default=list(FORMATS), metavar="NAME", help="formats")
    parser.add_argument("--index", type=int, help="this mutant alone")
    parser.add_argument("--jobs", type=int, default=1, help="formats at a time")
    parser.add_argument("--keep", type=Path, help="folder for the files that went wrong, or for that of --index")
    parser.add_argument("--show", action="store_true", help="print every sentence")
    return parser.parse_args()


def main() -> int:
    """Print the table and what went wrong; return the exit code."""
    options, bad = _arguments(), 0
    print(f"{'':22}" + "".join(f"{outcome:>9}" for outcome in OUTCOMES) + f"{'most':>10}", flush=True)
    with ThreadPoolExecutor(options.jobs) as pool:
        for name, found in zip(options.only, pool.map(lambda name: run(name, options), options.only), strict=True):
            print(row(name, found), flush=True)
            for (outcome, detail), indices in _kinds(found, everything=options.show).items():
                print(f"    {outcome}: {detail}")
                print(
                    f'        --only "{name}" --seed {options.seed} --index {" or ".join(map(str, indices[:_SHOWN]))}'
                )
            bad += sum(trial.outcome not in SOUND for _, trial in found)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
