"""The div-curl least squares as one linear system: its loads, products, diagonal and matrix."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem.assembly import assemble, constrain_matrix
from torchdeform.fem.boundary import Boundary, constrain, fixed_unknowns, lift
from torchdeform.fem.form import Form, curl_form, div_curl_form, div_form, value_form
from torchdeform.fem.operator import apply_form, assemble_load, form_diagonal
from torchdeform.fem.weights import Weights


@dataclass(frozen=True)
class DivCurlSystem:
    """K v = load: the weighted least squares of div v = α, curl v = β and dev sym ∇v = 0 under a force f.

    v has the least ∫ w_div (div v − α)² + w_curl |curl v − β|² + w_strain |dev sym ∇v|² + w_zero |v|² − 2 f·v.

    Args:
        grid: the grid of v.
        weights: w_div, w_curl, w_zero, w_strain.
        boundary: which components are given at which faces, see `resolve_boundary`; K acts on the others.
        also_fixed: mask ``(B or 1, D, *S)`` of unknowns that are given besides, None for none.

    Notes:
        Liu, Liao & Xue 2007, eq. (3.4) and (3.5). Every solver of the package starts from this: see `solver_of`.
    """

    grid: Grid
    weights: Weights
    boundary: Boundary = "slip"
    also_fixed: Tensor | None = None

    def load(
        self,
        *,
        div: Tensor | None = None,
        curl: Tensor | None = None,
        force: Tensor | None = None,
        values: Tensor | None = None,
    ) -> Tensor:
        """Return the right-hand side of what is asked for, at least one thing.

        Args:
            div: α ``(B, 1, *S)``.
            curl: β ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D.
            force: f ``(B, D, *S)``, a density.
            values: what v is at the given unknowns ``(B, D, *S)``, lifted into the load; zero when None.

        Returns:
            ``(B, D, *S)``; solvers leave out what it says about given unknowns.
        """
        dim = self.grid.dim
        parts = [(div_form(dim, self.weights), div), (curl_form(dim, self.weights), curl), (value_form(dim), force)]
        rows, channels, given = [], [], []
        for some, data in parts:
            if data is not None:
                first = sum(d.shape[1] for d in given)
                rows += some
                channels += [first + k % data.shape[1] for k in range(len(some))]
                given.append(data)
        load = assemble_load(tuple(rows), torch.cat(given, dim=1) if len(given) > 1 else given[0], self.grid, channels)
        if values is None:
            return load
        return lift(lambda w: self._apply_all(w, self.weights), load, values, self.fixed(load.device))

    def free(self, load: Tensor) -> Tensor:
        """Return the load with zeros at given unknowns."""
        return load.masked_fill(self.fixed(load.device), 0)

    def fixed(self, device: torch.device | str = "cpu") -> Tensor:
        """Return the mask ``(B or 1, D, *S)`` of the given unknowns."""
        if device not in self._masks:
            faces = fixed_unknowns(self.boundary, self.grid, device)
            self._masks[device] = faces if self.also_fixed is None else faces | self.also_fixed
        return self._masks[device]

    @property
    def parameters(self) -> tuple[Tensor, ...]:
        """The weights that are tensors."""
        return self.weights.tensors

    def apply(self, v: Tensor, *parameters: Tensor) -> Tensor:
        """Return K v ``(B, D, *S)`` without a matrix, with ``parameters`` in place of the weights that are tensors."""
        weights = self.weights.with_tensors(parameters or self.weights.tensors)
        return constrain(lambda w: self._apply_all(w, weights), self.fixed(v.device))(v)

    def mass(self, v: Tensor) -> Tensor:
        """Return M v, M being the mass matrix on the free unknowns."""
        return self.free(self.load(force=v))

    def diagonal(self, like: Tensor) -> Tensor:
        """Return the diagonal of K ``(B, D, *S)`` with the type and device of ``like``."""
        return form_diagonal(self._form(self.weights), self.grid, like)

    def matrix(self, device: torch.device | str = "cpu") -> Tensor:
        """Return K as a coalesced ``torch.sparse_coo_tensor`` of float64, the identity at given unknowns.

        Raises:
            InputError: weights that vary over the batch.

        Notes:
            Takes some 90 bytes for each of the `matrix_entries` while it is assembled; see `assemble`.
        """
        return constrain_matrix(assemble(self._form(self.weights), self.grid, device), self.fixed(device))

    @property
    def matrix_entries(self) -> int:
        """Entries of the assembled matrix, about: D² 3^D for each node."""
        return math.prod(self.grid.shape) * self.grid.dim**2 * 3**self.grid.dim

    def _form(self, weights: Weights) -> Form:
        return div_curl_form(self.grid.dim, weights)

    def _apply_all(self, v: Tensor, weights: Weights) -> Tensor:
        """Return K v with nothing given."""
        return apply_form(self._form(weights), v, self.grid)

    @cached_property
    def _masks(self) -> dict[object, Tensor]:
        return {}
