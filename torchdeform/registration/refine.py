"""A result brought to a finer grid than it was found on, where memory did not allow that grid from the start."""

from dataclasses import replace

import torch

from torchdeform.diagnostics import diagnose, inverse_error
from torchdeform.image import Image, resample
from torchdeform.registration.evaluation import evaluate_images
from torchdeform.registration.guidance import Guidance
from torchdeform.registration.placing import moved
from torchdeform.registration.pyramid import prolong
from torchdeform.registration.result import RegistrationResult
from torchdeform.registration.steps import mended


@torch.no_grad()
def onto_grid(result: RegistrationResult, fixed: Image, moving: Image, guidance: Guidance) -> RegistrationResult:
    """Return the result on the grid of ``fixed``, everything that follows from its maps made anew.

    Args:
        result: of images, on a coarser grid of the same box.
        fixed: the fixed image, whose grid is wanted.
        moving: the moving image.
        guidance: labels and landmarks to measure.

    Returns:
        The result with both maps interpolated linearly, which keeps them fold-free or mends them; similarities are
        those of the grid on which it was found.
    """
    grid = fixed.grid
    u, inverse = (mended(prolong(w, grid), grid) for w in (result.displacement, result.inverse))
    mean, largest = inverse_error(u, inverse, grid)
    seen = moving if result.affine is None else moved(moving, result.affine.inverse())
    return replace(
        result,
        displacement=u,
        inverse=inverse,
        grid=grid,
        warped=resample(seen, fixed, u).to(moving.data.dtype),
        diagnosis=diagnose(u, grid),
        inverse_error_mean=mean,
        inverse_error_max=largest,
        evaluation=evaluate_images(fixed, guidance, result.affine, u),
    )
