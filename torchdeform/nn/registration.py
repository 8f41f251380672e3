"""The optimiser as a layer: some steps of registration that can be differentiated, to refine a network's answer."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp
from torchdeform.errors import InputError, require_choice, require_ranges
from torchdeform.metrics.similarity import MEASURES
from torchdeform.nn.precision import full_precision
from torchdeform.registration.objective import Objective
from torchdeform.registration.optimise import Level, elasticity_of, optimise_level
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.registration.velocity import VelocityMetric


class DeformableRegistration(nn.Module):
    """Some steps of `register` on one grid: force = ∂S/∂warped ∇warped, K v = M force, φ ← φ ∘ flow(v).

    Args:
        grid: the grid of images and displacement.
        steps: how many.
        settings: those of the preset ``default`` when None. Alignment, start, number of steps, tolerance and what is
            said of levels, landmarks and ``symmetric`` are not looked at. ``elasticity: auto`` is 0.2, as noise is not.

    Raises:
        InputError: steps below 1, a similarity that is a mixture or compares features (``mind``), or settings with
            ``features`` or ``labels_weight``.

    Notes:
        The loop of `register` itself, on one level. Differentiable once in the images and in the start, through all
        steps: their gradients tell a network what its answer became, not what it was. The share of a step that would
        fold counts as constant, and so does the divergence that is asked for where the map is nearly folded. Each step
        is computed again in the backward, so what is kept is two displacements a step, and one step's own. Every step
        is looked at by the full certificate and shortened where it would fold, so a sound start ends as a sound map.
        The look at the certificate breaks no graph, checkpoints do: compile the network, not this.
    """

    def __init__(self, grid: Grid, *, steps: int = 20, settings: RegistrationSettings | None = None) -> None:
        super().__init__()
        settings = settings or RegistrationSettings()
        # Others compare features, which are warped in place of the image.
        measures = [name for name, measure in MEASURES.items() if not measure.compares_features]
        if settings.sources or settings.labels_weight > 0:
            raise InputError("DeformableRegistration: features and labels_weight are for register; leave them out")
        settings = settings.decided()
        require_choice(settings.similarity.measure, measures, "DeformableRegistration: similarity")
        self.grid, self.steps, self.settings = grid, steps, settings
        require_ranges(self, "DeformableRegistration: ", steps="at least 1")

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
        level = Level(
            objective=Objective(_DifferentiableSimilarity(self.grid, fixed, moving, self.settings)),
            metric=VelocityMetric.of(self.grid, self.settings.metric, self.settings.solver, fixed),
            settings=self.settings,
            steps=self.steps,
            elasticity=elasticity_of(self.settings.metric, len(u)),
            keep_best=False,
            voxel=min(self.grid.spacing),
        )
        return optimise_level(level, u, run=partial(checkpoint, use_reentrant=False)).u

    def extra_repr(self) -> str:
        chosen = f"steps={self.steps}, similarity={self.settings.similarity.measure!r}"
        return f"shape={self.grid.shape}, spacing={self.grid.spacing}, {chosen}"


@dataclass(frozen=True)
class _DifferentiableSimilarity:
    """`SimilarityTerm` whose derivative comes from autograd, and can be differentiated itself."""

    grid: Grid
    fixed: Tensor
    moving: Tensor
    settings: RegistrationSettings

    def evaluate(self, u: Tensor, transfer: None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the moving image warped by u, S of each item, and N ∂S/∂warped; images and map have one grid."""
        warped, measure = warp(self.moving, u, self.grid), MEASURES[str(self.settings.similarity.measure)]
        options = measure.choose(window=self.settings.similarity.window, grid=self.grid)
        wanted = torch.is_grad_enabled() and (self.fixed.requires_grad or warped.requires_grad)
        with torch.enable_grad():
            seen = warped if wanted and warped.requires_grad else warped.detach().requires_grad_()
            value = measure.function(self.fixed, seen, **options)
            slope = torch.autograd.grad(value.sum(), seen, create_graph=wanted)[0]
        return warped, value, slope * warped[0].numel()
