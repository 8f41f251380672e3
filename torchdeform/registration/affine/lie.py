"""Maps of the plane and of space as matrices: which moves each kind of alignment allows, and rotations to try."""

import itertools
import math

import torch
from torch import Tensor

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


def _entry(dim: int, values: dict[tuple[int, int], float]) -> Tensor:
    matrix = torch.zeros(dim, dim + 1, dtype=torch.float64)
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
    matrix = torch.eye(dim + 1, dtype=linear.dtype)
    matrix[:dim, :dim], matrix[:dim, dim] = linear, shift
    return matrix


def rotations(dim: int) -> Tensor:
    """Return rotations that leave no other further than 5° (2D) or 45° (3D) away, the identity first.

    Returns:
        ``(36, 2, 2)``, or in 3D the ``(60, 3, 3)`` rotations of the icosahedron, float64.
    """
    return _ROTATIONS[dim]()


def _circle() -> Tensor:
    angles = 2 * math.pi / 36 * torch.arange(36, dtype=torch.float64)
    cos, sin = angles.cos(), angles.sin()
    return torch.stack([cos, -sin, sin, cos], dim=1).view(-1, 2, 2)


def _icosahedron() -> Tensor:
    """Return rotations from the 120 unit quaternions of the icosahedral group, one of each ± pair."""
    units = [[float(i == k) for i in range(4)] for k in range(4)]
    halves = [[0.5 * s for s in signs] for signs in itertools.product((1, -1), repeat=4)]
    even = [p for p in itertools.permutations(range(4)) if _is_even(p)]
    golden = [
        [(a * _GOLDEN / 2, b / 2, c / (2 * _GOLDEN), 0.0)[i] for i in p]
        for p in even
        for a, b, c in itertools.product((1, -1), repeat=3)
    ]
    every = [tuple(float(x) for x in q) for q in units + halves + golden]
    return _from_quaternions(torch.tensor([q for q in every if next(x for x in q if x != 0) > 0], dtype=torch.float64))


def _is_even(order: tuple[int, ...]) -> bool:
    return sum(a > b for a, b in itertools.combinations(order, 2)) % 2 == 0


def _from_quaternions(q: Tensor) -> Tensor:
    w, x, y, z = q.unbind(dim=1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=1).view(-1, 3, 3)


_ROTATIONS = {2: _circle, 3: _icosahedron}


def angle(linear: Tensor) -> Tensor:
    """Return how far matrices turn, in degrees: the angle of the nearest rotation.

    Args:
        linear: ``(..., D, D)`` with positive determinant.
    """
    u, _, v = torch.linalg.svd(linear)
    cosine = torch.diagonal(u @ v, dim1=-2, dim2=-1).sum(-1) - (linear.shape[-1] - 2)
    return torch.rad2deg((cosine / 2).clamp(-1, 1).acos())
