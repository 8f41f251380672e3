"""Cohorts that are killed at random moments, as often as you like, and what is wrong when they are done at last.

Usage: python scripts/benchmarks/kills.py [--kills 50] [--pairs 8] [--seed 0]

Three cohorts: one worker, two workers, a Dask cluster. Each is started and killed (``kill -9`` of the process that
runs it) until its kills are used up; when it is done before, it begins anew. After every kill, and at the end: no
pair lost or doubled, the same displacement fields as without a kill, no process and no unfinished file left. Exits with
1 if a check fails.
"""

import argparse
import random
import string
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from cohort_runs import displacements, done, faults, finish, living, start, write_cohort

COHORTS = {"1 worker": "one", "2 workers": "local", "Dask, 2 workers": "dask"}
ORPHANED, SECONDS = "orphaned", 30.0  # s that processes may take to notice that they are alone


def undisturbed(folder: Path, names: str, engine: str) -> tuple[bytes, float]:
    """Return the displacement file of a run that nobody kills, and the seconds that it took."""
    begin = time.monotonic()
    code, _, said = finish(write_cohort(folder, names, engine))
    if code:
        raise SystemExit(f"the cohort does not run at all: {said}")
    return next(iter(displacements(folder / "cohort.yaml").values())), time.monotonic() - begin


def kill_once(cohort: Path, after: float) -> bool:
    """Start a run and kill it after some seconds; return whether it was still there."""
    process = start(cohort, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True
    return False


def ill_treated(
    folder: Path, names: str, engine: str, kills: int, chance: random.Random
) -> Iterator[tuple[int, list[str]]]:
    """Yield kills and faults of every cohort that was finished in spite of them, until the kills are used up."""
    (folder / "right").mkdir()
    right, seconds = undisturbed(folder / "right", names, engine)
    used = 0
    while used < kills:
        place = folder / str(used)
        place.mkdir()
        cohort, found, before = write_cohort(place, names, engine), [], used
        for _ in range(min(kills - used, chance.randint(1, 5))):
            if not kill_once(cohort, chance.uniform(0.2, 1.1) * seconds):
                break
            used += 1
            if living(cohort, SECONDS):
                found.append(ORPHANED)
        known = done(cohort)
        code, _, _ = finish(cohort)
        found += faults(cohort, names, right) + ["exit code"] * (code != 0)
        found += ["done again"] * any(done(cohort).count(name) > 1 for name in known)
        used += used == before  # it was never killed in time; that is counted, or it might go on for ever
        yield used - before, found


def main() -> int:
    """Print a line a cohort; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of all cohorts together")
    parser.add_argument("--pairs", type=int, default=8, help="of a cohort")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance, names = random.Random(options.seed), string.ascii_lowercase[: options.pairs]
    shares = [options.kills // 3 + (k < options.kills % 3) for k in range(3)]
    wrong = 0
    for (title, engine), share in zip(COHORTS.items(), shares, strict=True):
        with TemporaryDirectory() as folder:
            runs = list(ill_treated(Path(folder), names, engine, share, chance))
        faulty = Counter(fault for _, found in runs for fault in found)
        wrong += sum(faulty.values())
        told = ", ".join(f"{fault} {count}" for fault, count in faulty.items()) or "nothing wrong"
        print(f"{title:<16} {sum(count for count, _ in runs):>3} kills {len(runs):>3} cohorts  {told}", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
