"""Example 1 of the paper: from a square grid to one that is stretched to a rectangle and refined around an arc.

The map is reconstructed from its divergence, its curl and its boundary values in 10 time steps; the picture shows the
given grid, the 5th step and the 10th.

    python examples/paper_example_1.py [PICTURE.png]

Liu, Liao & Xue 2007, section 4 and Figure 1. Prints the largest distance between given and reconstructed nodes.
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torchdeform as td
from torchdeform.deformation.monitors import MonitorSettings, ring_monitor
from torchdeform.report.grids import write_grids

NODES, STEPS = 64, 10
STRETCH = (1.0, 1.6)


def given_map(grid: td.Grid) -> Tensor:
    """Return the displacement of: draw nodes to an arc (Version 2 of the deformation method), then stretch."""
    arc = MonitorSettings(f_min=0.25, f_max=1.0, dtype=torch.float64)
    monitor = ring_monitor(grid, (1.15, 0.5), 0.7, 0.1, arc)
    nodes = grid.points(dtype=torch.float64)
    return (nodes + td.grid_from_target_monitor(monitor, grid)) * grid.along(STRETCH, nodes) - nodes


def main(picture: Path) -> None:
    """Reconstruct, draw, and print the error."""
    grid = td.Grid((NODES, NODES), (1 / (NODES - 1),) * 2)
    u, nodes = given_map(grid), grid.points(dtype=torch.float64)
    solution = td.reconstruct(td.divergence(u, grid), td.curl(u, grid), grid, boundary_displacement=u, steps=STEPS)
    shown = {"given": u} | {f"time step {t}": solution.trajectory[t - 1] for t in (STEPS // 2, STEPS)}
    write_grids(picture, {title: nodes + moved for title, moved in shown.items()})
    print(f"{float((solution.value - u).norm(dim=1).max()):.3e}")  # noqa: T201


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "paper_example_1.png"))
