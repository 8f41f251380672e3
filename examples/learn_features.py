"""Learn self-similarities that noise does not disturb, from painted shapes, and write them as a program.

    python examples/learn_features.py features.ts
    python examples/learn_features.py features.ts --dim 2 --steps 1000

MIND-SSC with patches of one voxel is sharp, and whatever the contrast nearly the same; but noise disturbs it, and wider
patches, which help, blur it. Here three convolutions learn to undo the noise. No image is needed: each step draws
shapes with layers and paints them with grey values, texture, blur, gain and noise that are drawn as well, the idea of
SynthMorph and SynthSeg. From the painting the network is to tell the MIND of the shapes themselves, in the mean over
contrasts. Before the first step it is MIND.

The program takes an image ``(1, C, *S)`` to ``(1, K C, *S)`` between 0 and 1, with K = 12 in 3D and 4 in 2D. At the end
its error on shapes that it never saw is printed, next to that of MIND.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor, nn

from torchdeform.metrics.mind import mind_ssc, neighbour_pairs

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

from painting import paint

CONV = {2: nn.Conv2d, 3: nn.Conv3d}
SIDE = {2: 128, 3: 28}
DILATIONS = (1, 2, 1)
CONTRASTS = 4  # over which what is to be learned is averaged


class Features(nn.Module):
    """Each channel ``(B, C, *S)`` by itself -> ``(B, K C, *S)``, the same for a·image + b."""

    def __init__(self, dim: int, width: int = 24) -> None:
        super().__init__()
        self.dim, pairs = dim, neighbour_pairs(dim)
        kernels = torch.zeros(len(pairs), 1, *[3] * dim)
        for kernel, (p, q) in zip(kernels, pairs, strict=True):
            kernel[(0, *(1 + step for step in p))], kernel[(0, *(1 + step for step in q))] = 1.0, -1.0
        self.register_buffer("kernels", kernels)
        widths, layers = (len(pairs), width, width, len(pairs)), []
        for before, after, dilation in zip(widths, widths[1:], DILATIONS, strict=False):
            layers += [CONV[dim](before, after, 3, padding=dilation, dilation=dilation), nn.LeakyReLU(0.1)]
        nn.init.zeros_(layers[-2].weight)
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, image: Tensor) -> Tensor:
        similar = self.similarities(image.flatten(0, 1).unsqueeze(1))
        found = torch.sigmoid(torch.logit(similar, 0.02) + self.layers(similar - 0.5))
        return found.unflatten(0, (image.shape[0], image.shape[1])).flatten(1, 2)

    def similarities(self, image: Tensor) -> Tensor:
        """Return exp(−(D_k − min D)/V) of patches of one voxel, V being the mean over k."""
        padded = F.pad(image, [1, 1] * self.dim, mode="replicate")
        apart = F.conv3d(padded, self.kernels) if self.dim == 3 else F.conv2d(padded, self.kernels)
        distance = apart.square()
        distance = distance - distance.amin(1, keepdim=True)
        return torch.exp(-distance / distance.mean(1, keepdim=True).clamp(min=1e-8))


def shapes(dim: int, generator: torch.Generator) -> Tensor:
    """Return labels ``(1, 1, *S)`` of blobs, some of them in layers."""
    scale = 1.5 + 3 * torch.rand((), generator=generator).item()
    parts = torch.stack([smooth(dim, scale, generator) for _ in range(8)]).argmax(0)
    layers = smooth(dim, scale + 1, generator).round().clamp(-2, 2).long() + 2
    layered = torch.rand(8, generator=generator)[parts] < 0.5
    return (5 * parts + layers * layered)[None, None]


def smooth(dim: int, sigma: float, generator: torch.Generator) -> Tensor:
    """Return smooth noise ``S`` with standard deviation 1."""
    noise = torch.from_numpy(gaussian_filter(torch.randn([SIDE[dim]] * dim, generator=generator).numpy(), sigma))
    return noise / noise.std()


def example(dim: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return a painting ``(1, 1, *S)`` of which all is drawn, and the MIND of its shapes, the mean over contrasts."""
    labels = shapes(dim, generator)
    contrast, seed = torch.randint(2**31, (2,), generator=generator).tolist()
    noise, blur = torch.rand(2, generator=generator).tolist()
    painting = paint(labels, contrast, seed, noise=0.06 * noise, blur=0.3 + 0.7 * blur)
    greys = torch.rand(CONTRASTS, 40, generator=generator)
    clean = torch.cat([grey[labels] for grey in greys])
    return painting, mind_ssc(clean, radius=0).mean(0, keepdim=True)


def train(network: nn.Module, dim: int, steps: int, generator: torch.Generator) -> None:
    """Learn from new shapes in every step."""
    optimizer = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps)
    for step in range(steps):
        painting, wanted = example(dim, generator)
        loss = (network(painting) - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % max(1, steps // 10) == 0:
            print(f"step {step}: mean squared difference {loss.item():.4f}", flush=True)  # noqa: T201


@torch.no_grad()
def error(features: Callable[[Tensor], Tensor], dim: int, generator: torch.Generator, rounds: int = 16) -> float:
    """Return the root of the mean squared difference on new shapes."""
    pairs = (example(dim, generator) for _ in range(rounds))
    return (sum((features(painting) - wanted).square().mean().item() for painting, wanted in pairs) / rounds) ** 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="the program, a TorchScript file")
    parser.add_argument("--dim", type=int, default=3, choices=(2, 3), help="axes of the images")
    parser.add_argument("--steps", type=int, default=400, help="of gradient descent")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    network, begin = Features(arguments.dim), time.perf_counter()
    train(network, arguments.dim, arguments.steps, torch.Generator().manual_seed(arguments.seed))
    print(f"{arguments.steps} steps in {time.perf_counter() - begin:.0f} s")  # noqa: T201
    torch.jit.script(network.eval()).save(str(arguments.out))
    ways = {"learned": network, "MIND": mind_ssc, "MIND of single voxels": partial(mind_ssc, radius=0)}
    for name, features in ways.items():
        unseen = torch.Generator().manual_seed(arguments.seed + 1)
        print(f"{name}: error on shapes never seen {error(features, arguments.dim, unseen):.3f}")  # noqa: T201


if __name__ == "__main__":
    main()
