"""Velocities from their divergence and curl, and the maps that they flow to."""

import torch
from torch import Tensor, nn

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.flow import ADAPTIVE, FIXED_STEP, OdeSolver, integrate
from torchdeform.core.grid import Grid
from torchdeform.core.warp import compose, keep_inside
from torchdeform.errors import InputError, require_choice
from torchdeform.fem.fast_transform import transform_is_exact
from torchdeform.fem.weights import Weights
from torchdeform.nn.operators import div_curl_velocity
from torchdeform.nn.precision import full_precision

_BOUNDARIES = ("slip", "no_slip_tangential", "dirichlet")


class DivCurlVelocity(nn.Module):
    """The velocity v that minimises ∫ w_div (div v − α)² + w_curl |curl v − β|² + w_zero |v|² over Q1 fields.

    Args:
        grid: the grid.
        boundary: ``slip`` (n·v = 0), ``dirichlet`` (v = 0) or ``no_slip_tangential`` (n×v = 0) on all faces.
        weight_div: w_div > 0.
        weight_curl: w_curl > 0.
        weight_zero: w_zero ≥ 0 per squared unit of spacing; √(w_div / w_zero) is the length beyond which v decays.

    Raises:
        InputError: an unknown boundary, weights out of range, or weights for which the transforms are not exact at
            this boundary (``dirichlet`` with w_div ≠ w_curl: `solve_div_curl` solves these by conjugate gradients).

    Notes:
        A direct solve by fast transforms, one node for torch.compile and torch.export. Its gradient is one more solve
        with the transposed operator; nothing is kept for it, and derivatives of every degree are there. Exact to
        rounding, so there is no tolerance. Factors are computed once for each dtype, device and thread. Always float32
        or float64, also within autocast. Liu, Liao & Xue 2007, eq. (3.1) and (3.5).
    """

    def __init__(
        self,
        grid: Grid,
        boundary: str = "slip",
        *,
        weight_div: float = 1.0,
        weight_curl: float = 1.0,
        weight_zero: float = 0.0,
    ) -> None:
        super().__init__()
        require_choice(boundary, _BOUNDARIES, "DivCurlVelocity: boundary")
        weights = Weights(weight_div, weight_curl, weight_zero)
        if not transform_is_exact(grid, weights, boundary):
            raise InputError(
                f"DivCurlVelocity: the transforms are not exact for {boundary} with these weights; make weight_div and "
                "weight_curl equal, or use solve_div_curl"
            )
        self.grid, self.boundary = grid, boundary
        self.weights = (float(weight_div), float(weight_curl), float(weight_zero))

    @full_precision
    def forward(self, div: Tensor, curl: Tensor | None = None) -> Tensor:
        """Return the velocity.

        Args:
            div: α ``(B, 1, *S)``, units of v per unit of spacing. Where n·v = 0 its mean does not matter: no velocity
                has it.
            curl: β ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, as `torchdeform.curl`; None stands for 0.

        Returns:
            v ``(B, D, *S)``, zero to the last bit where the boundary condition says so.

        Raises:
            InputError: shapes.
        """
        self.grid.check_scalar(div, "DivCurlVelocity: div")
        if curl is not None:
            self.grid.check(curl, "DivCurlVelocity: curl", components=len(CURL_PAIRS[self.grid.dim]))
        data = div if curl is None else torch.cat([div, curl], dim=1)
        return div_curl_velocity(_whole(data, self.grid), self.grid.spacing, self.weights, self.boundary)

    def extra_repr(self) -> str:
        names = ("weight_div", "weight_curl", "weight_zero")
        weights = ", ".join(f"{n}={w:g}" for n, w in zip(names, self.weights, strict=True))
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, boundary={self.boundary!r}, {weights}"


def _whole(data: Tensor, grid: Grid) -> Tensor:
    """Return α and β in one contiguous tensor, β being 0 where it was not given."""
    missing = 1 + len(CURL_PAIRS[grid.dim]) - data.shape[1]
    if missing:
        data = torch.cat([data, data.new_zeros(data.shape[0], missing, *grid.shape)], dim=1)
    return data.contiguous()


class FlowIntegrator(nn.Module):
    """The map φ = id + u that a stationary velocity flows to: dφ/dt = v(φ), φ = id at t = 0, up to t = 1.

    Args:
        grid: the grid.
        method: ``squaring`` (v/2ⁿ composed with itself n times), or a method of torchdiffeq: ``euler``, ``midpoint``,
            ``rk4``, ``dopri5``, see `OdeSolver`.
        steps: n for ``squaring``, else the steps of equal length.
        adjoint: for the methods of torchdiffeq, take gradients from the adjoint equation.

    Raises:
        InputError: an unknown method, a number of steps below 1, ``squaring`` with an adjoint.

    Notes:
        For one backward, ``squaring`` keeps about 2·D numbers per node and squaring, the methods of torchdiffeq about
        2·D per node and stage (``rk4`` has 4 stages a step). With ``adjoint`` 5·D are kept however many steps there
        are: the flow is followed backwards in time, which takes about as long again, and the gradient has the error of
        the method.
        torch.compile and torch.export take ``squaring`` in one graph; torchdiffeq breaks it.
    """

    def __init__(self, grid: Grid, method: str = "squaring", *, steps: int = 7, adjoint: bool = False) -> None:
        super().__init__()
        require_choice(method, ("squaring", *FIXED_STEP, *ADAPTIVE), "FlowIntegrator: method")
        OdeSolver(steps=steps)
        if adjoint and method == "squaring":
            raise InputError("FlowIntegrator: squaring has no adjoint equation; take method='rk4'")
        self.grid, self.method, self.steps, self.adjoint = grid, method, steps, adjoint

    @full_precision
    def forward(self, v: Tensor) -> Tensor:
        """Return the displacement of the flow.

        Args:
            v: velocity ``(B, D, *S)`` in units of spacing per unit of time.

        Returns:
            u ``(B, D, *S)`` in units of spacing; φ maps Ω into Ω.

        Raises:
            InputError: shape.
            ComputationError: ``dopri5`` found no step.
        """
        if self.method == "squaring":
            return square(v, self.grid, self.steps)
        return integrate(v, self.grid, self.steps, self.method, adjoint=self.adjoint)

    def inverse(self, v: Tensor) -> Tensor:
        """Return the displacement of φ⁻¹, which is the flow of −v; arguments and errors as `forward`."""
        return self.forward(-v)

    def extra_repr(self) -> str:
        how = f"method={self.method!r}, steps={self.steps}, adjoint={self.adjoint}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {how}"


def square(v: Tensor, grid: Grid, steps: int = 7) -> Tensor:
    """Return the displacement of the flow of v by scaling and squaring: φ ← φ ∘ φ, ``steps`` times, from id + v/2ⁿ.

    Args:
        v: velocity ``(B, D, *S)`` in units of spacing per unit of time.
        grid: its grid.
        steps: n.

    Returns:
        u ``(B, D, *S)`` in units of spacing.

    Raises:
        InputError: shape.

    Notes:
        Error O(2⁻ⁿ) and that of n linear interpolations. Costs n samplings. Differentiable.
    """
    u = v / 2**steps
    for _ in range(steps):
        u = compose(u, u, grid)
    return keep_inside(u, grid)
