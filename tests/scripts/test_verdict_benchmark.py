"""The benchmark of the verdict: its table counts right, its cases are many, and one of them runs."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest


@pytest.fixture
def benchmark(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "scripts" / "benchmarks"))

    return import_module("verdict")


def test_the_table_counts_kinds_and_halves(benchmark):
    def row(kind, first, verdict):
        return benchmark.Case(kind, f"a {kind} pair", lambda: None, first), benchmark.Verdict(verdict, "Because.", ())

    rows = [
        row("good pair", True, "good"),
        row("good pair", False, "look"),
        row("half", True, "look"),
        row("mirrored", False, "look"),
        row("mirrored", True, "bad"),
    ]
    table = benchmark.confusion(rows)
    assert "| good pair | 1 | 0 | 0 | 0 | 1 | 0 |" in table
    assert "| mirrored | 0 | 0 | 1 | 0 | 1 | 0 |" in table
    assert table[-1] == "| all bad ones | 0 | 1 | 1 | 0 | 1 | 0 |"
    assert benchmark.misses(rows) == [
        "good pair | a good pair pair: look. Because.",
        "mirrored | a mirrored pair: look. Because.",
    ]


@pytest.mark.data
def test_there_are_enough_cases_of_both_halves(benchmark, data_folder):
    cases = benchmark.Cases(data_folder).all()
    good = [case for case in cases if case.kind == benchmark.GOOD_PAIR]
    assert len(good) == 35
    assert len(cases) - len(good) >= 60
    assert {case.kind for case in cases} == set(benchmark.KINDS)
    assert abs(sum(case.first for case in cases) - len(cases) / 2) < 10
    assert len({(case.kind, case.name) for case in cases}) == len(cases)


@pytest.mark.data
@pytest.mark.slow
def test_a_kind_can_be_run_alone(root, data_folder):
    script = Path(root) / "scripts" / "benchmarks" / "verdict.py"
    command = [sys.executable, script, data_folder, "--only", "only noise"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "| only noise | 0 | 0 | 2 | 0 | 0 | 2 |" in done.stdout
