"""The assembled system as torch sparse matrices, for small grids, other solvers and tests."""

import math
from itertools import product

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.elements import components, element_matrices
from torchdeform.fem.form import Form

# The neighbours of a node, itself among them, in the order of their numbers.
_OFFSETS: dict[int, list[tuple[int, ...]]] = {dim: list(product((-1, 0, 1), repeat=dim)) for dim in (2, 3)}


def assemble(form: Form, grid: Grid, device: torch.device | str = "cpu") -> Tensor:
    """Return the matrix A of the form, wᵀ A v = a(v, w), with nothing yet fixed at the boundary.

    Args:
        form: the form; coefficients that are tensors have batch size 1.
        grid: the grid.
        device: where the coefficients lie.

    Returns:
        Coalesced ``torch.sparse_coo_tensor`` of float64, C·N square for C components on N nodes; unknowns are
        numbered like ``v.flatten()`` of ``v (C, *S)``.

    Raises:
        InputError: coefficients that vary over the batch.

    Notes:
        A node is coupled to its 3^D − 1 neighbours, so the entries of all elements are added up neighbour by neighbour
        and stand in the order of rows and columns: nothing is sorted. Takes C²·3^D entries a node, 243 in 3D or some
        10 kB with their indices. A product with the matrix runs 25 times faster as CSR, see `cg.to_csr`.
    """
    values = _by_neighbours(form, grid, device)
    count, nodes = values.shape[0], math.prod(grid.shape)
    shift, inside = _neighbours(grid, values.device)
    # Rows (component, node), and in each of them columns (component, neighbour).
    known = inside.view(1, nodes, 1, -1).expand(count, -1, count, -1)
    number = torch.arange(count, device=values.device)
    node = torch.arange(nodes, device=values.device)
    row = (number.view(-1, 1, 1, 1) * nodes + node.view(1, -1, 1, 1)).expand_as(known)[known]
    column = (number.view(1, 1, -1, 1) * nodes + node.view(1, -1, 1, 1) + shift).expand_as(known)[known]
    entries = values.flatten(3).permute(0, 3, 1, 2)[known]
    size = (count * nodes, count * nodes)
    place, index = {"size": size, "device": entries.device}, torch.stack([row, column])
    return torch.sparse_coo_tensor(index, entries, **place, is_coalesced=True, check_invariants=False)


def _by_neighbours(form: Form, grid: Grid, device: torch.device | str) -> Tensor:
    """Return the entries of each node with its neighbours, ``(C, C, 3^D, *S)``: row, column, neighbour, node."""
    matrices, count = element_matrices(form, grid, device), components(form)
    if matrices.shape[0] != 1:
        raise InputError(f"assemble: one matrix has one set of coefficients, got a batch of {matrices.shape[0]}")
    elements, corners = [n - 1 for n in grid.shape], list(product((0, 1), repeat=grid.dim))
    blocks = matrices[0].expand(*matrices.shape[1:3], *elements).unflatten(1, (count, -1)).unflatten(0, (count, -1))
    values = matrices.new_zeros(count, count, 3**grid.dim, *grid.shape)
    for (i, start), (j, end) in product(enumerate(corners), repeat=2):
        neighbour = _OFFSETS[grid.dim].index(tuple(b - a for a, b in zip(start, end, strict=True)))
        place = tuple(slice(a, a + e) for a, e in zip(start, elements, strict=True))
        values[(slice(None), slice(None), neighbour, *place)] += blocks[:, i, :, j]
    return values


def _neighbours(grid: Grid, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return by how much the number of each neighbour differs ``(3^D,)``, and where it exists ``(N, 3^D)``."""
    shift = [sum(o * s for o, s in zip(offset, grid.strides, strict=True)) for offset in _OFFSETS[grid.dim]]
    inside = torch.ones(*grid.shape, len(shift), dtype=torch.bool, device=device)
    for k, offset in enumerate(_OFFSETS[grid.dim]):
        for axis, step in enumerate(offset):
            if step:
                inside[..., k].select(axis, 0 if step < 0 else -1).fill_(False)
    return torch.tensor(shift, device=device), inside.view(-1, len(shift))


def constrain_matrix(matrix: Tensor, fixed: Tensor) -> Tensor:
    """Return the matrix with the rows and columns of ``fixed`` unknowns replaced by those of the identity.

    Args:
        matrix: coalesced COO from `assemble`.
        fixed: mask ``(1, C, *S)`` from `boundary.fixed_unknowns`.

    Notes:
        Symmetric, and positive definite on all unknowns where the system is so on the free ones. `boundary.lift` gives
        the right-hand side.
    """
    flat, (row, column) = fixed.flatten(), matrix.indices()
    keep = ~(flat[row] | flat[column])
    given = flat.nonzero().T.expand(2, -1)
    index = torch.cat([matrix.indices()[:, keep], given], dim=1)
    values = torch.cat([matrix.values()[keep], matrix.values().new_ones(given.shape[1])])
    whole = torch.sparse_coo_tensor(index, values, matrix.shape, device=values.device, check_invariants=False)
    return whole.coalesce()
