"""Example 2 of the paper: a cube of 40³ nodes, adapted to a ball and reconstructed from its divergence and its curl.

    python examples/paper_example_2.py [PICTURE.png]

Liu, Liao & Xue 2007, section 4 and Figure 2, where the largest distance between given and reconstructed nodes is
5.225e-3. Prints that distance.
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchdeform as td
from torchdeform.deformation.monitors import MonitorSettings, ring_monitor
from torchdeform.report.grids import write_grids

NODES = 40


def given_map(grid: td.Grid) -> Tensor:
    """Return the displacement of a map that draws nodes to a sphere (Version 2 of the deformation method)."""
    sphere = MonitorSettings(f_min=0.3, f_max=1.0, dtype=torch.float64)
    return td.grid_from_target_monitor(ring_monitor(grid, (0.5, 0.5, 0.5), 0.25, 0.12, sphere), grid)


def main(picture: Path) -> None:
    """Reconstruct, draw, and print the error."""
    grid = td.Grid((NODES,) * 3, (1 / (NODES - 1),) * 3)
    u, nodes = given_map(grid), grid.points(dtype=torch.float64)
    solution = td.reconstruct(td.divergence(u, grid), td.curl(u, grid), grid, boundary_displacement=u)
    write_grids(picture, {"given": nodes + u, "reconstructed": nodes + solution.value})
    print(f"{float((solution.value - u).norm(dim=1).max()):.3e}")  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "paper_example_2.png"))
