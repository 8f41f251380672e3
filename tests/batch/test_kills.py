"""Killed at any moment, the same command goes on where it was: nothing lost, doubled, different or left behind."""

import random
import subprocess
import sys

import pytest
from cohort_runs import ENGINES, displacements, done, faults, finish, living, start, wait_for, write_cohort

NAMES = "abcdef"


def _engines() -> list[object]:
    return [pytest.param(name, marks=[] if name == "local" else pytest.mark.slow) for name in ENGINES if name != "one"]


@pytest.mark.parametrize("engine", _engines())
def test_killed_twice_then_resumed(tmp_path, engine):
    if engine == "dask":
        pytest.importorskip("distributed")
    cohort, chance = write_cohort(tmp_path, NAMES, engine), random.Random(engine)
    for count in (1, 3):
        process = start(cohort)
        wait_for(cohort, count, process)
        try:
            process.wait(chance.random())
        except subprocess.TimeoutExpired:
            process.kill()
        process.communicate()
    before = done(cohort)
    code, _, said = finish(cohort)
    assert code == 0, said
    assert "already done (skipped)" in said
    assert set(before) <= set(NAMES)
    assert faults(cohort, NAMES) == []
    assert len(set(displacements(cohort).values())) == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for processes as Linux shows them")
def test_no_process_outlives_the_run_that_started_it(tmp_path):
    cohort = write_cohort(tmp_path, NAMES)
    process = start(cohort)
    wait_for(cohort, 1, process)
    process.kill()
    process.communicate()
    assert living(cohort, seconds=20) == []
