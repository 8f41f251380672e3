"""Where a deformation begins: the alignment, kept only where it helps, and the similarity that suits both images."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdeform.core.image import AUTO, Image, overlap
from torchdeform.core.resampling import with_nodes
from torchdeform.core.stages import begin
from torchdeform.core.transform import Affine
from torchdeform.errors import InputError
from torchdeform.metrics.base import weighted
from torchdeform.metrics.correlation import LNCC_FLOOR, contrast, local_contrast, window_mean, window_moments
from torchdeform.metrics.similarity import mark, measure_name
from torchdeform.registration.affine.align import Alignment, align
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.keypoints import common_shift
from torchdeform.registration.problem import PlacedImage, RegistrationProblem, placed_images, resample_pair
from torchdeform.registration.settings import RegistrationSettings

# Kinds of tissue that only a rigid alignment leaves as they are, and the alignments that it then takes the place of.
_KEPT, _CHANGING = {"rigid", "incompressible"}, ("similarity", "affine")

# An alignment is taken where it raises the merit by more than this.
_GAIN = 1e-4

# Local correlations are compared on at most so many nodes to the power of D, in windows of so many, which count half
# where their standard deviation is a grey level of 3 %.
_NODES, _WINDOW, _CLEAR = 128, 9, 0.03

# Weight of the directions of edges beside self-similarities without noise; with so large a share of noise none.
_EDGES, _NOISY = 0.3, 0.2

# Share of one sign in the local correlations from which on both images have one contrast. On the pairs of one contrast
# in docs/accuracy.md it is 0.92 and more, in two contrasts 0.09 to 0.45 (spine T1 and T2, brain maps painted as both).
_ONE_CONTRAST = 0.65


@dataclass(frozen=True)
class Placement:
    """How a registration begins.

    Attributes:
        settings: the settings, with a similarity and a start in place of ``auto``.
        affine: map of the world from the fixed to the moving image; None for the identity.
        alignment: how it was found; None where it was given, or none was asked for.
        unaligned: `mark` of both images where the files place them ``(1,)``; None where they do not overlap, or where
            nothing was aligned or shifted.
        choice: a sentence on the similarity that was chosen; None where it was given.
    """

    settings: RegistrationSettings
    affine: Affine | None = None
    alignment: Alignment | None = None
    unaligned: Tensor | None = None
    choice: str | None = None


@torch.no_grad()
def place(
    fixed: Image, moving: Image, settings: RegistrationSettings, annotations: Annotations, affine: Affine | None = None
) -> Placement:
    """Return where the deformation of two images begins, and how they are compared.

    Args:
        fixed: image that stays.
        moving: image that is warped.
        settings: what is asked for.
        annotations: masks.
        affine: map of the world that is known already; None to align as the settings say.

    Notes:
        The alignment is not taken where the files' own place has as much merit: `mark` times the share of the fixed
        image's contrast that is seen, at full detail, in the measure of the registration. Merit counts what the moving
        image does not show as unrelated, so that both places are judged over the same voxels.
        Without an alignment, ``start: keypoints`` begins with the translation that most of its points share, if they
        are far away: what it brings into the box cannot be seen, or reached by a map of the box, otherwise.
        Where tissue is to keep its shape or its volume, ``similarity`` and ``affine`` become ``rigid``.
    """
    settings = _keeping_tissue(settings)
    both, alignment = placed_images(fixed, moving, annotations.masks), None
    if affine is None and settings.align.kind != "none":
        alignment = _align(fixed, moving, settings, annotations)
        affine = alignment.affine
    problem, shift = problem_at(*both, affine).scaled(settings), None
    if affine is None and settings.start == "keypoints":
        affine = shift = _shift(both[0].image, problem, settings)
        problem = problem if affine is None else problem_at(*both, affine).scaled(settings)
    settings, choice = choose(problem, settings)
    if alignment is None and shift is None:
        return Placement(settings, affine, choice=choice)
    unaligned, merit = _marked_as_they_are(*both, settings) if overlap(fixed, moving) > 0 else (None, None)
    if alignment is None:
        return Placement(settings, affine, unaligned=unaligned, choice=choice)
    if merit is not None and not bool(_marked(problem, settings)[1] > merit + _GAIN):
        kept = replace(alignment, affine=Affine.identity(fixed.grid.dim), start="geometry")
        alignment = replace(kept, similarity_after=alignment.similarity_before)
    return Placement(settings, alignment.affine, alignment, unaligned, choice)


def _shift(fixed: Image, problem: RegistrationProblem, settings: RegistrationSettings) -> Affine | None:
    """Return the translation of the world by which the points of two images move as a whole, None if not far."""
    masks = {"mask": problem.fixed_mask, "moving_mask": problem.moving_mask}
    shift = common_shift(problem.fixed, problem.moving, problem.grid, **masks, settings=settings.keypoints)
    if shift is None:
        return None
    ends = torch.stack([torch.zeros_like(shift), shift], dim=1).double().cpu().unsqueeze(0)
    start, end = fixed.to_world(ends)[0].unbind(1)
    return replace(Affine.identity(fixed.grid.dim), offset=end - start)


def _keeping_tissue(settings: RegistrationSettings) -> RegistrationSettings:
    """Return the settings with a rigid alignment where another would change tissue that is to be kept."""
    kinds = {kind for kind in settings.tissues.values() if isinstance(kind, str)}
    if not kinds & _KEPT or settings.align.kind not in _CHANGING:
        return settings
    return replace(settings, align=replace(settings.align, kind="rigid"))


def _align(fixed: Image, moving: Image, settings: RegistrationSettings, annotations: Annotations) -> Alignment:
    """Align as the settings say, with masks."""
    begin("aligning")
    masks = (annotations.fixed_mask, annotations.moving_mask)
    first, second = (mask if isinstance(mask, Image) else None for mask in masks)
    return align(fixed, moving, fixed_mask=first, moving_mask=second, settings=settings.align)


def problem_at(fixed: PlacedImage, moving: PlacedImage, affine: Affine | None) -> RegistrationProblem:
    """Return the problem on the fixed grid, the moving image being where an affine map of the world finds it."""
    return resample_pair(fixed, moving if affine is None else moving.moved(affine.inverse()), fixed.image)


def _marked(problem: RegistrationProblem, settings: RegistrationSettings) -> tuple[Tensor, Tensor]:
    """Return mark and merit of two images on their scale, each ``(B,)``."""
    mask, window = problem.mask, settings.similarity.window
    found = mark(settings.seen_by, problem.fixed, problem.moving, mask=mask, window=window, grid=problem.grid)
    contrast = local_contrast(problem.fixed, window)
    counted, seen = (weighted(contrast, given) for given in (problem.fixed_mask, mask))
    return found, found * (seen.flatten(1).sum(1) / counted.flatten(1).sum(1))


def _marked_as_they_are(
    fixed: PlacedImage, moving: PlacedImage, settings: RegistrationSettings
) -> tuple[Tensor, Tensor]:
    """Return mark and merit of two images where the files place them, 0 where they show nothing in common."""
    problem = problem_at(fixed, moving, None)
    nothing = problem.fixed.new_zeros(len(problem.fixed))
    if problem.mask is not None and not bool(problem.mask.any()):
        return nothing, nothing
    try:
        return _marked(problem.scaled(settings), settings)
    except InputError:  # the part of an image that is seen is constant
        return nothing, nothing


def choose(problem: RegistrationProblem, settings: RegistrationSettings) -> tuple[RegistrationSettings, str | None]:
    """Return the settings with a similarity in place of ``auto``, and a sentence on the choice; None without one.

    Args:
        problem: the images in the place where the deformation begins, scaled to about [0, 1].
        settings: what is asked for.

    Notes:
        ``lncc`` where one intensity is locally a linear function of the other, which shows in local correlations of one
        sign; where they change their sign from place to place ``mind``, with ``ngf`` beside it the less noise there is,
        and a discrete start.
    """
    if settings.similarity.measure != AUTO:
        return settings.decided(), None
    if settings.only_features:
        return settings.decided(), "similarity ssd: features are compared by the squared difference of unit vectors"
    agreement = sign_agreement(problem)
    measure = "lncc" if agreement >= _ONE_CONTRAST else _across_contrasts(problem)
    kind, name = "one contrast" if measure == "lncc" else "different contrasts", measure_name(measure)
    sentence = f"similarity {name}: the images have {kind} (local correlations of one sign: {agreement:.0%})"
    return settings.decided(measure), sentence


def _across_contrasts(problem: RegistrationProblem) -> str | dict[str, float]:
    """Return the measure for images of different contrast: edges are sharper than self-similarities, but noise has any.

    With ``ngf`` beside ``mind`` label maps painted as T1 and T2 (noise of 5 to 10 %) end 0.02 Dice nearer; a spine with
    23 % of noise ends 0.06 to 0.09 farther.
    """
    edges = round(_EDGES * (1 - float(problem.measured_noise().amax()) / _NOISY), 2)
    return {"mind": 1.0, "ngf": edges} if edges > 0 else "mind"


def sign_agreement(problem: RegistrationProblem) -> float:
    """Return |Σ t r| / Σ t |r|, r being the correlations in windows and t their contrast in both: 1 for one sign.

    Args:
        problem: images scaled to about [0, 1]; a batch is taken as one.
    """
    problem = problem.on(with_nodes(problem.grid, _NODES**problem.grid.dim))
    images = problem.fixed, problem.moving
    means, spread = zip(*(window_moments(image, _WINDOW) for image in images), strict=True)
    covariance = window_mean(images[0] * images[1], _WINDOW) - means[0] * means[1]
    r = covariance / ((spread[0] + LNCC_FLOOR) * (spread[1] + LNCC_FLOOR)).sqrt()
    weight = weighted(contrast(spread[0], _CLEAR) * contrast(spread[1], _CLEAR), problem.mask)
    return float((weight * r).sum().abs() / (weight * r.abs()).sum().clamp(min=torch.finfo(r.dtype).tiny))
