"""The benchmark runs; what it measures is tested elsewhere."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize("part", [[], ["--large"]])
def test_the_benchmark_prints_its_tables(part, root):
    pytest.importorskip("scipy")
    command = [sys.executable, root / "scripts" / "benchmarks" / "reconstruction.py", "--quick", *part]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    titles = ["matrix-free"] if part else ["Reconstruction, 12³", "Map from its determinant and curl", "scipy CG"]
    assert all(title in done.stdout for title in titles)
