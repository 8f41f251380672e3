"""Learn from moving pictures which part of them is stiff, by gradients through the solve, the flow and the warp.

    python examples/learn_stiffness.py
    python examples/learn_stiffness.py --steps 20 --batch 6

Each pair shows a bright and a dark ellipse in soft tissue. The bright one moves rigidly, all else is deformed. Of the
motion there is a first guess, wrong by about a voxel, with divergence α and curl β. The velocity is that of

    min ∫ (div v − α)² + |curl v − β|² + s ((div v)² + |dev sym ∇v|²),

that is w_div = 1 + s with α/(1 + s) in place of α, w_curl = 1, w_strain = s: where the stiffness s is high, the guess
changes no shapes. A network of 141 numbers predicts s from the fixed picture, and is told nothing but how well the
pictures agree. On pairs that it never saw it is compared with the best s that is the same everywhere.
"""

import argparse
import time
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import torchdeform as td
from torchdeform.nn import DivCurlVelocity, FlowIntegrator, SpatialTransformer

GRID = td.Grid((40, 40))
WRONG = 0.7  # standard deviation of the first guess in voxels; the motion itself has 1.5
CONSTANTS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)

flow, warp = FlowIntegrator(GRID), SpatialTransformer(GRID)
solve = DivCurlVelocity(GRID, "slip")


@dataclass(frozen=True)
class Pairs:
    """Pictures, a first guess of the motion between them, and the truth.

    Attributes:
        fixed: ``(B, 1, *S)``.
        moving: moving(φ(x)) = fixed(x).
        div: α ``(B, 1, *S)``, of the first guess.
        curl: β ``(B, 1, *S)``, likewise.
        truth: displacement of φ ``(B, 2, *S)``, voxels.
        stiff: where the bright ellipse is ``(B, 1, *S)``, True or False; only the judge looks at it.
    """

    fixed: Tensor
    moving: Tensor
    div: Tensor
    curl: Tensor
    truth: Tensor
    stiff: Tensor


def draw(count: int, generator: torch.Generator) -> Pairs:
    """Draw so many pairs."""
    bright, dark = (ellipse(count, side, generator) for side in (0.3, 0.7))
    texture = smooth(torch.randn(count, 1, *GRID.shape, generator=generator), 1.5)
    fixed = 0.2 * texture + 0.5 * (bright < 1) - 0.5 * (dark < 1)
    near = torch.sigmoid(6 * (1.8 - bright))  # 1 in the ellipse, and a little beyond
    v = edge() * (near * rigid(count, generator) + (1 - near) * bending(count, generator))
    guess = v + edge() * WRONG * smooth(torch.randn(count, 2, *GRID.shape, generator=generator), 1.2)
    div, curl = td.divergence(guess, GRID), td.curl(guess, GRID)
    return Pairs(fixed, warp(fixed, flow.inverse(v)), div, curl, flow(v), bright < 1)


def ellipse(count: int, side: float, generator: torch.Generator) -> Tensor:
    """Return the squared radius ``(B, 1, *S)``, 1 on the border, of ellipses at that part of the second axis."""
    numbers = torch.rand(count, 4, 1, 1, generator=generator)
    middle = torch.stack([0.35 + 0.3 * numbers[:, 0], side - 0.05 + 0.1 * numbers[:, 1]], dim=1) * GRID.shape[0]
    radii = torch.stack([5 + 4 * numbers[:, 2], 5 + 2 * numbers[:, 3]], dim=1)
    return ((GRID.points() - middle) / radii).square().sum(1, keepdim=True)


def rigid(count: int, generator: torch.Generator) -> Tensor:
    """Return velocities ``(B, 2, *S)`` that shift by about 1.5 voxels and turn by about 6°."""
    numbers = torch.randn(count, 3, 1, 1, generator=generator)
    y, x = (GRID.points() - torch.tensor([20.0, 12.0]).view(1, 2, 1, 1)).split(1, dim=1)
    return 1.5 * numbers[:, :2] + 0.1 * numbers[:, 2:] * torch.cat([-x, y], dim=1)


def bending(count: int, generator: torch.Generator) -> Tensor:
    """Return velocities ``(B, 2, *S)`` of about 1.5 voxels that change within a few voxels."""
    return 1.5 * smooth(torch.randn(count, 2, *GRID.shape, generator=generator), 4.0)


def smooth(noise: Tensor, sigma: float) -> Tensor:
    """Return noise blurred by a Gaussian, with standard deviation 1 again."""
    places = torch.arange(-int(3 * sigma), int(3 * sigma) + 1)
    kernel = torch.exp(-places.square() / (2 * sigma**2)).view(1, 1, -1, 1)
    flat = noise.flatten(0, 1)[:, None]
    for weights in (kernel, kernel.transpose(2, 3)):
        flat = F.conv2d(flat, weights, padding="same")
    flat = flat.view_as(noise)
    return flat / flat.std(dim=(1, 2, 3), keepdim=True)


def edge() -> Tensor:
    """Return what lets velocities vanish at the edge of the picture, ``(1, 1, *S)``."""
    lines = [torch.sin(torch.pi * torch.arange(n) / (n - 1)).clamp(0, 0.5) * 2 for n in GRID.shape]
    return torch.outer(*lines)[None, None]


class Stiffness(nn.Module):
    """Picture -> s between 1/30 and 30, at first about 0.2 everywhere."""

    def __init__(self) -> None:
        super().__init__()
        last = nn.Conv2d(4, 1, 3, padding=1)
        nn.init.constant_(last.bias, -0.5)
        self.layers = nn.Sequential(nn.Conv2d(1, 4, 5, padding=2), nn.Tanh(), last, nn.Tanh())

    def forward(self, picture: Tensor) -> Tensor:
        return 30 ** self.layers(picture)


def register(pairs: Pairs, s: Tensor) -> Tensor:
    """Return the displacement ``(B, 2, *S)`` with the stiffness s ``(B or 1, 1, *S)``."""
    elements = -F.max_pool2d(-s, 2, stride=1)  # the least of the corners: α/(1 + s) is nowhere more than asked for
    v = solve(pairs.div / (1 + s), pairs.curl, td.Weights(div=1 + elements, curl=1.0, strain=elements))
    return flow(v)


def train(network: nn.Module, steps: int, batch: int, generator: torch.Generator) -> None:
    """Make the pictures agree, on new pairs in every step."""
    optimizer = torch.optim.Adam(network.parameters(), 0.03)
    for step in range(steps):
        pairs = draw(batch, generator)
        u = register(pairs, network(pairs.fixed))
        loss = (warp(pairs.moving, u) - pairs.fixed).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if step % max(1, steps // 5) == 0:
            print(f"step {step}: mean squared difference {loss.item():.5f}")  # noqa: T201


def errors(pairs: Pairs, s: Tensor) -> tuple[float, float]:
    """Return the mean distance from the truth in voxels, everywhere and in what is stiff."""
    distance = (register(pairs, s) - pairs.truth).norm(dim=1, keepdim=True)
    return distance.mean().item(), distance[pairs.stiff].mean().item()


def contrast(s: Tensor, stiff: Tensor) -> tuple[float, float]:
    """Return how many times as stiff it is inside as outside, and how often a node inside beats one outside (AUC)."""
    inside, outside = s[stiff], s[~stiff]
    order = torch.cat([outside, inside]).argsort().argsort()[len(outside) :]
    wins = order.sum().item() - len(inside) * (len(inside) - 1) / 2
    return inside.mean().item() / outside.mean().item(), wins / (len(inside) * len(outside))


@torch.no_grad()
def judge(network: nn.Module, pairs: Pairs) -> None:
    """Print what the network makes of pairs that it never saw, and the best constant stiffness."""
    s = network(pairs.fixed)
    ways = {f"s = {c:g}": errors(pairs, torch.full((1, 1, *GRID.shape), c)) for c in CONSTANTS}
    best = min(ways, key=lambda name: ways[name][0])
    ratio, auc = contrast(s, pairs.stiff)
    print("| held back | error, voxels | in the stiff part |\n|---|---|---|")  # noqa: T201
    for name, (whole, part) in {f"constant, {best}": ways[best], "learned": errors(pairs, s)}.items():
        print(f"| {name} | {whole:.3f} | {part:.3f} |")  # noqa: T201
    print(f"stiffness inside / outside: {ratio:.1f}, AUC {auc:.3f}")  # noqa: T201


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=80, help="of gradient descent")
    parser.add_argument("--batch", type=int, default=8, help="pairs in each step")
    parser.add_argument("--held-back", type=int, default=32, help="pairs for the comparison")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    network, begin = Stiffness(), time.perf_counter()
    train(network, arguments.steps, arguments.batch, torch.Generator().manual_seed(arguments.seed))
    print(f"{arguments.steps} steps in {time.perf_counter() - begin:.0f} s")  # noqa: T201
    judge(network, draw(arguments.held_back, torch.Generator().manual_seed(arguments.seed + 1)))


if __name__ == "__main__":
    main()
