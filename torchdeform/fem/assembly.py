"""The assembled system as torch sparse matrices, for small grids, other solvers and tests."""

import math

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.elements import components, element_matrices
from torchdeform.fem.form import Form


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
        Takes C²·4^D entries per element before they are added up: 576 in 3D, some 13 kB. Beyond 64³ take
        `operator.apply_form`. A product with the matrix runs 25 times faster as CSR, see `cg.to_csr`.
    """
    matrices = element_matrices(form, grid, device)
    if matrices.shape[0] != 1:
        raise InputError(f"assemble: one matrix has one set of coefficients, got a batch of {matrices.shape[0]}")
    elements = [n - 1 for n in grid.shape]
    unknowns = element_unknowns(grid, components(form)).to(matrices.device)
    size = unknowns.shape[0]
    index = [unknowns.unsqueeze(d).expand(size, size, -1).flatten() for d in (1, 0)]
    values = matrices[0].expand(size, size, *elements).flatten()
    total = components(form) * math.prod(grid.shape)
    return torch.sparse_coo_tensor(torch.stack(index), values, (total, total), check_invariants=False).coalesce()


def element_unknowns(grid: Grid, count: int = 1) -> Tensor:
    """Return the global number of each unknown k·2^D + corner of each element, ``(count·2^D, elements)``."""
    nodes = torch.arange(math.prod(grid.shape)).view(grid.shape)
    for axis in range(grid.dim):
        nodes = nodes.unfold(axis, 2, 1)
    corners = nodes.flatten(grid.dim).flatten(0, grid.dim - 1).T
    return torch.cat([corners + k * math.prod(grid.shape) for k in range(count)])


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
    return torch.sparse_coo_tensor(index, values, matrix.shape, check_invariants=False).coalesce()
