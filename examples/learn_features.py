"""Learn features that are the same in every contrast, from painted shapes, and write them as a program.

    python examples/learn_features.py edges.ts
    python examples/learn_features.py edges.ts --dim 2 --steps 1000

No image is needed. Each step draws shapes with layers and paints them with grey values, texture, blur, gain and noise
that are drawn as well, the idea of SynthMorph and SynthSeg. Six convolutions learn to see in the painting where the
shapes end, whatever the grey values: for each axis how near the next border across it is, at two scales,

    e_a,s(x) = (G_s * [label(x) ≠ label(x + a)])(x).

The program takes an image ``(1, C, *S)`` to ``(1, (2 D + 1) C, *S)``, D being the axes of S; the last channel is a
constant, so that vectors of unit length are short where nothing is. At the end it is asked for the borders of shapes
that it never saw, next to the size of the gradient of the painting.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter, gaussian_gradient_magnitude
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

from painting import paint

CONV = {2: nn.Conv2d, 3: nn.Conv3d}
NORM = {2: nn.BatchNorm2d, 3: nn.BatchNorm3d}
SIDE = {2: 128, 3: 24}
SCALES = (1.0, 2.5)  # of what is learned, in voxels
DILATIONS = (1, 1, 2, 4, 2, 1)  # a voxel sees 11 on each side, and 7 more for the mean and the deviation


class Edges(nn.Module):
    """Each channel ``(B, C, *S)`` by itself -> ``(B, (2 D + 1) C, *S)``, the same for a·image + b, a > 0."""

    def __init__(self, dim: int, width: int = 16) -> None:
        super().__init__()
        self.dim, layers = dim, []
        for before, dilation in zip((1, *[width] * 5), DILATIONS, strict=True):
            layers += [CONV[dim](before, width, 3, padding=dilation, dilation=dilation), NORM[dim](width)]
            layers += [nn.LeakyReLU(0.1)]
        self.layers = nn.Sequential(*layers, CONV[dim](width, dim * len(SCALES), 1))

    def forward(self, image: Tensor) -> Tensor:
        edges = self.layers(self.normalised(image.flatten(0, 1).unsqueeze(1)))
        found = torch.cat([edges, 0.5 * torch.ones_like(edges[:, :1])], dim=1)
        return found.unflatten(0, (image.shape[0], image.shape[1])).flatten(1, 2)

    def normalised(self, image: Tensor) -> Tensor:
        """Return the image less its mean around each voxel, in standard deviations."""
        apart = image - self.around(image)
        return apart / (self.around(apart * apart) + 1e-4).sqrt()

    def around(self, image: Tensor) -> Tensor:
        """Return the mean over 15 voxels along each axis."""
        if self.dim == 3:
            image = F.avg_pool3d(image, (15, 1, 1), 1, (7, 0, 0), count_include_pad=False)
            image = F.avg_pool3d(image, (1, 15, 1), 1, (0, 7, 0), count_include_pad=False)
            return F.avg_pool3d(image, (1, 1, 15), 1, (0, 0, 7), count_include_pad=False)
        image = F.avg_pool2d(image, (15, 1), 1, (7, 0), count_include_pad=False)
        return F.avg_pool2d(image, (1, 15), 1, (0, 7), count_include_pad=False)


def shapes(dim: int, generator: torch.Generator) -> Tensor:
    """Return labels ``(1, 1, *S)`` of blobs, some of them in layers."""
    scale = 1.2 + 4 * torch.rand((), generator=generator).item()
    parts = torch.stack([smooth(dim, scale, generator) for _ in range(10)]).argmax(0)
    layers = (2 * smooth(dim, scale + 1, generator)).round().clamp(-3, 3).long() + 3
    layered = torch.rand(10, generator=generator)[parts] < 0.5
    return (7 * parts + layers * layered)[None, None]


def smooth(dim: int, sigma: float, generator: torch.Generator) -> Tensor:
    """Return smooth noise ``S`` with standard deviation 1."""
    noise = torch.from_numpy(gaussian_filter(torch.randn([SIDE[dim]] * dim, generator=generator).numpy(), sigma))
    return noise / noise.std()


def painted(labels: Tensor, generator: torch.Generator) -> Tensor:
    """Return a painting ``(1, 1, *S)`` of which all is drawn."""
    contrast, seed = torch.randint(2**31, (2,), generator=generator).tolist()
    noise, blur = torch.rand(2, generator=generator).tolist()
    return paint(labels, contrast, seed, noise=0.05 * noise, blur=0.3 + 0.8 * blur)


def borders(labels: Tensor) -> Tensor:
    """Return how near the next border across each axis is ``(1, 2 D, *S)``, about 1 on a flat one."""
    values, found = labels[0, 0].numpy(), []
    for axis in range(values.ndim):
        other = np.diff(values, axis=axis) != 0
        beside = [np.insert(other, place, False, axis) for place in (0, other.shape[axis])]
        found += [gaussian_filter(0.5 * (beside[0] + beside[1].astype(np.float32)), s) * 2.5 * s for s in SCALES]
    return torch.from_numpy(np.stack(found))[None]


def train(network: nn.Module, dim: int, steps: int, generator: torch.Generator) -> None:
    """Learn from new shapes in every step."""
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, total_steps=steps)
    for step in range(steps):
        labels = shapes(dim, generator)
        loss = (network(painted(labels, generator))[:, :-1] - borders(labels)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % max(1, steps // 10) == 0:
            print(f"step {step}: mean squared difference {loss.item():.3f}", flush=True)  # noqa: T201


def gradient(image: Tensor) -> Tensor:
    """Return the size of the gradient at the finer scale, as one channel and a constant."""
    size = torch.from_numpy(gaussian_gradient_magnitude(image[0, 0].numpy(), SCALES[0]))[None, None]
    return torch.cat([size, size], dim=1)


@torch.no_grad()
def likeness(features: Callable[[Tensor], Tensor], dim: int, generator: torch.Generator, rounds: int = 8) -> float:
    """Return the mean correlation of what is seen in a painting, summed over the channels, with the true borders."""
    found = []
    for _ in range(rounds):
        labels = shapes(dim, generator)
        pair = features(painted(labels, generator))[:, :-1], borders(labels)
        found.append(torch.corrcoef(torch.stack([one.sum(1).flatten() for one in pair]))[0, 1].item())
    return sum(found) / rounds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the program, a TorchScript file")
    parser.add_argument("--dim", type=int, default=3, choices=(2, 3), help="axes of the images")
    parser.add_argument("--steps", type=int, default=400, help="of gradient descent")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    network, begin = Edges(arguments.dim), time.perf_counter()
    train(network, arguments.dim, arguments.steps, torch.Generator().manual_seed(arguments.seed))
    print(f"{arguments.steps} steps in {time.perf_counter() - begin:.0f} s")  # noqa: T201
    torch.jit.script(network.eval()).save(str(arguments.out))
    for name, features in {"learned": network, "gradient": gradient}.items():
        unseen = torch.Generator().manual_seed(arguments.seed + 1)
        print(f"{name}: correlation with the borders {likeness(features, arguments.dim, unseen):.3f}")  # noqa: T201


if __name__ == "__main__":
    main()
