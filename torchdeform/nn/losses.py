"""Losses: similarities, overlap of labels, and what a map may cost. All are scalars to be minimised."""

import torch
from torch import Tensor, nn

from torchdeform.core.derivatives import curl, divergence, jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import compose
from torchdeform.errors import InputError, require_choice, require_ranges
from torchdeform.metrics.similarity import MEASURES
from torchdeform.nn.precision import full_precision

# Determinants below this share the price 1/J of this one in `DeterminantLoss`, or it would be infinite.
_SMALLEST = 1e-2


class SimilarityLoss(nn.Module):
    """The loss −S(fixed, warped), averaged over the batch.

    Args:
        name: ``ssd``, ``ncc``, ``lncc``, ``mi``, ``nmi``, ``ngf`` or ``mind``.
        options: what that function takes beside the images, for instance ``window`` of `lncc`, ``bins`` of
            `normalised_mutual_information`, ``edge`` and ``grid`` of `ngf`, ``radius`` of `mind`.

    Raises:
        InputError: an unknown name.

    Notes:
        In float32 or float64, also within autocast. The scales differ: −S is at best 0 for ``ssd`` and ``mind``, −1 for
        ``ncc``, ``lncc`` and ``ngf``, −2 for ``nmi``.
    """

    def __init__(self, name: str, **options: object) -> None:
        super().__init__()
        require_choice(name, MEASURES, "SimilarityLoss: name")
        self.name, self.options = name, options

    @full_precision
    def forward(self, fixed: Tensor, warped: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return −S.

        Args:
            fixed: ``(B, C, *S)``.
            warped: the same shape.
            mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.

        Raises:
            InputError: as the similarity.
        """
        return -MEASURES[self.name].function(fixed, warped, mask=mask, **self.options).mean()

    def extra_repr(self) -> str:
        return ", ".join([repr(self.name), *(f"{key}={value!r}" for key, value in self.options.items())])


class DiceLoss(nn.Module):
    """The loss 1 − mean 2 ∫ p q / (∫ p² + ∫ q²) over items and channels, for labels as one channel each.

    Args:
        smoothing: added above and below, so that channels which are empty in both cost nothing.

    Raises:
        InputError: a smoothing that is not positive.
    """

    def __init__(self, smoothing: float = 1e-5) -> None:
        super().__init__()
        self.smoothing = smoothing
        require_ranges(self, "DiceLoss: ", smoothing="positive")

    @full_precision
    def forward(self, fixed: Tensor, warped: Tensor) -> Tensor:
        """Return the loss.

        Args:
            fixed: ``(B, C, *S)``, 0 to 1, a channel per label (leave the background out).
            warped: the same shape.

        Raises:
            InputError: the shapes differ.
        """
        if fixed.shape != warped.shape:
            raise InputError(f"DiceLoss: fixed and warped must agree, got {tuple(fixed.shape)}, {tuple(warped.shape)}")
        both = 2 * (fixed * warped).flatten(2).sum(2) + self.smoothing
        each = (fixed.square() + warped.square()).flatten(2).sum(2) + self.smoothing
        return 1 - (both / each).mean()

    def extra_repr(self) -> str:
        return f"smoothing={self.smoothing:g}"


class _MapLoss(nn.Module):
    """A price of displacements on a grid."""

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        self.grid = grid

    def extra_repr(self) -> str:
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}"


class DeterminantLoss(_MapLoss):
    """The loss mean (J − 1)²/J = mean (J + 1/J − 2), J = det ∇φ: the same for growing and shrinking, φ and φ⁻¹ alike.

    Args:
        grid: the grid.

    Notes:
        J by central differences. Where J < 0.01 the price is (J − 1)²/0.01, which pulls a fold open.
    """

    @full_precision
    def forward(self, u: Tensor) -> Tensor:
        """Return the loss for u ``(B, D, *S)`` in units of spacing; `InputError` for another shape."""
        det = jacobian_determinant(u, self.grid)
        return ((det - 1).square() / det.clamp(min=_SMALLEST)).mean()


class DivergenceLoss(_MapLoss):
    """The loss mean (div u)².

    Args:
        grid: the grid.
    """

    @full_precision
    def forward(self, u: Tensor) -> Tensor:
        """Return the loss for u or a velocity ``(B, D, *S)`` in units of spacing; `InputError` for another shape."""
        return divergence(u, self.grid).square().mean()


class CurlLoss(_MapLoss):
    """The loss mean |curl u|², the components summed.

    Args:
        grid: the grid.
    """

    @full_precision
    def forward(self, u: Tensor) -> Tensor:
        """Return the loss for u or a velocity ``(B, D, *S)`` in units of spacing; `InputError` for another shape."""
        return curl(u, self.grid).square().sum(1).mean()


class InverseConsistencyLoss(_MapLoss):
    """The loss mean |φ(ψ(x)) − x|² + mean |ψ(φ(x)) − x|² in squared voxels, φ = id + u and ψ = id + w.

    Args:
        grid: the grid.
    """

    @full_precision
    def forward(self, u: Tensor, w: Tensor) -> Tensor:
        """Return the loss for u and w, both ``(B, D, *S)`` in units of spacing; `InputError` for other shapes."""
        spacing = self.grid.along(self.grid.spacing, u)
        both = (compose(u, w, self.grid), compose(w, u, self.grid))
        return torch.stack([(left / spacing).square().sum(1).mean() for left in both]).sum()
