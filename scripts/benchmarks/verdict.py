"""The verdict measured like a test in a clinic: every open pair, and bad pairs made of them; who is taken for what.

Usage: python scripts/benchmarks/verdict.py [DATA] [--only KIND ...]

DATA is the folder of images, TORCHDEFORM_DATA or ../shared/data by default. Good pairs are judged with the labels and
landmarks that they have, bad ones without, unless these are what is wrong. Pairs that are refused with a sentence
count as bad. The halves are every other case of a kind.
"""

import argparse
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from verdict_cases import GOOD_PAIR, KINDS, Case, Cases

import torchdeform as td
from torchdeform.pipeline.preflight import ERROR, WARNING, preflight
from torchdeform.registration.verdict import BAD, GOOD, LOOK, Verdict

VERDICTS = (GOOD, LOOK, BAD)
# Kinds that must be bad, not only doubtful.
MUST_BE_BAD = ("unrelated", "mirrored", "labels swapped", "overlap destroyed")


def verdict_on(case: Case) -> Verdict:
    """Return the verdict that `register` would print."""
    scene = case.make()
    settings = td.load_settings("default", None, scene.overrides)
    known = scene.annotations
    masks: dict[str, Any] = {"fixed_mask": known.fixed_mask, "moving_mask": known.moving_mask}
    report = preflight(scene.fixed, scene.moving, aligned=settings.align.kind != "none", settings=settings, **masks)
    for refused in report.of(ERROR):
        return Verdict(BAD, refused, ())
    try:
        result = td.register(scene.fixed, scene.moving, settings, annotations=known)
    except td.InputError as refused:
        return Verdict(BAD, str(refused), ())
    return replace(result, warnings=(*report.of(WARNING), *result.warnings)).verdict


def misses(rows: Iterable[tuple[Case, Verdict]]) -> list[str]:
    """Return a line for each good pair that is not good, and each bad one that is good or not as bad as it must be."""
    found = []
    for case, verdict in rows:
        must = case.kind in MUST_BE_BAD
        allowed = {GOOD} if case.kind == GOOD_PAIR else {BAD} if must else {LOOK, BAD}
        found += (
            [f"{case.kind} | {case.name}: {verdict.kind}. {verdict.headline}"] if verdict.kind not in allowed else []
        )
    return found


def confusion(rows: list[tuple[Case, Verdict]]) -> list[str]:
    """Return the table: kinds of pairs, and how many of each half are taken for good, look and bad."""
    counts = Counter((case.kind, case.first, verdict.kind) for case, verdict in rows)
    kinds = [kind for kind in KINDS if any(name == kind for name, _, _ in counts)]
    lines = ["| pairs | first half: good | look | bad | second half: good | look | bad |", "| --- |" + " --- |" * 6]
    for kind in kinds:
        lines.append(_line(kind, [counts[kind, half, name] for half in (True, False) for name in VERDICTS]))
    bad = [kind for kind in kinds if kind != GOOD_PAIR]
    totals = [sum(counts[kind, half, name] for kind in bad) for half in (True, False) for name in VERDICTS]
    return [*lines, _line("all bad ones", totals)]


def _line(name: str, numbers: Iterable[int]) -> str:
    return f"| {name} | {' | '.join(map(str, numbers))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", default=os.environ.get("TORCHDEFORM_DATA", "../shared/data"), type=Path)
    parser.add_argument("--only", nargs="+", default=list(KINDS), choices=KINDS, metavar="KIND", help=", ".join(KINDS))
    arguments = parser.parse_args()
    rows = []
    for case in Cases(arguments.data).all():
        if case.kind in arguments.only:
            began = perf_counter()
            rows.append((case, verdict_on(case)))
            print(f"{rows[-1][1].kind:4} {case.kind} | {case.name} ({perf_counter() - began:.0f} s)", flush=True)
    print("", *confusion(rows), "", *misses(rows), sep="\n")


if __name__ == "__main__":
    main()
