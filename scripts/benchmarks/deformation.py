"""Accuracy and cost of the deformation method: prints the tables of the documentation.

    python scripts/benchmarks/deformation.py [--quick]

Times depend on the machine; compare the ratios. pyamg is used if it is installed.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from torchdeform.core.derivatives import jacobian_determinant  # noqa: E402
from torchdeform.core.diagnostics import diagnose  # noqa: E402
from torchdeform.core.grid import Grid  # noqa: E402
from torchdeform.deformation.monitors import mean_value  # noqa: E402
from torchdeform.deformation.velocity import VelocityName  # noqa: E402
from torchdeform.deformation.versions import (  # noqa: E402
    DeformationSettings,
    grid_from_initial_monitor,
    grid_from_target_monitor,
    track_moving_monitor,
)
from torchdeform.fem import SolverSettings, Weights, solve_div_curl  # noqa: E402
from torchdeform.fem.system import DivCurlSystem  # noqa: E402

WAYS: tuple[VelocityName, ...] = ("direct", "poisson", "div_curl")
VERSIONS = {1: grid_from_initial_monitor, 2: grid_from_target_monitor}
RTOL = 1e-8

Monitor = Callable[[Tensor], Tensor]


def cube(nodes: int, dim: int) -> Grid:
    """Return a grid of the unit square or cube."""
    return Grid((nodes,) * dim, (1 / (nodes - 1),) * dim)


def ring(depth: float = 0.8, radius: float = 0.25, width: float = 0.12, place: float = 0.5) -> Monitor:
    """Return a circle or sphere of small cells; with these defaults f lies between 0.27 and 1.36 in 2D."""

    def f(x: Tensor) -> Tensor:
        centre = torch.tensor([place, 0.5, 0.5], dtype=x.dtype)[: x.shape[1]].view(1, -1, *[1] * (x.dim() - 2))
        r = ((x - centre) ** 2).sum(1, keepdim=True).sqrt()
        return 1 - depth * torch.exp(-(((r - radius) / width) ** 2))

    return f


def ball(ratio: float) -> Monitor:
    """Return a ball of cells smaller by ``ratio`` than those outside."""

    def f(x: Tensor) -> Tensor:
        r = ((x - 0.5) ** 2).sum(1, keepdim=True).sqrt()
        return ratio ** -torch.sigmoid((0.25 - r) / 0.05)

    return f


def errors(u: Tensor, f: Monitor, grid: Grid, version: int) -> tuple[float, float]:
    """Return mean and maximum of |J/f − 1| over the nodes, f being known everywhere."""
    x = grid.points(dtype=u.dtype)
    scale = 1 / mean_value(f(x), grid) if version == 1 else mean_value(1 / f(x), grid)
    error = (jacobian_determinant(u, grid) / (f(x if version == 1 else x + u) * scale) - 1).abs()
    return float(error.mean()), float(error.max())


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows as they come, in columns."""
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{'---|' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def seconds(run: Callable[[], object], *, least: float = 0.3) -> float:
    """Return the shortest time of a call over ``least`` seconds of them; the first is left out if there are more."""
    times: list[float] = []
    while sum(times) < least:
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times[1:] or times)


def accuracy_rows(sizes: Sequence[int], dim: int) -> Iterable[list[str]]:
    """Yield version, velocity and corrections, then mean / max of |J/f − 1| at each size and the slopes of the mean."""
    for version, run in VERSIONS.items():
        for velocity in WAYS:
            for corrections in (DeformationSettings().corrections, 0):
                settings = DeformationSettings(corrections=corrections)
                found = []
                for nodes in sizes:
                    grid = cube(nodes, dim)
                    u = run(ring()(grid.points(dtype=torch.float64)), grid, velocity=velocity, settings=settings)
                    found.append(errors(u, ring(), grid, version))
                pairs = zip(found, found[1:], sizes, sizes[1:], strict=False)
                slopes = [math.log(a[0] / b[0]) / math.log((m - 1) / (n - 1)) for a, b, n, m in pairs]
                cells = [f"{mean:.1e} / {most:.1e}" for mean, most in found]
                yield [str(version), velocity, str(corrections), *cells, *[f"{slope:.2f}" for slope in slopes]]


def fold_rows(grids: Sequence[Grid]) -> Iterable[list[str]]:
    """Yield folds before and after they are removed, for monitors with f_max/f_min = 100."""
    monitors = {
        "ring": ring(0.99),
        "thin ring": ring(0.99, 0.3, 0.06),
        "fine ball": ball(100),
        "coarse ball": ball(0.01),
    }
    raw = DeformationSettings(corrections=0, remove_folds=False)
    for grid in grids:
        for name, monitor in monitors.items():
            f = monitor(grid.points(dtype=torch.float64))
            for version, run in VERSIONS.items():
                flow, map_ = (run(f, grid, settings=settings) for settings in (raw, DeformationSettings()))
                before, after = diagnose(flow, grid), diagnose(map_, grid)
                counts = [str(int(d.folds)) for d in (before, after)]
                mean = errors(map_, monitor, grid, version)[0]
                yield [f"{grid.shape}", name, str(version), *counts, f"{float(after.smallest):.1e}", f"{mean:.1e}"]


def drift_rows(sizes: Sequence[int]) -> Iterable[list[str]]:
    """Yield the errors of Version 3 at the last of 20 times, and those of Version 2 for that monitor."""
    times = [k / 19 for k in range(20)]

    def moving(t: float) -> Monitor:
        return ring(radius=0.15, width=0.1, place=0.3 + 0.4 * t)

    for nodes in sizes:
        grid = cube(nodes, 2)
        x = grid.points(dtype=torch.float64)
        for velocity in WAYS:
            target = errors(grid_from_target_monitor(moving(1)(x), grid, velocity=velocity), moving(1), grid, 2)
            sources = {"callable": lambda t, x=x: moving(t)(x), "stack": torch.stack([moving(t)(x) for t in times])}
            for kind, source in sources.items():
                last = errors(track_moving_monitor(source, grid, times, velocity)[-1], moving(1), grid, 2)
                cells = [f"{mean:.1e} / {most:.1e}" for mean, most in (target, last)]
                yield [f"{nodes}²", velocity, kind, *cells, f"{last[0] / target[0]:.2f}"]


def cost_rows(grids: Sequence[Grid]) -> Iterable[list[str]]:
    """Yield the time of each version and its share of solving for the velocity."""
    for grid in grids:
        f = ring()(grid.points(dtype=torch.float32))
        for version, run in VERSIONS.items():
            whole = seconds(lambda f=f, grid=grid, run=run: run(f, grid))
            solve = seconds(lambda f=f, grid=grid: solve_div_curl(f, None, grid))
            yield [f"{grid.shape}", str(version), f"{whole:.3f} s", f"{solve:.4f} s"]


def solvers(grid: Grid) -> dict[str, Callable[[], object]]:
    """Return ways to solve the same div-curl system: ours, and those of others on the assembled matrix."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import cg, spsolve

    alpha = 1 - ring()(grid.points(dtype=torch.float64))
    alpha = alpha - mean_value(alpha, grid)
    system = DivCurlSystem(grid, Weights())
    sparse = system.matrix()
    matrix = coo_matrix((sparse.values().numpy(), sparse.indices().numpy()), shape=tuple(sparse.shape)).tocsr()
    load = system.free(system.load(div=alpha)).flatten().numpy()
    by_cg = SolverSettings(method="cg", rtol=RTOL)
    ways = {
        "torchdeform, transform": lambda: solve_div_curl(alpha, None, grid),
        "torchdeform, CG with transform": lambda: solve_div_curl(alpha, None, grid, solver=by_cg),
        "scipy CG": lambda: cg(matrix, load, rtol=RTOL),
        "scipy spsolve": lambda: spsolve(matrix.tocsc(), load),
    }
    if find_spec("pyamg"):
        pyamg = import_module("pyamg")
        ways["pyamg, set-up and solve"] = lambda: pyamg.smoothed_aggregation_solver(matrix).solve(load, tol=RTOL)
    return ways


def solver_rows(grids: Sequence[Grid]) -> Iterable[list[str]]:
    """Yield the time of each solver and its ratio to the first."""
    for grid in grids:
        first = None
        for name, run in solvers(grid).items():
            taken = seconds(run)
            first = first or taken
            yield [f"{grid.shape}", name, f"{taken:.4f} s", f"{taken / first:.0f}"]


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description="Accuracy and cost of the deformation method.")
    parser.add_argument("--quick", action="store_true", help="small grids only")
    quick = parser.parse_args().quick
    sizes = (32, 64) if quick else (64, 128, 256)
    names = [f"{n}²" for n in sizes]
    error = "mean / max of |J/f − 1|"
    slopes = [f"slope {a} to {b}" for a, b in pairwise(names)]
    head = ["version", "velocity", "corrections", *names, *slopes]
    table(f"Ring, 2D: {error}", head, accuracy_rows(sizes, 2))
    cubes = (20,) if quick else (20, 40)
    head = ["version", "velocity", "corrections", *[f"{n}³" for n in cubes], *["slope"][: len(cubes) - 1]]
    table(f"Sphere, 3D: {error}", head, accuracy_rows(cubes, 3))
    head = ["grid", "monitor", "version", "folds of the flow", "folds", "smallest determinant", "mean of |J/f − 1|"]
    table("f_max/f_min = 100", head, fold_rows([cube(64, 2), cube(20 if quick else 40, 3)]))
    head = ["grid", "velocity", "monitor", "Version 2", "Version 3, last of 20 times", "ratio of means"]
    table(f"A ring moving across the square: {error}", head, drift_rows(sizes[:2]))
    head = ["grid", "version", "map, float32", "one div-curl solve"]
    table("Cost", head, cost_rows([cube(sizes[-1], 2), cube(20 if quick else 64, 3)]))
    head = ["grid", f"solver, float64, to {RTOL:g}", "time", "ratio"]
    table("The div-curl system", head, solver_rows([cube(sizes[-1], 2), cube(12 if quick else 24, 3)]))


if __name__ == "__main__":
    main()
