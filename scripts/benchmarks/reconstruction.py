"""Measure reconstruction, prescribed determinant and curl, and the div-curl solve next to others in the same run.

    python scripts/benchmarks/reconstruction.py            the tables at full size, a few minutes on two cores
    python scripts/benchmarks/reconstruction.py --large    only the solve at 256³ in float32
    python scripts/benchmarks/reconstruction.py --quick    everything small, to see that it runs

scipy is needed for the comparison; pyamg is used if it is there.
"""

import argparse
import math
import resource
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from torchdeform.core.derivatives import CURL_PAIRS, curl, divergence, jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import max_voxels
from torchdeform.deformation.prescribed import PrescribedSolution, from_jacobian_and_curl
from torchdeform.deformation.reconstruction import reconstruct
from torchdeform.fem import SolverSettings, Weights, solve_div_curl
from torchdeform.fem.system import DivCurlSystem

# Unknowns beyond which the factors of a sparse direct solver outgrow the memory of a desktop.
DIRECT_LIMIT = 25_000


def timed(run: Callable[[], Any], repeats: int = 1) -> tuple[Any, float]:
    """Return what ``run`` returned last and the shortest time it took, in seconds."""
    best, result = math.inf, None
    for _ in range(repeats):
        start = time.perf_counter()
        result = run()
        best = min(best, time.perf_counter() - start)
    return result, best


def row(name: str, *values: str) -> None:
    """Print one row of a table."""
    print(f"  {name:<46}" + "".join(f"{value:>17}" for value in values), flush=True)


def sphere_map(nodes: int) -> tuple[Grid, Tensor]:
    """Return the unit cube and a map that draws its nodes towards a sphere: determinant 0.37 to 1.9, moves 0.034."""
    grid = Grid((nodes,) * 3, (1 / (nodes - 1),) * 3)
    x = grid.points(dtype=torch.float64) - 0.5
    r = x.norm(dim=1, keepdim=True).clamp(min=1e-12)
    towards, away = ((r + offset) / 0.0875 for offset in (-0.25, 0.25))
    pull = towards * torch.exp(-(towards**2) / 2) + away * torch.exp(-(away**2) / 2)
    return grid, -0.056 * pull * x / r


def plane_map(nodes: int) -> tuple[Grid, Tensor]:
    """Return a plane grid and sines that stretch and turn it: determinant 0.44 to 1.8, moves 2.6 % of its side."""
    grid = Grid((nodes, nodes))
    x = grid.points(dtype=torch.float64) * (math.pi / (nodes - 1))
    one, two = torch.sin(x), torch.sin(2 * x)
    turn = two.flip(1) * one.prod(dim=1, keepdim=True)
    turn[:, 1].neg_()
    stretch = one * torch.sin(7 * x) * one.flip(1) ** 2 * torch.cos(2 * x.flip(1))
    return grid, (1.8 * stretch + turn) * ((nodes - 1) / 100)


def turned_core(nodes: int) -> tuple[Grid, Tensor]:
    """Return a cube and a map that turns its core by 60° about one axis after the other, at rest at the boundary."""
    grid = Grid((nodes,) * 3)
    start = grid.points(dtype=torch.float64) - (nodes - 1) / 2
    moved = start
    for a, b in CURL_PAIRS[3]:
        t = ((2 * moved.norm(dim=1, keepdim=True) / (nodes - 1) - 0.3) / 0.65).clamp(0, 1)
        turn = math.pi / 3 * (1 - t**3 * (10 - 15 * t + 6 * t**2))
        parts = list(moved.split(1, dim=1))
        along, across = parts[a], parts[b]
        parts[a] = turn.cos() * along - turn.sin() * across
        parts[b] = turn.sin() * along + turn.cos() * across
        moved = torch.cat(parts, dim=1)
    return grid, moved - start


def reconstruction(nodes: int) -> None:
    """Print the largest distance between a map and its reconstruction."""
    (grid, u), (finer, v) = sphere_map(nodes), sphere_map(2 * nodes)
    det = jacobian_determinant(u, grid)
    print(f"\nReconstruction, {nodes}³, map adapted to a sphere, determinant {det.min():.2f} to {det.max():.2f}")
    row("", "max error", "seconds")
    errors = {}
    for name, order, refine in (("order 2", 2, False), ("order 4", 4, False), ("order 2, refined", 2, True)):
        data = divergence(u, grid, order), curl(u, grid, order)
        options = {"order": order, "refine": refine}
        solution, seconds = timed(lambda data=data, options=options: reconstruct(*data, grid, u, **options))
        errors[name] = float((solution.value - u).norm(dim=1).max())
        row(name, f"{errors[name]:.3e}", f"{seconds:.2f}")
    fine = reconstruct(divergence(v, finer), curl(v, finer), finer, v)
    ratio = errors["order 2"] / float((fine.value - v).norm(dim=1).max())
    slope = math.log(ratio) / math.log(grid.spacing[0] / finer.spacing[0])
    row(f"slope of order 2, {nodes}³ to {2 * nodes}³", f"{slope:.2f}")
    row("the paper, 40³", "5.225e-03")


def prescribed(plane: int, cube: int) -> None:
    """Print how well maps come back from their determinants and curls."""
    print("\nMap from its determinant and curl")
    row("", "max error, cells", "Newton steps", "CG steps", "seconds")
    for name, (grid, u) in ((f"2D, {plane}²", plane_map(plane)), (f"3D, {cube}³, core turned", turned_core(cube))):
        f, g = jacobian_determinant(u, grid), curl(u, grid)
        solution, seconds = timed(lambda f=f, g=g, grid=grid: from_jacobian_and_curl(f, g, grid))
        row(name, *_outcome(solution, u, grid), f"{seconds:.2f}")
    row("published gradient descents, 2D", "7.7e-02", "632", "", "6.4")
    row("", "", "41767", "", "367")
    row("published gradient descent, 3D", "4.0e-02", "", "", "788")


def _outcome(solution: PrescribedSolution, u: Tensor, grid: Grid) -> tuple[str, str, str]:
    error = float(max_voxels(solution.value - u, grid))
    return f"{error:.1e}", str(int(solution.steps)), str(int(solution.linear_steps))


def solves(nodes: int, rtol: float = 1e-8) -> None:
    """Print the time of a div-curl solve, and of other solvers on the same assembled matrix."""
    grid = Grid((nodes,) * 3)
    generator = torch.manual_seed(0)
    div, rotation = (torch.randn(1, c, *grid.shape, dtype=torch.float64, generator=generator) for c in (1, 3))
    div = div - (div * grid.quadrature(dtype=torch.float64)).sum() / grid.volume
    print(f"\nDiv-curl solve, {nodes}³ × 3 unknowns, slip, float64, relative residual {rtol:g}")
    row("", "seconds", "steps", "over transform", "over its CG")
    by_cg = SolverSettings(method="cg", rtol=rtol)
    direct, fast = timed(lambda: solve_div_curl(div, rotation, grid), 3)
    iterative, slower = timed(lambda: solve_div_curl(div, rotation, grid, solver=by_cg), 3)
    row("transform", f"{fast:.3f}", "direct", "1", "")
    row("CG preconditioned by the transform", f"{slower:.3f}", str(int(iterative.steps)), f"{slower / fast:.1f}", "1")
    for name, (value, seconds, steps) in others(div, rotation, grid, rtol):
        assert_close(value, direct.value, name)
        row(name, f"{seconds:.2f}", steps, f"{seconds / fast:.0f}", f"{seconds / slower:.0f}")


def assert_close(value: Tensor, want: Tensor, name: str) -> None:
    """Stop if a solver that is compared with solves something else."""
    off = float((value - want).norm() / want.norm())
    if off > 1e-4:
        raise SystemExit(f"{name} has another solution, off by {off:.1e}")


def others(div: Tensor, rotation: Tensor, grid: Grid, rtol: float):
    """Yield the name, solution, time and steps of other solvers on the assembled matrix."""
    sparse = import_module("scipy.sparse")
    linalg = import_module("scipy.sparse.linalg")
    system = DivCurlSystem(grid, Weights())
    load = system.free(system.load(div=div, curl=rotation))
    matrix, seconds = timed(system.matrix)
    index, size = matrix.indices().numpy(), matrix.shape
    csr = sparse.csr_matrix((matrix.values().numpy(), (index[0], index[1])), shape=size)
    row(f"(assembly, {csr.nnz / 1e6:.1f} M entries)", f"{seconds:.2f}")
    b = load.flatten().numpy()

    def conjugate_gradient(**options) -> tuple[Any, str]:
        count = [0]

        def step(_: object) -> None:
            count[0] += 1

        return linalg.cg(csr, b, rtol=rtol, callback=step, **options)[0], str(count[0])

    def shaped(result: tuple[tuple[Any, str], float]) -> tuple[Tensor, float, str]:
        (x, steps), seconds = result
        return torch.from_numpy(x).view_as(load), seconds, steps

    yield "scipy CG", shaped(timed(conjugate_gradient))
    if size[0] <= DIRECT_LIMIT:
        yield "scipy direct", shaped(timed(lambda: (linalg.spsolve(csr.tocsc(), b), "direct")))
    else:
        row("scipy direct", "too large", "see below")
    try:
        pyamg = import_module("pyamg")
    except ImportError:
        row("pyamg", "not installed")
        return
    levels, setup = timed(lambda: pyamg.smoothed_aggregation_solver(csr))
    row("(pyamg, set-up)", f"{setup:.2f}")
    residuals: list[float] = []
    run = timed(lambda: (levels.solve(b, tol=rtol, accel="cg", residuals=residuals), ""))
    value, seconds, _ = shaped(run)
    yield "pyamg with CG, without its set-up", (value, seconds, str(len(residuals) - 1))


def large(nodes: int = 256) -> None:
    """Print time and memory of a solve in float32, next to one FFT there and back of the three components."""
    grid = Grid((nodes,) * 3)
    div, rotation = torch.randn(1, 1, *grid.shape), torch.randn(1, 3, *grid.shape)
    axes = tuple(range(2, 5))
    _, fft = timed(lambda: torch.fft.irfftn(torch.fft.rfftn(rotation, dim=axes), s=grid.shape, dim=axes), 3)
    solution, seconds = timed(lambda: solve_div_curl(div, rotation, grid), 2)
    print(f"\nDiv-curl solve, {nodes}³ × 3 unknowns, float32, matrix-free")
    row("rfftn and irfftn of three components", f"{fft:.2f} s")
    row("transform", f"{seconds:.2f} s", f"{seconds / fft:.1f} × the FFT", f"residual {float(solution.residual):.0e}")
    row("most memory of this process", f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.1f} GiB")


def main(arguments: list[str] | None = None) -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--large", action="store_true", help="only the solve at 256³")
    parser.add_argument("--quick", action="store_true", help="everything small")
    options = parser.parse_args(arguments)
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
    if options.large:
        large(32 if options.quick else 256)
        return
    reconstruction(12 if options.quick else 40)
    prescribed(*((21, 13) if options.quick else (101, 51)))
    solves(9 if options.quick else 64)
    if not options.quick:
        solves(20)


if __name__ == "__main__":
    main()
