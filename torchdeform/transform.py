"""Maps between physical spaces, in world points (x, y, z) in LPS mm: what `io` writes for ITK and reads from it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.errors import InputError


@dataclass(frozen=True)
class Affine:
    """The map x ↦ M x + t of world points (x, y, z) in LPS mm.

    Args:
        matrix: M ``(D, D)``.
        offset: t ``(D,)`` in mm.

    Raises:
        InputError: shapes, values that are not finite, or a singular matrix.
    """

    matrix: Tensor
    offset: Tensor

    def __post_init__(self) -> None:
        dim = self.offset.numel()
        if dim not in (2, 3) or tuple(self.matrix.shape) != (dim, dim) or tuple(self.offset.shape) != (dim,):
            shapes = f"{tuple(self.matrix.shape)} and {tuple(self.offset.shape)}"
            raise InputError(f"Affine: matrix must be (D, D) and offset (D,) with D = 2 or 3, got {shapes}")
        if not bool(self.matrix.isfinite().all() and self.offset.isfinite().all()):
            raise InputError("Affine: matrix and offset must be finite")
        if float(torch.linalg.det(self.matrix.detach()).abs()) == 0:
            raise InputError("Affine: the matrix is singular; it takes a volume to a plane")

    @classmethod
    def identity(cls, dim: int) -> "Affine":
        """Return x ↦ x in ``dim`` dimensions, float64."""
        return cls(torch.eye(dim, dtype=torch.float64), torch.zeros(dim, dtype=torch.float64))

    def __call__(self, points: Tensor) -> Tensor:
        """Return M x + t for points ``(B, D, *T)``, in their type and on their device."""
        offset = self.offset.to(points).view(1, -1, *([1] * (points.dim() - 2)))
        return torch.einsum("ij,bj...->bi...", self.matrix.to(points), points) + offset

    def inverse(self) -> "Affine":
        """Return the inverse map."""
        matrix = torch.linalg.inv(self.matrix)
        return Affine(matrix, -matrix @ self.offset)

    def then(self, other: "Affine") -> "Affine":
        """Return the map that applies this one first and ``other`` second."""
        return Affine(other.matrix @ self.matrix, other.matrix @ self.offset + other.offset)
