"""The end of a network that answers with a map: features become a bounded monitor and curl, these a sound map."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.flow import OdeSolver, integrate_rate
from torchdeform.core.grid import Grid, per_item
from torchdeform.core.resampling import prolong
from torchdeform.core.warp import warp
from torchdeform.errors import InputError, require_ranges
from torchdeform.nn.operators import div_curl_velocity, share_within_bounds
from torchdeform.nn.precision import full_precision

_CONV = {2: nn.Conv2d, 3: nn.Conv3d}

# Standard deviation of the weights at the start: the first map is near the identity.
_FIRST_WEIGHTS = 1e-2


class JacobianCurlHead(nn.Module):
    """A convolution to a monitor f and a curl g, and the map φ with J(φ) = f whose velocity has the curl g.

    f = F/mean F with F = r^tanh(a), g = c·tanh(b) for the outputs a, b of the convolution; div v = f − 1, curl v = g,
    n·v = 0; dφ/dt = v(φ)/(t + (1 − t) f(φ)) from t = 0 to 1, Version 1 of the deformation method. Where the grid
    cannot follow this without a fold, the displacement of that item is drawn back until no one-sided determinant is
    below ``least``.

    Args:
        channels: number of feature channels.
        grid: the grid of the displacement wanted.
        ratio: r > 1: F lies between 1/r and r.
        curl: c > 0, bound of every component of curl v.
        steps: steps of the midpoint rule.
        least: smallest one-sided determinant that is allowed, above 0 and below 1.

    Raises:
        InputError: a value out of range.

    Notes:
        φ maps Ω onto itself and has no folds by the full certificate (`diagnose`), whatever the weights and the
        features, as long as they are finite. How much was drawn back counts as constant for the gradient. The features
        may be coarser than the grid (Ω is the same box): the map is found where they are, and interpolated linearly.
        Costs one convolution, one solve, 2·steps − 1 samplings of D + 1 channels and one look at the certificate. For
        one backward, the flow keeps about 3·D + 1 numbers per node and sampling. Always float32 or float64, also
        within autocast; one graph for torch.compile and torch.export. Liu, Liao & Xue 2007, eq. (2.2) and (2.3).
    """

    def __init__(
        self,
        channels: int,
        grid: Grid,
        *,
        ratio: float = 4.0,
        curl: float = 1.0,
        steps: int = 4,
        least: float = 0.01,
    ) -> None:
        super().__init__()
        self.grid, self.ratio, self.curl, self.steps, self.least = grid, ratio, curl, steps, least
        above_1 = (lambda x: 1 < x < math.inf, "be finite and above 1")
        ranges = {"ratio": above_1, "curl": "positive", "steps": "at least 1", "least": "inside 0 to 1"}
        require_ranges(self, "JacobianCurlHead: ", **ranges)
        self.conv = _CONV[grid.dim](channels, 1 + len(CURL_PAIRS[grid.dim]), 3, padding=1)
        nn.init.normal_(self.conv.weight, std=_FIRST_WEIGHTS)
        nn.init.zeros_(self.conv.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Return the displacement u ``(B, D, *S)`` in units of spacing.

        Args:
            features: ``(B, channels, *T)``, T as S or coarser, 2 nodes an axis at least.

        Raises:
            InputError: shape.
        """
        return self.deform(*self.fields(features))

    def fields(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return f ``(B, 1, *T)`` with mean 1, and g ``(B, 1, *T)`` in 2D, ``(B, 3, *T)`` in 3D.

        Args:
            features: ``(B, channels, *T)``.

        Raises:
            InputError: shape.
        """
        if features.dim() != self.grid.dim + 2 or features.shape[1] != self.conv.in_channels:
            want = f"(B, {self.conv.in_channels}, {self.grid.dim} axes)"
            raise InputError(f"JacobianCurlHead: features must have shape {want}, got {tuple(features.shape)}")
        return self._bounded(self.conv(features))

    @full_precision
    def _bounded(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        monitor = torch.exp(math.log(self.ratio) * raw[:, :1].tanh())
        return with_mean_one(monitor, self.grid.with_shape(raw.shape[2:])), self.curl * raw[:, 1:].tanh()

    @full_precision
    def deform(self, f: Tensor, curl: Tensor) -> Tensor:
        """Return u from the monitor and the curl that `fields` returns; arguments and result as there."""
        u = prolong(flow_to_monitor(f, curl, self.grid.with_shape(f.shape[2:]), self.steps), self.grid)
        return scale_to_bounds(u, self.grid, self.least)

    def extra_repr(self) -> str:
        bounds = f"ratio={self.ratio:g}, curl={self.curl:g}, steps={self.steps}, least={self.least:g}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {bounds}"


def scale_to_bounds(
    u: Tensor, grid: Grid, min_det: float, max_det: float = math.inf, max_curl: float = math.inf
) -> Tensor:
    """Return t u with the share t ≤ 1 of each item, constant for the gradient, that `share_within_bounds` finds.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        grid: its grid.
        min_det: smallest one-sided determinant allowed, below 1.
        max_det: largest determinant of central differences allowed, above 1.
        max_curl: largest component of the curl allowed.
    """
    return u * per_item(share_within_bounds(u.detach(), grid.spacing, min_det, max_det, max_curl), u)


def with_mean_one(f: Tensor, grid: Grid) -> Tensor:
    """Return f ``(B, 1, *S)`` divided by its mean over Ω, as `normalise_monitor`, but without looking at the values."""
    weights = grid.quadrature(dtype=f.dtype, device=f.device) / grid.volume
    return f / per_item((f * weights).flatten(1).sum(1), f)


def flow_to_monitor(f: Tensor, curl: Tensor, grid: Grid, steps: int) -> Tensor:
    """Return u of φ = id + u at t = 1: dφ/dt = v(φ)/(t + (1 − t) f(φ)) with div v = f − 1, curl v = g, n·v = 0.

    Args:
        f: monitor ``(B, 1, *S)``, positive with mean 1.
        curl: g ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, units of v per unit of spacing.
        grid: the grid.
        steps: equal steps of the midpoint rule.

    Returns:
        ``(B, D, *S)`` in units of spacing; boundary nodes stay on their faces.

    Notes:
        Second order in the step and in the spacing. `grid_from_initial_monitor` is this with corrections and checks.
        Differentiable once in f and curl.
    """
    v = div_curl_velocity(torch.cat([f - 1, curl], dim=1), grid.spacing, (1.0, 1.0, 0.0), "slip")
    fields, still = torch.cat([v, f], dim=1), torch.zeros_like(v)

    def rate(t: Any, u: Tensor) -> Tensor:
        moved = fields if u is still else warp(fields, u, grid)
        return moved[:, :-1] / (moved[:, -1:] * (1 - t) + t)

    return integrate_rate(rate, still, (0.0, 1.0), grid, OdeSolver(method="midpoint", steps=steps))[-1]
