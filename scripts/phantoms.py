"""Make the small images of the how-to pages: ``python scripts/phantoms.py brains`` writes a folder ``brains``.

All but the histology are drawn here; that one is a picture that scikit-image bundles (immunohistochemistry of the
colon, Center for Microscopy and Molecular Imaging, no known copyright restrictions).
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

import torchdeform as td


def brains(out: Path) -> None:
    """Two heads of different shape with labels: 1 ventricles, 2 white matter, 3 cortex."""
    grid = td.Grid((32, 40, 32), (5.0, 5.0, 5.0))
    labels = _brain_labels(grid)
    shades = torch.tensor([0.0, 30.0, 160.0, 100.0, 60.0])
    brain = shades[labels] + _noise(grid.shape, 1.0, 1) * 8 * (labels > 0)
    u = _random_map(grid, 10.0, 7.0, seed=2)
    here, there = (-80.0, -95.0, -80.0), (-66.0, -110.0, -71.0)
    _write(out / "fixed.nii.gz", brain.clamp(min=0), grid, origin=here)
    _write(out / "fixed_labels.nii.gz", labels * (labels < 4), grid, kind="int16", origin=here)
    _write(out / "moving.nii.gz", td.warp(brain.clamp(min=0), u, grid), grid, origin=there)
    warped = torch.cat([td.warp((labels == k).float(), u, grid) for k in range(5)], dim=1).argmax(1, keepdim=True)
    _write(out / "moving_labels.nii.gz", warped * (warped < 4), grid, kind="int16", origin=there)


def lungs(out: Path) -> None:
    """A chest breathed in (fixed) and out, with masks of the lungs and landmarks at vessels, in world mm."""
    grid = td.Grid((28, 26, 38), (7.5, 7.5, 7.5))
    z, y, x = (grid.points() / grid.along(grid.extent, grid.points())).split(1, dim=1)
    sides = [((z - 0.5) / 0.38) ** 2 + ((y - 0.5) / 0.34) ** 2 + ((x - c) / 0.19) ** 2 < 1 for c in (0.28, 0.72)]
    mask = sides[0] | sides[1]
    chest = ((y - 0.5) / 0.47) ** 2 + ((x - 0.5) / 0.49) ** 2 < 1
    vessels = _noise(grid.shape, 1.5, 3).clamp(min=0.3) - 0.3
    ct = torch.where(mask, -850.0 + 500 * vessels, torch.where(chest, 40.0, -1000.0))
    depth = torch.exp(-(((x - 0.5) / 0.45) ** 2) - ((y - 0.5) / 0.45) ** 2) * torch.sin(math.pi * z)
    v = torch.cat([20 * depth, 5 * depth, torch.zeros_like(depth)], dim=1)
    u, back = td.integrate(v, grid), td.integrate(v, grid, time=-1.0)
    for name, values in (("fixed", ct), ("moving", td.warp(ct, u, grid))):
        _write(out / f"{name}.mha", values, grid, kind="int16")
    for name, values in (("fixed", mask.float()), ("moving", td.warp(mask.float(), u, grid) > 0.5)):
        _write(out / f"{name}_mask.mha", values, grid, kind="uint8")
    nodes = torch.nonzero((mask & (vessels > 0.8))[0, 0])[::20]
    for name, field in (("fixed", torch.zeros_like(back)), ("moving", back)):
        places = (grid.points() + field)[0][(slice(None), *nodes.T)].flip(0).T.tolist()
        rows = [f"{number},{','.join(f'{p:.3f}' for p in point)}" for number, point in enumerate(places)]
        (out / f"{name}.csv").write_text("\n".join(["index,x,y,z", *rows]) + "\n", encoding="utf-8")


def hearts(out: Path) -> None:
    """A slice across a heart, filled (ED) and contracted (ES), with labels: 1 cavity, 2 muscle."""
    grid = td.Grid((128, 128), (1.5, 1.5))
    y, x = (grid.points() - 95.0).split(1, dim=1)
    radius = (x.square() + (1.1 * y).square()).sqrt()
    labels = torch.where(radius < 26, 1, torch.where(radius < 38, 2, 0))
    lung = ((x + 15) / 70) ** 2 + ((y + 5) / 60) ** 2 < 1
    blood = ((((x + 34) / 30) ** 2 + ((y + 6) / 38) ** 2 < 1) & (labels == 0)) | (labels == 1)
    shade = 60.0 + 50 * _noise(grid.shape, 2.5, 11).clamp(-1, 1)
    values = torch.where(lung, 25.0 + 8 * _noise(grid.shape, 1.5, 12), shade)
    values = torch.where(blood, 190.0, torch.where(labels == 2, 75.0, values)) + 6 * _noise(grid.shape, 0.8, 13)
    inwards = 17 * (radius / 26) * torch.exp(1 - (radius / 26) ** 1.5) / radius.clamp(min=1)
    u = td.integrate(torch.cat([y, x], dim=1) * inwards / 2.2, grid)
    for name, w in (("ED", torch.zeros_like(u)), ("ES", u)):
        _write(out / f"{name}.png", td.warp(values, w, grid).clamp(0, 255), grid, kind="uint8")
        parts = [td.warp((labels == k).float(), w, grid) for k in range(3)]
        _write(out / f"{name}_label.png", torch.cat(parts, dim=1).argmax(1, keepdim=True), grid, kind="uint8")


def histology(out: Path) -> None:
    """A stained section, and one of a second stain that lies turned on its slide."""
    from skimage import color, data

    colours = data.immunohistochemistry()[::3, ::3] / 255.0
    stains = color.rgb2hed(colours)
    stains[..., 2], stains[..., 0] = 0.2 * stains[..., 2], 1.6 * stains[..., 0]
    other = np.clip(color.hed2rgb(stains), 0, 1)
    grid = td.Grid(colours.shape[:2])
    turned = _turn(grid, math.radians(25)) + _random_map(grid, 6.0, 15.0, seed=4)
    fixed, moving = (torch.tensor(255 * c).float().movedim(-1, 0)[None] for c in (colours, other))
    _write(out / "he.png", fixed, grid, kind="uint8")
    warped = td.warp(moving - 255, turned, grid) * _inside(grid, turned) + 255
    _write(out / "other.png", warped, grid, kind="uint8")


def contrasts(out: Path) -> None:
    """A slice of a head in two contrasts, with the labels of the first: what is bright in one is dark in the other."""
    grid = td.Grid((96, 80), (2.0, 2.0))
    labels = _brain_labels(grid)
    t1, t2 = torch.tensor([0.0, 30.0, 160.0, 100.0, 60.0]), torch.tensor([0.0, 220.0, 70.0, 130.0, 40.0])
    u = _random_map(grid, 14.0, 10.0, seed=6)
    _write(out / "labels.nii.gz", labels * (labels < 4), grid, kind="int16")
    for name, values in (("t1", t1[labels]), ("t2", td.warp(t2[labels], u, grid))):
        _write(out / f"{name}.nii.gz", (values + 3 * _noise(grid.shape, 0.7, 7)).clamp(min=0), grid)


def bones(out: Path) -> None:
    """A femur and a tibia that turn against each other, with labels: 1 femur, 2 tibia."""
    _write_tissue(out, "bones")


def breast(out: Path) -> None:
    """A breast whose lesion fills with contrast and moves, with the lesion as label 1."""
    _write_tissue(out, "lesion")


def breathing(out: Path) -> None:
    """A frontal slice of a chest, breathed out and in, with what glides along the ribs as label 1."""
    _write_tissue(out, "breathing")


def _write_tissue(out: Path, kind: str) -> None:
    """Write a phantom of the benchmark of tissue."""
    import tissue_phantoms

    phantom = getattr(tissue_phantoms, kind)()
    for name, values in (("fixed", phantom.fixed), ("moving", phantom.moving)):
        _write(out / f"{name}.nii.gz", values, phantom.grid)
    _write(out / "tissue.nii.gz", phantom.tissue, phantom.grid, kind="int16")


def _brain_labels(grid: td.Grid) -> Tensor:
    """Return 0 outside, 1 ventricles, 2 white matter, 3 cortex, 4 skull."""
    unit = 2 * grid.points() / grid.along(grid.extent, grid.points()) - 1
    radius = unit.square().sum(1, keepdim=True).sqrt()
    folds = 0.06 * torch.cos(14 * unit[:, -1:]) * torch.cos(13 * unit[:, -2:-1] + 1) + 0.02 * _noise(grid.shape, 2.5, 5)
    centre = ((unit[:, -1:].abs() - 0.12) / 0.09) ** 2 + (unit[:, -2:-1] / 0.3) ** 2
    ventricles = centre + sum((unit[:, k : k + 1] / 0.3) ** 2 for k in range(grid.dim - 2)) < 1
    labels = torch.zeros_like(radius, dtype=torch.long)
    labels[radius < 0.93] = 4
    labels[radius < 0.84] = 0
    labels[radius < 0.78 + 0.5 * folds] = 3
    labels[radius < 0.6 + folds] = 2
    labels[ventricles] = 1
    return labels


def _noise(shape: tuple[int, ...], sigma: float, seed: int) -> Tensor:
    """Return smooth noise ``(1, 1, *S)`` with standard deviation 1."""
    values = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), sigma)
    return torch.tensor(values / values.std()).float()[None, None]


def _random_map(grid: td.Grid, length: float, sigma: float, seed: int) -> Tensor:
    """Return the displacement of a smooth flow that moves nodes by about ``length`` in units of spacing."""
    unit = grid.points() / grid.along(grid.extent, grid.points())
    window = torch.sin(math.pi * unit).prod(1, keepdim=True)
    v = torch.cat([_noise(grid.shape, sigma, 10 * seed + k) for k in range(grid.dim)], dim=1)
    return td.integrate(0.5 * length * window * v, grid)


def _turn(grid: td.Grid, angle: float) -> Tensor:
    """Return the displacement of a rotation about the middle of a picture."""
    x = grid.points()
    from_middle = x - grid.along(grid.extent, x) / 2
    a, b = from_middle.split(1, dim=1)
    turned = (math.cos(angle) * a - math.sin(angle) * b, math.sin(angle) * a + math.cos(angle) * b)
    return torch.cat(turned, dim=1) - from_middle


def _inside(grid: td.Grid, u: Tensor) -> Tensor:
    """Return 1 where x + u lies on the picture."""
    place = grid.points() + u
    return ((place >= 0) & (place <= grid.along(grid.extent, place))).all(1, keepdim=True).float()


def _write(path: Path, values: Tensor, grid: td.Grid, *, kind: str = "float32", origin: tuple[float, ...] = ()) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    td.write_image(td.Image(values.float(), grid, origin, pixel_type=kind), path)


KINDS = {
    "brains": brains,
    "lungs": lungs,
    "hearts": hearts,
    "histology": histology,
    "contrasts": contrasts,
    "bones": bones,
    "breast": breast,
    "breathing": breathing,
}


def main(names: list[str]) -> None:
    """Make the images of the pages that are named."""
    if not names or not set(names) <= set(KINDS):
        sys.exit(f"name some of {', '.join(KINDS)}")
    for name in names:
        KINDS[name](Path(name))


if __name__ == "__main__":
    main(sys.argv[1:])
