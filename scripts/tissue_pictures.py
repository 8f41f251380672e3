"""Pictures of pairs without and with their tissue: images, deformed grids, and determinants beside them."""

import math
from pathlib import Path

import torch
from torch import Tensor

import torchdeform as td
from torchdeform.core.warp import sample
from torchdeform.report.contours import outlines
from torchdeform.report.drawing import (
    CURVES,
    Floats,
    draw_bar,
    draw_faint,
    draw_image,
    draw_lines,
    draw_lines_over,
    draw_map,
    save_png,
    volume_scale,
)
from torchdeform.report.planes import planes_of
from torchdeform.report.sheet import TITLE, Sheet, title

RUNS = ("without", "with")  # the folders of the two results
_WIDTH = 2.6  # inches of a panel
_LINES = 36


def compare(folder: Path) -> Path:
    """Draw what lies in a folder: ``fixed``, ``moving`` and ``tissue``, and the results ``without`` and ``with``."""
    images = {name: td.read_image(folder / f"{name}.nii.gz") for name in ("fixed", "moving", "tissue")}
    maps = [td.read_transform(folder / run / "transform.h5").flatten(images["fixed"]) for run in RUNS]
    grid = images["fixed"].grid
    plane = planes_of(images["fixed"])[0]
    border = outlines((images["tissue"].data[0].round().int()).numpy())[0]
    sheet = Sheet(_WIDTH, 3, [_WIDTH * plane.height_over_width] * 2, [TITLE] * 2, bottom=0.5)
    scale = volume_scale(math.log(4))
    for row, image, run, found in zip(sheet.panels, ("fixed", "moving"), RUNS, maps, strict=True):
        grey, u = images[image].data[0].clamp(0, 1), found.field.data.float()
        draw_image(row[0], plane, grey)
        draw_faint(row[1], plane, images["moving"].data[0].clamp(0, 1))
        draw_lines(row[1], plane, u[0], _LINES)
        volume = td.jacobian_determinant(u, grid)[0].clamp(min=1e-3).log()
        shown = draw_map(row[2], plane, volume, scale)
        moved = [_moved(line, u, grid) for line in border]
        shapes = (border if image == "fixed" else [], moved, border)
        for panel, lines in zip(row, shapes, strict=True):
            draw_lines_over(panel, lines, CURVES[2])
        for panel, text in zip(row, (image, f"grid, {run} tissue", f"determinant, {run} tissue"), strict=True):
            title(panel, text)
        if run == RUNS[-1]:
            draw_bar(sheet.below(row[2], 0.7 * _WIDTH, 0.1, 0.12), shown, scale)
    save_png(sheet.figure, folder / "compared.png")
    return folder / "compared.png"


def _moved(line: Floats, u: Tensor, grid: td.Grid) -> Floats:
    """Return where φ takes the points (across, down) of a line on a grid of spacing 1."""
    places = torch.from_numpy(line.T[::-1].copy())[None].float()
    return (places + sample(u, places, grid))[0].flip(0).T.numpy()
