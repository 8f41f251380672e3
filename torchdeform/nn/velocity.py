"""Velocities from their divergence and curl, and the maps that they flow to."""

from dataclasses import fields

import torch
from torch import Tensor, nn

from torchdeform.core.derivatives import CURL_PAIRS
from torchdeform.core.flow import OdeSolver, integrate
from torchdeform.core.grid import Grid
from torchdeform.core.tables import in_transformation
from torchdeform.errors import InputError, require_choice
from torchdeform.fem.fast_transform import is_exact_for
from torchdeform.fem.solver import SolverSettings
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weight, Weights
from torchdeform.nn.operators import div_curl_velocity
from torchdeform.nn.precision import full_precision
from torchdeform.nn.weighted import weighted_velocity

_NAMES = tuple(f"weight_{field.name}" for field in fields(Weights))
_BOUNDARIES = ("slip", "no_slip_tangential", "dirichlet")


class DivCurlVelocity(nn.Module):
    """The velocity v that minimises ∫ w_d (div v − α)² + w_c |curl v − β|² + w_s |dev sym ∇v|² + w_0 |v|², Q1 fields.

    Args:
        grid: the grid.
        boundary: ``slip`` (n·v = 0), ``dirichlet`` (v = 0) or ``no_slip_tangential`` (n×v = 0) on all faces.
        weights: w_d, w_c, w_0, w_s: numbers, or tensors with a value for each element, see `Weights`; 1, 1, 0, 0 by
            default. Parameters among them are parameters of the layer, other tensors buffers, as ``weight_div`` etc.
        weight_div: w_d > 0, in place of ``weights``, as the following.
        weight_curl: w_c ≥ 0, positive where w_s is 0.
        weight_zero: w_0 ≥ 0 per squared unit of spacing; √(w_d / w_0) is the length beyond which v decays.
        weight_strain: w_s ≥ 0.
        solver: ``auto``, ``transform``, ``cg`` or ``assembled``, see `SolverSettings`.

    Raises:
        InputError: an unknown boundary or solver, weights out of range or given twice, or ``transform`` where it is not
            exact.

    Notes:
        ``auto`` is a direct solve by fast transforms where they are exact (constant weights without a strain; for
        ``dirichlet`` w_d = w_c), else conjugate gradients; either is one node for torch.compile and torch.export. Its
        gradient is one more solve with the transposed operator, and derivatives of every degree are there, in weights
        that are tensors too. Nothing is kept for it where weights are numbers, for which solvers are made ready once
        for each dtype, device and thread. Always float32 or float64, also within autocast.
        Liu, Liao & Xue 2007, eq. (3.1) and (3.5).
    """

    def __init__(
        self,
        grid: Grid,
        boundary: str = "slip",
        *,
        weights: Weights | None = None,
        weight_div: float = 1.0,
        weight_curl: float = 1.0,
        weight_zero: float = 0.0,
        weight_strain: float = 0.0,
        solver: str = "auto",
    ) -> None:
        super().__init__()
        require_choice(boundary, _BOUNDARIES, "DivCurlVelocity: boundary")
        short = Weights(weight_div, weight_curl, weight_zero, weight_strain)
        if weights is not None and short != Weights():
            raise InputError("DivCurlVelocity: weights are given twice; give weights, or weight_div and its like")
        chosen = short if weights is None else weights
        _require_weights(chosen, grid)
        if not in_transformation():  # which may hide the values until they are used
            chosen.check(grid)
        system = DivCurlSystem(grid, chosen, boundary)
        if SolverSettings(method=solver).method == "transform" and not is_exact_for(system):
            raise InputError(
                f"DivCurlVelocity: the transforms are not exact for {boundary} with these weights; make weight_div and "
                "weight_curl equal, or take solver='auto'"
            )
        self.grid, self.boundary, self.solver = grid, boundary, solver
        for name, value in zip(_NAMES, chosen.values, strict=True):
            if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
                self.register_buffer(name, value)
            else:
                setattr(self, name, value)

    @property
    def weights(self) -> Weights:
        """The weights of the layer."""
        return Weights(*(getattr(self, name) for name in _NAMES))

    @full_precision
    def forward(self, div: Tensor, curl: Tensor | None = None, weights: Weights | None = None) -> Tensor:
        """Return the velocity.

        Args:
            div: α ``(B, 1, *S)``, units of v per unit of spacing. Where n·v = 0 no velocity has its mean: that is left
                over, where divergence is cheap.
            curl: β ``(B, 1, *S)`` in 2D, ``(B, 3, *S)`` in 3D, as `torchdeform.curl`; None stands for 0.
            weights: those of this call, with tensors that a network predicted, ``(B or 1, 1, *E)``; those of the layer
                when None.

        Returns:
            v ``(B, D, *S)``, zero to the last bit where the boundary condition says so.

        Raises:
            InputError: shapes, weights out of range.
            ComputationError: conjugate gradients met no tolerance.
        """
        self.grid.check_scalar(div, "DivCurlVelocity: div")
        if curl is not None:
            self.grid.check(curl, "DivCurlVelocity: curl", components=len(CURL_PAIRS[self.grid.dim]))
        chosen = self.weights if weights is None else weights
        _require_weights(chosen, self.grid)
        data = _whole(div if curl is None else torch.cat([div, curl], dim=1), self.grid)
        if chosen.tensors:
            system = DivCurlSystem(self.grid, chosen.to(data), self.boundary)
            return weighted_velocity(data, system, self.solver)
        numbers = [float(weight) for weight in chosen.values]
        return div_curl_velocity(data, self.grid.spacing, numbers, self.boundary, self.solver)

    def extra_repr(self) -> str:
        weights = ", ".join(f"{n}={_said(w)}" for n, w in zip(_NAMES, self.weights.values, strict=True))
        chosen = f"boundary={self.boundary!r}, {weights}, solver={self.solver!r}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {chosen}"


def _require_weights(weights: object, grid: Grid) -> None:
    if not isinstance(weights, Weights):
        got = type(weights).__name__
        raise InputError(f"DivCurlVelocity: weights must be Weights(div=.., curl=..), of numbers or tensors, got {got}")
    weights.check_shapes(grid)


def _said(weight: Weight) -> str:
    return f"tensor{tuple(weight.shape)}" if isinstance(weight, Tensor) else f"{weight:g}"


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
        method: ``squaring`` (v/2ⁿ composed with itself n times), or one that torchdiffeq runs: ``euler``, ``midpoint``,
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
        torch.compile and torch.export take all but ``dopri5`` and ``adjoint`` in one graph: traced, the methods of
        fixed steps run without torchdiffeq, to the same numbers but for rounding.
    """

    def __init__(self, grid: Grid, method: str = "squaring", *, steps: int = 7, adjoint: bool = False) -> None:
        super().__init__()
        OdeSolver(method=method, steps=steps, adjoint=adjoint)
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
        return integrate(v, self.grid, self.steps, self.method, adjoint=self.adjoint)

    def inverse(self, v: Tensor) -> Tensor:
        """Return the displacement of φ⁻¹, which is the flow of −v; arguments and errors as `forward`."""
        return self.forward(-v)

    def extra_repr(self) -> str:
        how = f"method={self.method!r}, steps={self.steps}, adjoint={self.adjoint}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {how}"
