"""The mean squared difference, of intensities or of MIND-SSC features."""

from torch import Tensor

from torchdeform.metrics.base import Similarity, at_least_float32, checked, mean, relative_weight, weighted
from torchdeform.metrics.mind import mind_ssc


class MeanSquaredDifference(Similarity):
    """S = −mean (warped − fixed)².

    Args:
        fixed: ``(B, C, *S)``.
    """

    def __init__(self, fixed: Tensor) -> None:
        self.fixed = at_least_float32(fixed)

    def evaluate(self, warped: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        difference = self.fixed - at_least_float32(warped)
        weight = relative_weight(mask, difference)
        slope = weighted(difference, weight)
        return -mean(slope * difference), 2 * slope


def ssd(fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None) -> Tensor:
    """Return S = −mean (warped − fixed)², 0 at best.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape, on the same intensity scale.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None.

    Returns:
        ``(B,)`` in squared units of intensity, weighted mean over voxels and channels.

    Raises:
        InputError: shapes.

    Notes:
        Differentiable to every degree. `MeanSquaredDifference` has the derivative in closed form.
    """
    fixed, warped = checked(fixed, warped, mask)
    difference = fixed - warped
    return -mean(difference.square(), relative_weight(mask, difference))


def mind(fixed: Tensor, warped: Tensor, *, mask: Tensor | None = None, radius: int = 1, dilation: int = 1) -> Tensor:
    """Return S = −mean (MIND(warped) − MIND(fixed))², between −1 and 0, for images of different contrast.

    Args:
        fixed: ``(B, C, *S)``, any unit.
        warped: the same shape.
        mask: weight of each voxel ``(B, 1, *S)``, 0 to 1; all ones when None. The features at a voxel depend on the
            intensities around it, also on those where the weight is 0.
        radius: of the patches in voxels, see `mind_ssc`.
        dilation: distance of the neighbours in voxels, see `mind_ssc`.

    Returns:
        ``(B,)``, weighted mean over voxels and features.

    Raises:
        InputError: shapes, radius, dilation.

    Notes:
        Differentiable. In the inner loop of a registration the features are warped, not computed from warped images:
        `MeanSquaredDifference` of `mind_ssc`.
    """
    images = checked(fixed, warped, mask)
    return ssd(*(mind_ssc(image, radius=radius, dilation=dilation) for image in images), mask=mask)
