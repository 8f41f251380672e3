"""Small drawn pairs in which what moves is known by tissue: bars that turn, a ball that stays as large, two blocks."""

import math

import numpy as np
import torch
from pictures import blobs
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp

BARS = {1: "rigid", 2: "rigid"}


def _turned(points: Tensor, centre: tuple[float, ...], degrees: float) -> Tensor:
    """Return points relative to a centre in axes that are turned in the plane of the first two."""
    x = points - torch.tensor(centre).view(1, -1, *[1] * (points.dim() - 2))
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.cat([c * x[:, :1] + s * x[:, 1:2], -s * x[:, :1] + c * x[:, 1:2], x[:, 2:]], dim=1)


def turning_bars(dim: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """Return fixed, moving and labels of two bars that turn against each other by 9 and 7 degrees."""
    shape, long, wide = ((64, 64), 18.0, 4.5) if dim == 2 else ((28, 30, 24), 8.0, 3.0)
    points, middle = Grid(shape).points(), tuple((n - 1) / 2 for n in shape)
    images = [torch.zeros(1, 1, *shape), torch.zeros(1, 1, *shape)]
    labels = torch.zeros(1, 1, *shape)
    for number, (side, degrees) in enumerate([(-0.25, 9.0), (0.25, -7.0)], start=1):
        centre = (middle[0], middle[1] + side * shape[1], *middle[2:])
        for image, angle in zip(images, (0.0, degrees), strict=True):
            x = _turned(points, centre, angle)
            half = torch.tensor([long, *[wide] * (dim - 1)]).view(1, -1, *[1] * dim)
            inside = torch.sigmoid(2 * (half - x.abs())).prod(1, keepdim=True)
            image += inside * (1 + 0.4 * torch.cos(x[:, :1]))
            if angle == 0:
                labels[inside > 0.5] = number
    return images[0], images[1], labels


def growing_ball(dim: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """Return fixed, moving and labels of a ball that looks larger by a tenth of its radius, so that it would grow."""
    shape = (56, 56) if dim == 2 else (26, 26, 26)
    radius = shape[0] / 4.5
    centre = torch.tensor([(n - 1) / 2 for n in shape]).view(1, -1, *[1] * dim)
    distance = (Grid(shape).points() - centre).square().sum(1, keepdim=True).sqrt()
    images = [torch.sigmoid(2 * (r - distance)) + 0.1 * blobs(shape, 3) for r in (radius, 1.1 * radius)]
    return images[0], images[1], (distance < radius).float()


def sliding_blocks(shape: tuple[int, ...] = (64, 72), jump: float = 4.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return fixed, moving, labels and the true displacement of two halves that slide along each other.

    Along the first axis one half moves by half of the jump and the other the other way; both fade to the faces.
    """
    grid = Grid(shape)
    x = grid.points()
    upper = (x[:, 1:2] > (shape[1] - 1) / 2).float()
    fade = torch.sin(math.pi * x[:, :1] / grid.extent[0]).clamp(min=0).sqrt()
    truth = torch.zeros(1, grid.dim, *shape)
    truth[:, :1] = (upper - 0.5) * jump * fade
    moving = blobs(shape, 4)
    return warp(moving, truth, grid), moving, upper, truth


def kabsch_residual(u: Tensor, inside: Tensor, spacing: tuple[float, ...] = ()) -> float:
    """Return how far a displacement ``(D, *S)`` is from the rigid motion nearest to it on a mask, in its unit."""
    x = np.argwhere(inside.numpy()) * np.array(spacing or [1.0] * inside.dim())
    y = x + u[:, inside].double().numpy().T
    a, b = x - x.mean(0), y - y.mean(0)
    left, _, right = np.linalg.svd(a.T @ b)
    sign = np.ones(x.shape[1])
    sign[-1] = np.sign(np.linalg.det(left @ right))
    return float(np.linalg.norm(a @ (left * sign) @ right - b, axis=1).max())
