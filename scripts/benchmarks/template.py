"""How close a template is to the image whose warps it is made of: prints the tables of docs/templates.md.

    python scripts/benchmarks/template.py [--quick] [--rounds 3]
    python scripts/benchmarks/template.py --picture docs/templates.png

An image I is warped to I_i = I ∘ T_i by six flows T_i of velocities that sum to 0, so that the mean of the T_i and that
of their inverses is the identity as flows. The template of the I_i should be I. For each i a template is built that
begins at I_i; its ratio is |template − I|² / |I_i − I|², sums over all nodes. Nothing but the I_i is known to it.
"""

import argparse
import math
import os
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import torchdeform as td  # noqa: E402
from torchdeform.core.image import luminance  # noqa: E402
from torchdeform.core.interpolation import interpolator  # noqa: E402
from torchdeform.core.resampling import restrict  # noqa: E402
from torchdeform.core.warp import max_voxels, voxels  # noqa: E402
from torchdeform.registration.template import Template, average_shape, build_template  # noqa: E402
from torchdeform.report.figures import write_gallery  # noqa: E402

COUNT = 6
SHARES = (0.06, 0.12)  # longest velocity over the longest side
PUBLISHED = (1.114, 0.349, 0.274)


def velocities(grid: td.Grid, size: float, seed: int = 0) -> list[Tensor]:
    """Return six smooth velocities that vanish on the faces and sum to 0, the longest ``size`` voxels long."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.empty(0, dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    fields = [_waves(unit, generator) for _ in range(COUNT)]
    mean = torch.stack(fields).mean(0)
    scale = size / max(float(max_voxels(v - mean, grid)) for v in fields)
    return [(v - mean) * scale for v in fields]


def _waves(unit: Tensor, generator: torch.Generator) -> Tensor:
    """Return a sum of sines of one to three half waves along each axis, longer ones stronger."""
    dim = unit.shape[1]
    sines = [torch.sin(math.pi * wave * unit) for wave in (1, 2, 3)]
    total = torch.zeros_like(unit)
    for index in torch.cartesian_prod(*[torch.arange(3)] * dim).tolist():
        shape = torch.stack([sines[w][:, axis] for axis, w in enumerate(index)]).prod(0).unsqueeze(1)
        weight = torch.randn(1, dim, *[1] * dim, generator=generator, dtype=torch.float64)
        total += shape * weight / sum((w + 1) ** 2 for w in index)
    return total


def warped(image: Tensor, u: Tensor, grid: td.Grid) -> Tensor:
    """Return the image seen through id + u, by cubic splines."""
    return interpolator(image, grid, mode="cubic", outside=None)(grid.points(dtype=torch.float64) + u)


def pictures(quick: bool) -> dict[str, td.Image]:
    """Return the images to warp: the shipped one, and a brain slice where there are real images."""
    eye = luminance(td.read_image(ROOT / "examples" / "fixed.png"))
    half = td.Grid((128, 128), tuple(side / 127 for side in eye.grid.extent))
    small = replace(eye, data=restrict(eye.data, eye.grid, half), grid=td.Grid((128, 128)))
    found = {"eye, 128²": small}
    if not quick:
        found["eye, 256²"] = eye
        slices = Path(os.environ.get("TORCHDEFORM_DATA", ROOT.parent / "shared" / "data")) / "mindboggle_2d"
        if slices.is_dir():
            found["brain slice, 216×291"] = luminance(td.read_image(slices / "subject1.nii.gz"))
    return found


def ratio(found: Tensor, start: Tensor, truth: Tensor) -> float:
    """Return |found − truth|² / |start − truth|²."""
    return float((found.double() - truth).square().sum() / (start.double() - truth).square().sum())


def root_sum_square(values: Iterable[float]) -> float:
    """Return the norm of the six ratios."""
    return math.hypot(*values)


def warps(image: td.Image, share: float) -> tuple[list[Tensor], list[td.Image]]:
    """Return the maps T_i, the longest velocity being that share of the longest side, and the images I ∘ T_i."""
    grid, truth = image.grid, image.data.double()
    maps = [td.integrate(v, grid, steps=20) for v in velocities(grid, share * max(grid.shape))]
    return maps, [replace(image, data=warped(truth, u, grid).float(), name=f"warp {i}") for i, u in enumerate(maps)]


def draw(path: Path) -> None:
    """Draw one warp, the plain mean of all, the template after a round that begins at that warp, and the image."""
    image = pictures(True)["eye, 128²"]
    _, images = warps(image, SHARES[-1])
    template = build_template(images, td.load_settings(overrides={"align": "none"}), rounds=1)
    panels = {
        "one of six warps": images[0],
        "their mean": replace(image, data=torch.cat([i.data for i in images]).mean(0, keepdim=True)),
        "their template, one round": template.image,
        "the image they were made from": image,
    }
    write_gallery(path, panels)


def experiment(image: td.Image, share: float, rounds: int) -> Iterable[list[str]]:
    """Yield a row for each number of rounds: how near the templates come to the image."""
    grid, truth = image.grid, image.data.double()
    maps, images = warps(image, share)
    dets = [td.diagnose(u, grid) for u in maps]
    low, high = min(float(d.det_min) for d in dets), max(float(d.det_max) for d in dets)
    about = f"{max(float(max_voxels(u, grid)) for u in maps):.0f} pixels, {low:.2f} to {high:.2f}"
    settings = td.load_settings(overrides={"align": "none"})
    current: Sequence[td.Image] = images
    for number in range(1, rounds + 1):
        start = time.perf_counter()
        made = [build_template(images, settings, rounds=1, reference=reference) for reference in current]
        taken = (time.perf_counter() - start) / COUNT
        yield [about, str(number), *_figures(made, images, truth), f"{taken:.0f} s"]
        current = [template.image for template in made]


def _figures(made: Sequence[Template], images: Sequence[td.Image], truth: Tensor) -> list[str]:
    """Return root-sum-square, largest ratio, and how much the six templates differ among each other."""
    ratios = [ratio(t.image.data, image.data, truth) for t, image in zip(made, images, strict=True)]
    stack = torch.cat([t.image.data.double() for t in made])
    spread = (stack - stack.mean(0)).square().sum(dim=(1, 2, 3)).mean()
    before = torch.cat([i.data.double() for i in images])
    apart = (before - before.mean(0)).square().sum(dim=(1, 2, 3)).mean()
    return [f"{root_sum_square(ratios):.4f}", f"{max(ratios):.4f}", f"{float(spread / apart):.1e}"]


def means(image: td.Image, share: float) -> Iterable[list[str]]:
    """Yield how far averages of the true maps from I_1 end from T_1, by determinants and curls and by displacements."""
    grid = image.grid
    place = replace(image, data=image.data.double())
    flows = velocities(grid, share * max(grid.shape))
    there, back = ([td.integrate(sign * v, grid, steps=20) for v in flows] for sign in (1, -1))
    fields = [td.compose(u, there[0], grid) for u in back]
    whole = average_shape([td.Transform.from_displacement(u, place) for u in fields], place).displacement
    ways = {"displacements": torch.stack(fields).mean(0), "determinants and curls": whole}
    for name, found in ways.items():
        off = voxels(found - there[0], grid)
        yield [f"{share:.2f}", name, f"{float(off.mean()):.3f}", f"{float(off.max()):.3f}"]


def table(title: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print rows as they come."""
    print(f"\n{title}\n\n| {' | '.join(head)} |\n|{' --- |' * len(head)}", flush=True)
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description="How close a template is to the image whose warps it is made of.")
    parser.add_argument("--quick", action="store_true", help="the small image only")
    parser.add_argument("--rounds", type=int, default=3, help="rounds at most")
    parser.add_argument("--picture", type=Path, help="draw this picture only")
    options = parser.parse_args()
    if options.picture:
        draw(options.picture)
        return
    head = ["largest move, determinants", "round", "root-sum-square", "largest ratio", "differences left", "a template"]
    for name, image in pictures(options.quick).items():
        for share in SHARES:
            table(f"{name} (published: {PUBLISHED})", head, experiment(image, share, options.rounds))
    small = pictures(True)["eye, 128²"]
    head = ["longest velocity / width", "average of the true maps", "off by, mean", "off by, largest (voxels)"]
    table("Averages of exact maps", head, (row for share in (*SHARES, 0.2) for row in means(small, share)))


if __name__ == "__main__":
    main()
