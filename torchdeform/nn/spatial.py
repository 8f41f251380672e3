"""Images, labels and points carried by a map."""

import torch
from torch import Tensor, nn

from torchdeform.core.grid import Grid
from torchdeform.core.warp import sample, warp
from torchdeform.errors import InputError, require_choice
from torchdeform.nn.precision import full_precision


class SpatialTransformer(nn.Module):
    """Carry images, labels and points by φ = id + u: warped(x) = image(φ(x)), and a point p of fixed goes to φ(p).

    Args:
        grid: the grid of images and displacements.
        mode: ``linear`` or ``nearest``, for images.
        outside: value of images for points more than half a voxel outside Ω; None continues the edge.

    Raises:
        InputError: an unknown mode.

    Notes:
        Has no parameters and no buffers, so it works for any batch, dtype and device. Positions are computed in float32
        or float64, also within autocast: 16 bits cannot tell the voxels of an image apart.
    """

    def __init__(self, grid: Grid, *, mode: str = "linear", outside: float | None = None) -> None:
        super().__init__()
        require_choice(mode, ("linear", "nearest"), "SpatialTransformer: mode")
        self.grid, self.mode, self.outside = grid, mode, outside

    def forward(self, image: Tensor, u: Tensor) -> Tensor:
        """Return the warped image.

        Args:
            image: ``(B, C, *S)``.
            u: displacement ``(B, D, *S)`` in units of spacing.

        Returns:
            ``(B, C, *S)`` with the dtype of the image.

        Raises:
            InputError: shapes.
        """
        return self._warp(image, u).to(image.dtype)

    def label(self, labels: Tensor, u: Tensor) -> Tensor:
        """Return the labels ``(B, C, *S)``, whole numbers or floating, of the nearest voxel; 0 outside if that is set.

        Args:
            labels: ``(B, C, *S)``, of any dtype; exact for whole numbers up to 2²⁴.
            u: displacement ``(B, D, *S)`` in units of spacing.

        Raises:
            InputError: shapes.
        """
        outside = None if self.outside is None else 0.0
        values = labels if labels.is_floating_point() else labels.to(torch.promote_types(u.dtype, torch.float32))
        return _nearest(values, u, self.grid, outside).to(labels.dtype)

    @full_precision
    def points(self, points: Tensor, u: Tensor) -> Tensor:
        """Return p + u(p): where points of the fixed space lie in the moving space.

        Args:
            points: ``(B, D, *T)`` in units of spacing, array-axis order, node 0 at the origin.
            u: displacement ``(B, D, *S)`` in units of spacing.

        Returns:
            ``(B, D, *T)``. Images are pulled back: where the warped image shows at x what the moving image shows at
            φ(x), the point x of fixed goes to φ(x). To take points of moving to fixed, give the inverse map.

        Raises:
            InputError: shapes.
        """
        self.grid.check_vector(u, "SpatialTransformer.points: u")
        if points.dim() < 3 or points.shape[1] != self.grid.dim:
            raise InputError(
                f"SpatialTransformer.points: points must have shape (B, {self.grid.dim}, *T), got {tuple(points.shape)}"
            )
        return points + sample(u, points, self.grid)

    @full_precision
    def _warp(self, image: Tensor, u: Tensor) -> Tensor:
        return warp(image, u, self.grid, mode=self.mode, outside=self.outside)

    def extra_repr(self) -> str:
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, mode={self.mode!r}, outside={self.outside}"


@full_precision
def _nearest(labels: Tensor, u: Tensor, grid: Grid, outside: float | None) -> Tensor:
    return warp(labels, u, grid, mode="nearest", outside=outside)
