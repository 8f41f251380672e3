"""Register pairs of real images with this project and with other tools, from the raw files, and judge the maps alike.

    python scripts/benchmarks/peers.py --sets mouse_brain_3d --tools torchdeform greedy ants_syncc --json peers.json

Each run is a process of its own with two threads; the tools take turns pair by pair, so that a machine that drifts is
fair to all. A tool hands over its map as positions φ(x) of the fixed voxels: it resamples images whose values are the
coordinates of the moving space, so its own resampler says where it takes points. Labels are carried by one
nearest-neighbour code for all. Seconds count from the first call into the tool, files read and imports done, to its
map. Folds are those of the map, by central differences and by the full certificate; a table in Markdown is printed.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from statistics import mean, median
from time import perf_counter
from typing import Any

import numpy as np
import SimpleITK as sitk
from pairs import SETS, Pair

_REACH = 0.5  # the images of coordinates reach this share of the moving image beyond its sides
_THREADS = "2"

Register = Callable[[sitk.Image, sitk.Image, Path], Callable[[sitk.Image], sitk.Image]]


def read_grey(path: Path) -> sitk.Image:
    """Return an image with one channel of float32."""
    image = sitk.ReadImage(str(path))
    if image.GetNumberOfComponentsPerPixel() > 1:
        red, green, blue = (sitk.VectorIndexSelectionCast(image, k, sitk.sitkFloat32) for k in range(3))
        image = 0.299 * red + 0.587 * green + 0.114 * blue
    return sitk.Cast(image, sitk.sitkFloat32)


def coordinates(moving: sitk.Image) -> list[sitk.Image]:
    """Return images of the world's x, y (and z) on a coarse grid that reaches beyond the moving image."""
    size, nodes = np.array(moving.GetSize(), dtype=float), 33
    spacing = (1 + 2 * _REACH) * size / (nodes - 1) * moving.GetSpacing()
    origin = moving.TransformContinuousIndexToPhysicalPoint((-_REACH * size).tolist())
    place = [nodes] * len(size), origin, spacing.tolist(), moving.GetDirection()
    points = sitk.PhysicalPointSource(sitk.sitkVectorFloat32, *place)
    return [sitk.VectorIndexSelectionCast(points, k) for k in range(len(size))]


def ants_tool(kind: str) -> Register:
    """ANTsPy's `registration` as it comes, affine included."""

    def register(fixed: sitk.Image, moving: sitk.Image, folder: Path) -> Callable[[sitk.Image], sitk.Image]:
        ants = import_module("ants")

        def convert(image: sitk.Image, name: str) -> Any:
            sitk.WriteImage(image, str(folder / f"{name}.nii.gz"))
            return ants.image_read(str(folder / f"{name}.nii.gz"))

        still, other = convert(fixed, "fixed"), convert(moving, "moving")
        found = ants.registration(still, other, type_of_transform=kind)

        def resample(image: sitk.Image) -> sitk.Image:
            out = ants.apply_transforms(still, convert(image, "coordinate"), found["fwdtransforms"], defaultvalue=1e6)
            ants.image_write(out, str(folder / "out.nii.gz"))
            return sitk.ReadImage(str(folder / "out.nii.gz"), sitk.sitkFloat32)

        return resample

    return register


def greedy_tool(metric: str, options: str = "", affine_metric: str = "NMI", moments: int = 0) -> Register:
    """Greedy: moments of this order or the centres of the images, affine, then its deformable stage."""

    def register(fixed: sitk.Image, moving: sitk.Image, folder: Path) -> Callable[[sitk.Image], sitk.Image]:
        picsl_greedy = import_module("picsl_greedy")

        dim = fixed.GetDimension()
        tool = {2: picsl_greedy.Greedy2D, 3: picsl_greedy.Greedy3D}[dim]()
        names = [str(folder / f"{name}.nii.gz") for name in ("fixed", "moving")]
        for image, name in zip((fixed, moving), names, strict=True):
            sitk.WriteImage(image, name)
        pair, threads = " ".join(names), f"-threads {_THREADS}"
        affine, warp, start = folder / "affine.mat", folder / "warp.nii.gz", "-ia-image-centers"
        if moments:
            start = f"-ia {folder / 'moments.mat'}"
            tool.execute(f"-moments {moments} -i {pair} -o {folder / 'moments.mat'} {threads}")
        tool.execute(f"-a -dof 12 -m {affine_metric} -n 100x50x10 -i {pair} {start} -o {affine} {threads}")
        tool.execute(f"-m {metric} -n 100x50x20 {options} -i {pair} -it {affine} -o {warp} {threads}")

        def resample(image: sitk.Image) -> sitk.Image:
            source, target = folder / "coordinate.nii.gz", folder / "out.nii.gz"
            sitk.WriteImage(image, str(source))
            tool.execute(f"-rf {names[0]} -rb 1e6 -rm {source} {target} -r {warp} {affine} {threads}")
            return sitk.ReadImage(str(target), sitk.sitkFloat32)

        return resample

    return register


def torchdeform_tool(preset: str) -> Register:
    """This project's `register` on files, alignment included."""

    def register(fixed: sitk.Image, moving: sitk.Image, folder: Path) -> Callable[[sitk.Image], sitk.Image]:
        from torchdeform.cli import main

        names = [str(folder / f"{name}.nii.gz") for name in ("fixed", "moving")]
        for image, name in zip((fixed, moving), names, strict=True):
            sitk.WriteImage(image, name)
        if main([*names, "--out", str(folder / "out"), "--preset", preset, "--quiet"]):
            raise SystemExit(1)
        transform = sitk.ReadTransform(str(folder / "out" / "transform.h5"))
        return lambda image: sitk.Resample(image, fixed, transform, sitk.sitkLinear, 1e6)

    return register


TOOLS: dict[str, Register] = {
    "torchdeform": torchdeform_tool("default"),
    "torchdeform_fast": torchdeform_tool("fast"),
    "greedy": greedy_tool("NCC 2x2x2"),
    "greedy_ncc": greedy_tool("NCC 2x2x2", affine_metric="NCC 2x2x2"),
    "greedy_moments": greedy_tool("NCC 2x2x2", moments=1),
    "greedy_moments_2": greedy_tool("NCC 2x2x2", moments=2),
    "greedy_wncc": greedy_tool("WNCC 2x2x2", "-sv"),
    "ants_syn": ants_tool("SyN"),
    "ants_syncc": ants_tool("SyNCC"),
    "ants_affine": ants_tool("Affine"),
}


def run_one(name: str, pair: Pair) -> dict[str, float]:
    """Register a pair in this process and judge the map."""
    fixed, moving = read_grey(pair.fixed), read_grey(pair.moving)
    with tempfile.TemporaryDirectory() as folder:
        start = perf_counter()
        resample = TOOLS[name](fixed, moving, Path(folder))
        seconds = perf_counter() - start
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        moved = [sitk.GetArrayFromImage(resample(image)) for image in coordinates(moving)]
    positions = np.stack(moved, axis=-1).astype(np.float64)
    return {"seconds": seconds, "GiB": memory} | judge(pair, fixed, positions)


def judge(pair: Pair, fixed: sitk.Image, positions: np.ndarray) -> dict[str, float]:
    """Return overlap, landmark error and folds of a map given as ``(*S, D)`` world positions."""
    figures = folds(fixed, positions)
    if pair.fixed_labels and pair.moving_labels:
        figures |= overlap(pair.fixed_labels, pair.moving_labels, positions)
    if pair.fixed_points and pair.moving_points:
        figures |= landmarks((pair.fixed_points, pair.moving_points), fixed, positions)
    return figures


def overlap(fixed_path: Path, moving_path: Path, positions: np.ndarray) -> dict[str, float]:
    """Return the mean Dice over the labels that both images have, before (in place) and after."""
    fixed, moving = sitk.ReadImage(str(fixed_path)), sitk.ReadImage(str(moving_path))
    first = sitk.GetArrayFromImage(fixed).reshape(*positions.shape[:-1], -1)[..., 0]
    second = sitk.GetArrayFromImage(moving)
    second = second.reshape(*moving.GetSize()[::-1], -1)[..., 0]
    direction = np.array(moving.GetDirection()).reshape(len(moving.GetSize()), -1)
    index = (positions - moving.GetOrigin()) @ np.linalg.inv(direction).T / moving.GetSpacing()
    index = np.rint(index).astype(int)[..., ::-1]
    inside = ((index >= 0) & (index < second.shape)).all(-1)
    carried = np.where(inside, second[tuple(np.moveaxis(np.where(inside[..., None], index, 0), -1, 0))], 0)
    common = (set(np.unique(first)) & set(np.unique(second))) - {0}
    return {
        "dice": mean(
            2 * ((first == k) & (carried == k)).sum() / ((first == k).sum() + (carried == k).sum()) for k in common
        )
    }


def read_points(path: Path) -> dict[str, np.ndarray]:
    """Return points by name: elastix' text (world), or `number,X,Y` in pixels of size 1."""
    lines = path.read_text(encoding="utf-8").split("\n")
    if path.suffix == ".csv":
        rows = [line.split(",") for line in lines[1:] if line.strip()]
        return {row[0]: np.array(row[1:], dtype=float) for row in rows}
    return {str(k): np.array(line.split(), dtype=float) for k, line in enumerate(lines[2:]) if line.strip()}


def landmarks(files: tuple[Path, Path], fixed: sitk.Image, positions: np.ndarray) -> dict[str, float]:
    """Return mean and median distance of the moved fixed points from their partners."""
    first, second = map(read_points, files)
    names = [name for name in first if name in second]
    frame = sitk.GetImageFromArray(positions, isVector=True)
    frame.CopyInformation(fixed)
    errors = []
    for name in names:
        index = np.clip(fixed.TransformPhysicalPointToContinuousIndex(first[name]), 0, np.array(fixed.GetSize()) - 1)
        place = fixed.TransformContinuousIndexToPhysicalPoint(index.tolist())
        errors.append(float(np.linalg.norm(frame.EvaluateAtPhysicalPoint(place) - second[name])))
    return {"landmark_mean": mean(errors), "landmark_median": median(errors)}


def folds(fixed: sitk.Image, positions: np.ndarray) -> dict[str, float]:
    """Return folds by central differences and by the certificate, and the deviation of log J."""
    import torch

    import torchdeform as td

    dim = fixed.GetDimension()
    direction = np.array(fixed.GetDirection()).reshape(dim, dim)
    own = ((positions - fixed.GetOrigin()) @ np.linalg.inv(direction).T)[..., ::-1]
    grid = td.Grid(fixed.GetSize()[::-1], fixed.GetSpacing()[::-1])
    phi = torch.from_numpy(np.moveaxis(own, -1, 0).copy())[None]
    found = td.diagnose(phi - grid.points(dtype=phi.dtype), grid)
    return {
        "folds": float(found.folds),
        "central_folds": float(found.central_folds),
        "log_det_std": float(found.det_log_std),
    }


def run_apart(name: str, pair: Pair) -> dict[str, Any]:
    """Run one tool on one pair in a process of its own."""
    threads = ("OMP_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS", "MKL_NUM_THREADS")
    files = {key: str(value) for key, value in asdict(pair).items() if value is not None}
    command = [sys.executable, __file__, "--one", name, json.dumps(files)]
    environment = os.environ | dict.fromkeys(threads, _THREADS)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    try:
        return json.loads(done.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        return {"failed": (done.stderr.strip().splitlines() or ["no output"])[-1]}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return mean quality and median cost of each set and tool as Markdown."""
    columns = ("dice", "landmark_mean", "landmark_median", "folds", "central_folds", "log_det_std", "seconds", "GiB")
    lines = ["| set | tool | pairs | " + " | ".join(columns) + " |", "|---" * (len(columns) + 3) + "|"]
    for which, tool in dict.fromkeys((row["set"], row["tool"]) for row in rows):
        own = [row for row in rows if (row["set"], row["tool"]) == (which, tool) and "failed" not in row]
        cells = []
        for column in columns:
            values = [row[column] for row in own if column in row]
            summary = median if column in ("seconds", "GiB") else mean
            cells.append(f"{summary(values):.4g}" if values else "")
        lines.append(f"| {which} | {tool} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run all and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", default=os.environ.get("TORCHDEFORM_DATA", "../shared/data"), type=Path)
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    parser.add_argument("--tools", nargs="+", default=list(TOOLS), choices=list(TOOLS))
    parser.add_argument("--json", type=Path, help="file for the figures of every run")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        name, files = options.one[0], json.loads(options.one[1])
        print(json.dumps(run_one(name, Pair(files.pop("name"), **{k: Path(v) for k, v in files.items()}))))
        return
    rows = []
    for which in options.sets:
        for pair in SETS[which](options.data / which):
            for tool in options.tools:
                rows.append({"set": which, "tool": tool, "pair": pair.name} | run_apart(tool, pair))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
                if options.json:
                    options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(table(rows))


if __name__ == "__main__":
    main()
