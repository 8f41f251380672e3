"""Seconds that imports and the start of the shell take, each in a fresh interpreter.

``python scripts/benchmarks/imports.py``: the shortest of several runs, which other work on the machine disturbs least.
"""

import argparse
import platform
import subprocess
import sys
from time import perf_counter

import torch

CASES = {
    "python alone": "pass",
    "import torch": "import torch",
    "import torchdeform": "import torchdeform",
    "all public names": "import torchdeform; [getattr(torchdeform, name) for name in torchdeform.__all__]",
    "import torchdeform.nn": "import torchdeform.nn",
    "torchdeform --help": "import sys; from torchdeform.cli.main import torchdeform; sys.exit(torchdeform(['--help']))",
}


def seconds(code: str, runs: int) -> float:
    """Return the shortest wall time of a fresh interpreter that runs some code."""
    return min(_once(code) for _ in range(runs))


def _once(code: str) -> float:
    began = perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    return perf_counter() - began


def main(runs: int) -> None:
    """Print a table."""
    print(f"torch {torch.__version__}, Python {platform.python_version()}, shortest of {runs} runs\n")
    print("| what | seconds |\n| --- | --- |")
    for name, code in CASES.items():
        print(f"| {name} | {seconds(code, runs):.2f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    main(parser.parse_args().runs)
