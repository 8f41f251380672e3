"""Make the example pair from a picture that scikit-image bundles: the moving image is a strongly deformed copy.

The picture is a fundus photograph of a normal left eye (Häggström 2014, public domain, `skimage.data.retina`).
"""

import math
import sys
from pathlib import Path

import torch
from skimage.data import retina
from skimage.transform import resize
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import torchdeform as td  # noqa: E402

SIZE = 256
TURN, SQUEEZE = 0.45, 0.035  # radians in the middle; share of the width


def deformation(grid: td.Grid) -> Tensor:
    """Return a displacement ``(1, 2, *S)`` that turns the middle and stretches around it; zero at the edge."""
    unit = grid.points() / grid.along(grid.extent, grid.points())
    y, x = unit[:, 0] - 0.5, unit[:, 1] - 0.5
    bump = (torch.sin(math.pi * unit) ** 2).prod(dim=1)
    angle = TURN * bump
    turned = torch.stack((angle.cos() * y - angle.sin() * x - y, angle.sin() * y + angle.cos() * x - x), dim=1)
    waves = torch.stack((torch.sin(3 * math.pi * (x + 0.5)), torch.sin(3 * math.pi * (y + 0.5))), dim=1)
    return (turned + SQUEEZE * bump * waves) * grid.along(grid.extent, unit)


def make_pair() -> None:
    """Write ``examples/fixed.png`` and ``examples/moving.png``."""
    picture = torch.from_numpy(resize(retina(), (SIZE, SIZE), anti_aliasing=True)).float().movedim(-1, 0).unsqueeze(0)
    fixed = td.Image(picture * 255, td.Grid((SIZE, SIZE)), pixel_type="uint8")
    u = deformation(fixed.grid)
    darker = td.warp(picture, u, fixed.grid) ** 1.15 * 0.95  # as another camera might see it
    moving = td.Image(darker * 255, fixed.grid, pixel_type="uint8")
    td.write_image(fixed, ROOT / "examples" / "fixed.png")
    td.write_image(moving, ROOT / "examples" / "moving.png")
    diagnosis = td.diagnose(u, fixed.grid)
    largest = u.norm(dim=1).max().item()
    low, high = diagnosis.det_min.item(), diagnosis.det_max.item()
    print(f"moves by up to {largest:.1f} pixels, determinant {low:.2f} to {high:.2f}")


def make_picture() -> None:
    """Write ``examples/overview.jpg``, the picture of the README: that of the site's first page, as it is now."""
    from make_docs_pictures import pictures

    (ROOT / "examples" / "overview.jpg").write_bytes(dict(pictures(["start"]))["overview"])


if __name__ == "__main__":
    make_pair()
    make_picture()
