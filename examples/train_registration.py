"""Train a network that registers images without labels, by a map that cannot fold, and compare it.

    python examples/train_registration.py configs/training_heart_2d.yaml --out runs/heart
    torchrun --nproc_per_node=2 examples/train_registration.py configs/training_heart_2d.yaml --out runs/heart

A small U-Net looks at both images; its head is `JacobianCurlHead`. A twin of the same size, whose head is a plain
displacement, is trained likewise. At the end both, no registration at all and `torchdeform.register` are compared on
patients that were held back: Dice of labels that training never saw, and folds by the full certificate. The images are
those of TORCHDEFORM_DATA (../shared/data by default). Started again, it goes on where it stopped. Needs
``pip install "torchdeform[training]"``.
"""

import argparse
import csv
import math
import os
import time
from dataclasses import dataclass, fields
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any

import lightning
import torch
import torch.nn.functional as F
import yaml
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from matplotlib.figure import Figure
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

import torchdeform as td
from torchdeform.core.image import luminance
from torchdeform.nn import (
    CurlLoss,
    DivergenceLoss,
    JacobianCurlHead,
    RandomDeformation,
    SimilarityLoss,
    SpatialTransformer,
)

CONV = {2: nn.Conv2d, 3: nn.Conv3d}
NORM = {2: nn.InstanceNorm2d, 3: nn.InstanceNorm3d}
UPSAMPLING = {2: "bilinear", 3: "trilinear"}


@dataclass(frozen=True)
class Settings:
    """The settings in a file of configs/."""

    data: str
    shape: tuple[int, ...]
    held_back: tuple[str, ...]
    heads: tuple[str, ...]
    channels: tuple[int, ...]
    stride: int
    ratio: float
    curl: float
    similarity: str
    window: int
    weight_div: float
    weight_curl: float
    batch_size: int
    steps: int
    learning_rate: float
    seed: int

    @property
    def grid(self) -> td.Grid:
        """The grid of the images, in voxels."""
        return td.Grid(tuple(self.shape))

    @staticmethod
    def load(path: Path, changes: list[str]) -> "Settings":
        """Read a file, with ``name=value`` changes; unknown and missing names are refused."""
        values: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
        for change in changes:
            name, _, value = change.partition("=")
            values[name] = yaml.safe_load(value)
        known = {field.name for field in fields(Settings)}
        if wrong := known ^ set(values):
            raise SystemExit(f"{path}: these settings are unknown or missing: {', '.join(sorted(wrong))}")
        lists: dict[str, Any] = {name: tuple(v) for name, v in values.items() if isinstance(v, list)}
        return Settings(**(values | lists))


@dataclass(frozen=True)
class Scan:
    """An image between about 0 and 1 and its labels, ``(1, *S)`` both."""

    patient: str
    name: str
    image: Tensor
    labels: Tensor


Pair = tuple[Scan, Scan]  # fixed, moving


def read(path: Path, labels: Path, patient: str, shape: tuple[int, ...]) -> Scan:
    image, mask = (luminance(td.read_image(p)).data[0] for p in (path, labels))
    low, high = image.quantile(0.005), image.quantile(0.995)
    return Scan(patient, path.name, fit((image - low) / (high - low), shape), fit(mask, shape))


def fit(values: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Pad ``(1, *S)`` with zeros, or cut it, to the shape, the middle staying in the middle."""
    sides = []
    for wanted, there in zip(reversed(shape), reversed(values.shape[1:]), strict=True):
        sides += [(wanted - there) // 2, wanted - there - (wanted - there) // 2]
    return F.pad(values, sides)


def hearts(folder: Path, shape: tuple[int, ...]) -> list[Pair]:
    """End-diastole stays, end-systole moves."""
    pairs = []
    for path in sorted(folder.glob("*_ED.png")):
        files = [path, path.with_name(path.name.replace("_ED", "_ES"))]
        patient = path.name.split("_slice")[0]
        fixed, moving = (read(f, f.with_name(f.stem + "_label.png"), patient, shape) for f in files)
        pairs.append((fixed, moving))
    return pairs


def hippocampi(folder: Path, shape: tuple[int, ...]) -> list[Pair]:
    """Every subject to every other one."""
    files = sorted(f for f in folder.glob("*.nii.gz") if "_labels" not in f.name)
    names = [f.name.removesuffix(".nii.gz") for f in files]
    scans = [read(f, folder / f"{n}_labels.nii.gz", n, shape) for f, n in zip(files, names, strict=True)]
    return list(permutations(scans, 2))


SETS = {"heart_2d": hearts, "hippocampus_3d": hippocampi}


class Pairs(Dataset):
    """Pairs of images for training, ``(2, *S)`` each: no labels."""

    def __init__(self, pairs: list[Pair], length: int) -> None:
        self.images = [torch.cat([fixed.image, moving.image]) for fixed, moving in pairs]
        self.length = length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Tensor:
        return self.images[index % len(self.images)]


class UNet(nn.Module):
    """A U-Net of two convolutions a level; its features are ``stride`` voxels apart."""

    def __init__(self, dim: int, channels: tuple[int, ...], stride: int) -> None:
        super().__init__()
        self.mode = UPSAMPLING[dim]
        self.down = nn.ModuleList()
        for level, (before, after) in enumerate(zip((2, *channels), channels, strict=False)):
            self.down.append(block(dim, before, after, stride if level == 0 else 2))
        coarse = list(channels[::-1])
        self.up = nn.ModuleList(block(dim, a + b, b, 1) for a, b in pairwise(coarse))

    def forward(self, pair: Tensor) -> Tensor:
        skips = []
        for down in self.down:
            pair = down(pair)
            skips.append(pair)
        features = skips.pop()
        for up in self.up:
            skip = skips.pop()
            features = F.interpolate(features, size=skip.shape[2:], mode=self.mode, align_corners=True)
            features = up(torch.cat([features, skip], dim=1))
        return features


def block(dim: int, before: int, after: int, stride: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels, step in ((before, stride), (after, 1)):
        layers += [CONV[dim](channels, after, 3, step, 1), NORM[dim](after, affine=True), nn.LeakyReLU(0.2)]
    return nn.Sequential(*layers)


class DisplacementHead(nn.Module):
    """The usual head, for comparison: a convolution to a displacement in voxels, interpolated to the grid."""

    def __init__(self, channels: int, grid: td.Grid) -> None:
        super().__init__()
        self.grid = grid
        self.conv = CONV[grid.dim](channels, grid.dim, 3, padding=1)
        nn.init.normal_(self.conv.weight, std=1e-2)
        nn.init.zeros_(self.conv.bias)

    def forward(self, features: Tensor) -> Tensor:
        return F.interpolate(
            self.conv(features), size=self.grid.shape, mode=UPSAMPLING[self.grid.dim], align_corners=True
        )


def make_head(name: str, settings: Settings) -> nn.Module:
    channels, grid = settings.channels[0], settings.grid
    if name == "jacobian_curl":
        return JacobianCurlHead(channels, grid, ratio=settings.ratio, curl=settings.curl)
    if name == "displacement":
        return DisplacementHead(channels, grid)
    raise SystemExit(f"heads must be jacobian_curl or displacement, got {name!r}")


class Registration(lightning.LightningModule):
    """Fixed and moving image -> displacement u; loss = −S(fixed, moving ∘ φ) + prices of divergence and curl."""

    def __init__(self, head: str, settings: Settings) -> None:
        super().__init__()
        grid, self.settings = settings.grid, settings
        self.network = UNet(grid.dim, settings.channels, settings.stride)
        self.head = make_head(head, settings)
        options = {"window": settings.window} if settings.similarity == "lncc" else {}
        self.similarity = SimilarityLoss(settings.similarity, **options)
        self.warp = SpatialTransformer(grid)
        self.div, self.turn = DivergenceLoss(grid), CurlLoss(grid)
        self.augment = RandomDeformation(grid, determinant=(0.6, 1.6), curl=0.3, nodes=6)

    def forward(self, fixed: Tensor, moving: Tensor) -> Tensor:
        return self.head(self.network(torch.cat([fixed, moving], dim=1)))

    def training_step(self, pair: Tensor, index: int) -> Tensor:
        fixed, moving = self.vary(pair)
        u = self(fixed, moving)
        similarity = self.similarity(fixed, self.warp(moving, u))
        loss = similarity + self.settings.weight_div * self.div(u) + self.settings.weight_curl * self.turn(u)
        self.log_dict({"loss": loss.detach(), "similarity": -similarity.detach()}, prog_bar=True)
        return loss

    @torch.no_grad()
    def vary(self, pair: Tensor) -> tuple[Tensor, Tensor]:
        """Turn pairs over, exchange their images, and bend both images alike."""
        for axis in range(2, pair.dim()):
            if torch.rand(()) < 0.5:
                pair = pair.flip(axis)
        if torch.rand(()) < 0.5:
            pair = pair.flip(1)
        fixed, moving = pair[:, :1], pair[:, 1:]
        maps = self.augment.draw(len(pair), like=pair)
        fixed, moving = self.augment(fixed, maps=maps), self.augment(moving, maps=maps)
        return fixed, moving

    def configure_optimizers(self) -> dict[str, Any]:
        optimizer = torch.optim.Adam(self.parameters(), lr=self.settings.learning_rate)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, self.pace)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def pace(self, step: int) -> float:
        """Return the share of the learning rate: up over the first tenth of the steps, then down along a cosine."""
        done = min(1.0, step / self.settings.steps)
        return min(1.0, 10 * done + 0.01) * (1 + math.cos(math.pi * done)) / 2


class Pictures(lightning.Callback):
    """A picture of the first held-back pair, every so many steps: files, and TensorBoard where that is installed."""

    def __init__(self, pair: Pair, folder: Path, every: int) -> None:
        self.pair, self.folder, self.every = pair, folder, every

    def on_train_batch_end(self, trainer: lightning.Trainer, module: Any, *_: Any) -> None:
        step = trainer.global_step
        if not trainer.is_global_zero or step % self.every:
            return
        figure = draw(self.pair, module)
        self.folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(self.folder / f"{step:06d}.png", dpi=80)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_figure("held back", figure, step)


@torch.no_grad()
def draw(pair: Pair, module: Registration) -> Figure:
    """Show fixed, moving and warped image, what is left between them, and the determinant, in the middle slice."""
    fixed, moving = (scan.image[None].to(module.device) for scan in pair)
    u = module(fixed, moving)
    warped = module.warp(moving, u)
    panels = {
        "fixed": (fixed, "gray", (0, 1)),
        "moving": (moving, "gray", (0, 1)),
        "warped": (warped, "gray", (0, 1)),
        "fixed − warped": (fixed - warped, "RdBu", (-0.5, 0.5)),
        "determinant": (td.jacobian_determinant(u, module.settings.grid), "PuOr", (0, 2)),
    }
    figure = Figure(figsize=(3 * len(panels), 3), layout="tight")
    for axes, (title, (values, colours, limits)) in zip(figure.subplots(1, len(panels)), panels.items(), strict=True):
        flat = values[0, 0].cpu()
        flat = flat[len(flat) // 2] if flat.dim() == 3 else flat
        axes.imshow(flat, cmap=colours, vmin=limits[0], vmax=limits[1])
        axes.set_title(title)
        axes.set_axis_off()
    return figure


def train(head: str, settings: Settings, pairs: list[Pair], show: Pair, out: Path) -> Registration:
    """Train one head, or go on with it, and return the network."""
    lightning.seed_everything(settings.seed, verbose=False)
    module = Registration(head, settings)
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    loggers: list[Logger] = [CSVLogger(out, name="log")]
    if tensorboard_is_there():
        loggers.append(TensorBoardLogger(out, name="tensorboard"))
    every = max(1, settings.steps // 10)
    trainer = lightning.Trainer(
        default_root_dir=out,
        devices=int(os.environ.get("LOCAL_WORLD_SIZE", "1")),
        num_nodes=processes // int(os.environ.get("LOCAL_WORLD_SIZE", "1")),
        accelerator="gpu" if torch.cuda.is_available() else "cpu",
        strategy="ddp" if processes > 1 else "auto",
        max_steps=settings.steps,
        gradient_clip_val=1.0,
        logger=loggers,
        log_every_n_steps=min(10, every),
        callbacks=[
            ModelCheckpoint(out, save_last=True, save_top_k=0, every_n_train_steps=every),
            Pictures(show, out / "pictures", every),
        ],
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    data = Pairs(pairs, settings.batch_size * every * processes)
    loader = DataLoader(data, settings.batch_size, shuffle=True)
    last = out / "last.ckpt"
    begin = time.process_time()
    trainer.fit(module, loader, ckpt_path=str(last) if last.exists() else None, weights_only=False)
    trainer.print(f"{head}: step {trainer.global_step}, {(time.process_time() - begin) / 60:.1f} CPU minutes")
    return module


def tensorboard_is_there() -> bool:
    from importlib.util import find_spec

    return find_spec("tensorboard") is not None


def dice(fixed: Tensor, warped: Tensor) -> float:
    """Return the mean Dice over the labels of the fixed image."""
    labels = [label for label in fixed.unique().tolist() if label != 0]
    scores = [
        2 * float(((fixed == x) & (warped == x)).sum()) / float((fixed == x).sum() + (warped == x).sum())
        for x in labels
    ]
    return sum(scores) / len(scores)


@torch.no_grad()
def judge(pairs: list[Pair], networks: dict[str, Registration], grid: td.Grid) -> list[dict[str, Any]]:
    """Return Dice and folds of every pair for every way to register it."""
    rows = []
    carry = SpatialTransformer(grid)
    for fixed, moving in pairs:
        images = fixed.image[None], moving.image[None]
        ways = {"unregistered": lambda a, b: torch.zeros(1, grid.dim, *grid.shape)}
        ways |= {name: network.cpu().eval() for name, network in networks.items()}
        ways["register"] = lambda a, b: td.register(a, b).displacement
        for name, way in ways.items():
            begin = time.process_time()
            u = way(*images)
            seconds = time.process_time() - begin
            score = dice(fixed.labels[None], carry.label(moving.labels[None], u))
            folds = int(td.diagnose(u, grid).folds)
            rows.append(
                {"way": name, "fixed": fixed.name, "moving": moving.name, "dice": score, "folds": folds, "s": seconds}
            )
    return rows


def report(rows: list[dict[str, Any]], out: Path) -> None:
    """Write all rows to comparison.csv and print the means."""
    with (out / "comparison.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    titles = "held back, mean", "Dice", "folded nodes", "pairs with folds", "CPU seconds a pair"
    print("|", " | ".join(titles), "|\n|---|---|---|---|---|")  # noqa: T201
    for way in dict.fromkeys(row["way"] for row in rows):
        own = [row for row in rows if row["way"] == way]
        score, seconds = (math.fsum(row[key] for row in own) / len(own) for key in ("dice", "s"))
        folds = [row["folds"] for row in own]
        cells = f"{way} | {score:.3f} | {sum(folds)} | {sum(f > 0 for f in folds)} of {len(own)} | {seconds:.2f}"
        print(f"| {cells} |")  # noqa: T201


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", type=Path, help="a file like configs/training_heart_2d.yaml")
    parser.add_argument("--out", type=Path, required=True, help="folder for checkpoints, logs, pictures, the table")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings to change")
    arguments = parser.parse_args()
    settings = Settings.load(arguments.settings, arguments.set)
    folder = Path(os.environ.get("TORCHDEFORM_DATA", "../shared/data")) / settings.data
    pairs = SETS[settings.data](folder, tuple(settings.shape))
    if not pairs:
        raise SystemExit(f"no images in {folder}; set TORCHDEFORM_DATA to the folder that has {settings.data}")
    kept = [p for p in pairs if not {p[0].patient, p[1].patient} & set(settings.held_back)]
    held = [p for p in pairs if {p[0].patient, p[1].patient} <= set(settings.held_back)]
    networks = {head: train(head, settings, kept, held[0], arguments.out / head) for head in settings.heads}
    if int(os.environ.get("RANK", "0")) == 0:
        report(judge(held, networks, settings.grid), arguments.out)


if __name__ == "__main__":
    main()
