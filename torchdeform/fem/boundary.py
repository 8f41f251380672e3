"""Boundary conditions of a vector field on a box, face by face: which components are given where."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError, require_choice


class Face(NamedTuple):
    """One face of the box: the nodes with the first (side 0) or the last (side 1) index along ``axis``."""

    axis: int
    side: int


# kind -> does it give component k on a face across this axis? Component `axis` is the normal one.
FIXES: dict[str, Callable[[int, int], bool]] = {
    "slip": lambda k, axis: k == axis,
    "no_slip_tangential": lambda k, axis: k != axis,
    "dirichlet": lambda k, axis: True,
    "free": lambda k, axis: False,
}

Boundary = str | Mapping[Face, str]


def faces(dim: int) -> tuple[Face, ...]:
    """Return the 2·D faces of a box."""
    return tuple(Face(axis, side) for axis in range(dim) for side in (0, 1))


def resolve_boundary(boundary: Boundary, dim: int) -> dict[Face, str]:
    """Return the kind of every face.

    Args:
        boundary: for all faces ``slip`` (n·v given, the paper's Γ1), ``no_slip_tangential`` (n×v given, its Γ2),
            ``dirichlet`` (all of v given) or ``free`` (nothing given); or a mapping that says so for each `Face`, or
            tuple (axis, side).
        dim: number of axes.

    Raises:
        InputError: an unknown kind or face, or a face left out.
    """
    if isinstance(boundary, str):
        boundary = dict.fromkeys(faces(dim), boundary)
    missing, unknown = set(faces(dim)) - set(boundary), set(boundary) - set(faces(dim))
    if missing or unknown:
        wrong = f"unknown face {min(unknown)}" if unknown else f"no kind for face {tuple(min(missing))}"
        raise InputError(f"boundary: {wrong}; give one kind for each (axis, side), axis below {dim}, side 0 or 1")
    for face, kind in boundary.items():
        require_choice(kind, FIXES, f"boundary: face {tuple(face)}")
    return {face: boundary[face] for face in faces(dim)}


def fixes(boundary: dict[Face, str], face: Face, k: int) -> bool:
    """Tell whether component ``k`` is given on ``face``."""
    return FIXES[boundary[face]](k, face.axis)


def normal_is_given(boundary: Boundary, dim: int) -> bool:
    """Tell whether n·v is given on every face, so that ∫ div v is known."""
    kinds = resolve_boundary(boundary, dim)
    return all(fixes(kinds, face, face.axis) for face in faces(dim))


def fixed_unknowns(boundary: Boundary, grid: Grid, device: torch.device | str = "cpu") -> Tensor:
    """Return the mask ``(1, D, *S)``, True where a component is given by the boundary conditions.

    Args:
        boundary: as `resolve_boundary`.
        grid: the grid of the field.
        device: where the mask lies.

    Raises:
        InputError: as `resolve_boundary`.
    """
    kinds = resolve_boundary(boundary, grid.dim)
    mask = torch.zeros((1, grid.dim, *grid.shape), dtype=torch.bool, device=device)
    for face in faces(grid.dim):
        for k in range(grid.dim):
            if fixes(kinds, face, k):
                mask[:, k].select(1 + face.axis, -face.side).fill_(True)
    return mask


def constrain(apply: Callable[[Tensor], Tensor], fixed: Tensor) -> Callable[[Tensor], Tensor]:
    """Return v ↦ P A P v, P being the projection that sets the ``fixed`` unknowns to zero.

    Args:
        apply: v ↦ A v on ``(B, C, *S)``.
        fixed: mask ``(1, C, *S)``, True where an unknown is given.
    """
    return lambda v: apply(v.masked_fill(fixed, 0)).masked_fill(fixed, 0)


def lift(apply: Callable[[Tensor], Tensor], load: Tensor, values: Tensor, fixed: Tensor) -> Tensor:
    """Return the right-hand side load − A g on the free unknowns, 0 on the fixed ones, where g has the given values.

    The solution of A v = load with v = g on the fixed unknowns is g + w with w from P A P w = this; see `constrain`.

    Args:
        apply: v ↦ A v on ``(B, C, *S)``.
        load: right-hand side ``(B, C, *S)``.
        values: ``(B, C, *S)``; only its fixed entries are used.
        fixed: mask ``(1, C, *S)``, True where an unknown is given.
    """
    return (load - apply(values.masked_fill(~fixed, 0))).masked_fill(fixed, 0)


def outward_flux(values: Tensor, grid: Grid) -> Tensor:
    """Return ∮ n·v over the boundary of Ω, exact for Q1 fields.

    Args:
        values: ``(B, D, *S)``, units of spacing; only boundary nodes are used.
        grid: the grid.

    Returns:
        ``(B,)``, units of spacing to the power D.
    """
    total = values.new_zeros(values.shape[0])
    weights = grid.quadrature(dtype=values.dtype, device=values.device)[0, 0]
    for axis, side in faces(grid.dim):
        # A face's own trapezoidal weights are those of the volume over half a cell.
        area = weights.select(axis, -side) * (2 / grid.spacing[axis])
        flux = torch.stack([(item[axis].select(axis, -side) * area).sum() for item in values])
        total = total + (flux if side else -flux)
    return total
