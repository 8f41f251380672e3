"""The optimiser as a layer: some steps of registration that can be differentiated, to refine a network's answer."""

import math

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from torchdeform.core.diagnostics import smallest_determinant
from torchdeform.core.flow import integrate
from torchdeform.core.fold_free import relaxed
from torchdeform.core.grid import Grid, per_item
from torchdeform.core.warp import compose, warp
from torchdeform.errors import InputError, require_choice
from torchdeform.fem.fast_transform import TransformSolver
from torchdeform.fem.form import Row, Term
from torchdeform.fem.operator import assemble_load
from torchdeform.nn.losses import SIMILARITIES
from torchdeform.nn.operators import open_share
from torchdeform.nn.precision import full_precision
from torchdeform.registration.optimise import image_force, in_voxels, metric_weights, step_length, strongest_of
from torchdeform.registration.settings import RegistrationSettings

# Measures of images as they are; ``mind`` compares features, which need warping of their own.
_MEASURES = ("ssd", "ncc", "lncc", "mi", "nmi", "ngf")


class DeformableRegistration(nn.Module):
    """Some steps of `register` on one grid: force = ∂S/∂warped ∇warped, K v = M force, φ ← φ ∘ flow(v).

    Args:
        grid: the grid of images and displacement.
        steps: how many.
        settings: ``similarity`` (a name but ``mind``), ``window``, ``weight_div``, ``weight_curl``, ``length``,
            ``elasticity``, ``power``, ``step_length``, ``momentum`` and ``min_determinant`` are used; those of the
            preset ``default`` when None.

    Raises:
        InputError: steps below 1, a similarity that is a mixture or ``mind``.

    Notes:
        Differentiable once in the images and in the start, through all steps: their gradients tell a network what its
        answer became, not what it was. The share of a step that would fold counts as constant. Each step is computed
        again in the backward, so what is kept is one displacement and one direction a step, and one step's own. Every
        step is looked at by the full certificate and shortened where it would fold, so a sound start ends as a sound
        map. The look at the certificate breaks no graph, checkpoints do: compile the network, not this.
    """

    def __init__(self, grid: Grid, *, steps: int = 20, settings: RegistrationSettings | None = None) -> None:
        super().__init__()
        settings = settings or RegistrationSettings()
        if steps < 1:
            raise InputError(f"DeformableRegistration: steps must be at least 1, got {steps}")
        require_choice(settings.similarity, _MEASURES, "DeformableRegistration: similarity")
        self.grid, self.steps, self.settings = grid, steps, settings

    @full_precision
    def forward(self, fixed: Tensor, moving: Tensor, start: Tensor | None = None) -> Tensor:
        """Return the displacement after the steps.

        Args:
            fixed: ``(B, C, *S)``, intensities about 0 to 1.
            moving: the same shape and scale.
            start: displacement ``(B, D, *S)`` in units of spacing to begin with; zero when None.

        Returns:
            u ``(B, D, *S)`` in units of spacing.

        Raises:
            InputError: shapes.
        """
        for name, image in (("fixed", fixed), ("moving", moving)):
            self.grid.check(image, f"DeformableRegistration: {name}", components=fixed.shape[1])
        u = fixed.new_zeros(fixed.shape[0], self.grid.dim, *self.grid.shape) if start is None else start
        self.grid.check_vector(u, "DeformableRegistration: start")
        metric = self._metric(fixed)
        carried = torch.zeros_like(u)
        for step in range(self.steps):
            pace = step_length(self.settings, step, self.steps)
            u, carried = checkpoint(self._step, fixed, moving, u, carried, pace, metric, use_reentrant=False)
        return u

    def _metric(self, like: Tensor) -> TransformSolver:
        weights = metric_weights(self.grid, self.settings, 0)
        return TransformSolver(self.grid, weights, "slip", dtype=like.dtype, device=like.device)

    def _step(
        self, fixed: Tensor, moving: Tensor, u: Tensor, carried: Tensor, pace: float, metric: TransformSolver
    ) -> tuple[Tensor, Tensor]:
        v = in_voxels(self._velocity(fixed, moving, u, metric), self.grid)
        carried = v + self.settings.momentum * carried
        move = pace * in_voxels(carried, self.grid)
        trial = compose(u, integrate(move, self.grid, steps=1, method="midpoint"), self.grid)
        trial = relaxed(trial, u.new_full((len(u),), self.settings.elasticity), self.grid)
        with torch.no_grad():
            least = smallest_determinant(u, self.grid).clamp(max=self.settings.min_determinant)
            share = open_share(u.detach(), (trial - u).detach(), least, self.grid.spacing, math.inf, math.inf)
        return u + per_item(share, u) * (trial - u), carried

    def _velocity(self, fixed: Tensor, moving: Tensor, u: Tensor, metric: TransformSolver) -> Tensor:
        """Return the velocity that least squares find for the force, its strongest part being 1."""
        warped = warp(moving, u, self.grid)
        force = image_force(self._slope(fixed, warped), warped, self.grid)
        force = force / per_item(strongest_of(force).clamp(min=torch.finfo(force.dtype).tiny), force)
        values = tuple(Row(1.0, (Term(1.0, k, None),)) for k in range(self.grid.dim))
        return metric.solve(assemble_load(values, force, self.grid), power=self.settings.power)

    def _slope(self, fixed: Tensor, warped: Tensor) -> Tensor:
        """Return N ∂S/∂warped, differentiable where a gradient is wanted."""
        wanted = torch.is_grad_enabled() and (fixed.requires_grad or warped.requires_grad)
        options = {"lncc": {"window": self.settings.window}, "ngf": {"grid": self.grid}}
        with torch.enable_grad():
            seen = warped if wanted and warped.requires_grad else warped.detach().requires_grad_()
            value = SIMILARITIES[str(self.settings.similarity)](
                fixed, seen, **options.get(str(self.settings.similarity), {})
            )
            slope = torch.autograd.grad(value.sum(), seen, create_graph=wanted)[0]
        return slope * warped[0].numel()

    def extra_repr(self) -> str:
        chosen = f"steps={self.steps}, similarity={self.settings.similarity!r}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {chosen}"
