"""Groups of maps of the plane and of space: the moves that each kind of alignment allows, and rotations to try."""

import itertools
import math

import torch
from torch import Tensor

from torchdeform.core.tables import kept

# What each kind adds to the shifts.
_LINEAR = {"translation": (), "rigid": ("rotations",), "similarity": ("rotations", "scale"), "affine": ("all",)}

_GOLDEN = (1 + math.sqrt(5)) / 2


def generators(kind: str, dim: int) -> Tensor:
    """Return the independent moves of a kind, dx/dt = L [x; 1], as rows ``(P, D, D + 1)`` in float64.

    Args:
        kind: ``translation`` (P = D), ``rigid``, ``similarity`` or ``affine`` (P = D² + D).
        dim: D.
    """
    shifts = [_entry(dim, {(i, dim): 1.0}) for i in range(dim)]
    pairs = list(itertools.combinations(range(dim), 2))
    linear = {
        "rotations": [_entry(dim, {(i, j): -1.0, (j, i): 1.0}) for i, j in pairs],
        "scale": [_entry(dim, {(i, i): 1.0 for i in range(dim)})],
        "all": [_entry(dim, {(i, j): 1.0}) for i, j in itertools.product(range(dim), repeat=2)],
    }
    return torch.stack(shifts + [move for part in _LINEAR[kind] for move in linear[part]])


def scale_of(linear: Tensor) -> Tensor:
    """Return the factor by which matrices ``(*, D, D)`` change lengths on average, |det|^(1/D), ``(*)``."""
    return torch.linalg.det(linear).abs() ** (1 / linear.shape[-1])


def _entry(dim: int, values: dict[tuple[int, int], float]) -> Tensor:
    matrix = torch.zeros(dim, dim + 1, dtype=torch.float64, device="cpu")
    for place, value in values.items():
        matrix[place] = value
    return matrix


def exponential(steps: Tensor, moves: Tensor) -> Tensor:
    """Return exp(Σ p_k L_k), the flow of the moves for unit time; its determinant is positive whatever p is.

    Args:
        steps: p ``(B, P)``.
        moves: L ``(P, D, D + 1)``, see `generators`.

    Returns:
        Matrices ``(B, D + 1, D + 1)`` that act on [x; 1].
    """
    top = torch.einsum("bp,pij->bij", steps, moves)
    return torch.matrix_exp(torch.cat([top, torch.zeros_like(top[:, :1])], dim=1))


def homogeneous(linear: Tensor, shift: Tensor) -> Tensor:
    """Return the matrix of x ↦ linear x + shift on [x; 1].

    Args:
        linear: ``(D, D)``.
        shift: ``(D,)``.
    """
    dim = len(shift)
    matrix = torch.eye(dim + 1, dtype=linear.dtype, device="cpu")
    matrix[:dim, :dim], matrix[:dim, dim] = linear, shift
    return matrix


@kept(2)
def rotations(dim: int) -> Tensor:
    """Return rotations that leave no other further than 5° (2D) or 45° (3D) away, the identity first.

    Returns:
        ``(36, 2, 2)``, or in 3D the ``(60, 3, 3)`` rotations of the icosahedron, float64.
    """
    return _circle() if dim == 2 else _icosahedron()


def _circle() -> Tensor:
    angles = 2 * math.pi / 36 * torch.arange(36, dtype=torch.float64, device="cpu")
    cos, sin = angles.cos(), angles.sin()
    return torch.stack([cos, -sin, sin, cos], dim=1).view(-1, 2, 2)


def _icosahedron() -> Tensor:
    """Return all products of a turn by 72° about one of its vertices and a half turn about the middle of an edge."""
    x, y, z = (2 * math.pi / 5 * v / math.hypot(1, _GOLDEN) for v in (0, _GOLDEN, 1))
    fifth = torch.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64, device="cpu"))
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64, device="cpu"))
    found = torch.eye(3, dtype=torch.float64, device="cpu").unsqueeze(0)
    while len(found) < 60:
        for new in torch.cat([fifth @ found, half @ found]):
            if (found - new).abs().amax((1, 2)).min() > 1e-6:
                found = torch.cat([found, new.unsqueeze(0)])
    return found


def angle(linear: Tensor) -> Tensor:
    """Return how far matrices turn, in degrees: the angle of the nearest rotation.

    Args:
        linear: ``(..., D, D)`` with positive determinant.
    """
    u, _, v = torch.linalg.svd(linear)
    cosine = torch.diagonal(u @ v, dim1=-2, dim2=-1).sum(-1) - (linear.shape[-1] - 2)
    return torch.rad2deg((cosine / 2).clamp(-1, 1).acos())
