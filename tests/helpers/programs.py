"""Small networks that turn images into channels, and files of them."""

import warnings
from pathlib import Path

import torch
from torch import nn

CONVOLUTIONS = {2: nn.Conv2d, 3: nn.Conv3d}


def network(dim: int, channels: int = 4, inputs: int = 1, width: int = 3) -> nn.Module:
    """Two convolutions, which see ``width - 1`` voxels far in every direction."""
    torch.manual_seed(dim)
    layer = CONVOLUTIONS[dim]
    first, second = (layer(a, b, width, padding=width // 2) for a, b in ((inputs, 6), (6, channels)))
    return nn.Sequential(first, nn.Tanh(), second).eval()


def save_script(net: nn.Module, path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(net), path)


def save_exported(net: nn.Module, path: Path) -> None:
    dim = 2 if any(isinstance(part, nn.Conv2d) for part in net.modules()) else 3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sizes = {axis: torch.export.Dim(f"n{axis}", min=8, max=4096) for axis in range(2, 2 + dim)}
        program = torch.export.export(net, (torch.zeros(1, 1, *(32,) * dim),), dynamic_shapes=(sizes,))
        torch.export.save(program, path)
