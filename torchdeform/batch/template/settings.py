"""Settings of a template made from many images."""

from typing import Annotated

from pydantic import Field

from torchdeform.batch.strict import Place, Strict
from torchdeform.registration.template import AveragingSettings, Pose


class TemplateSettings(Strict):
    """How a template is made."""

    rounds: Annotated[int, Field(ge=1)] = 3
    """How often all images are registered, each time to the template of the round before."""
    reference: Place | None = None
    """Image that the first round registers to, and whose grid the template gets; the first of images if not given."""
    pose: Pose = AveragingSettings.pose
    """Where the template lies: reference, as that image does, or mean, in the mean position and orientation."""
    match_intensities: bool = AveragingSettings.match_intensities
    """Bring all images to one mean and one standard deviation before they are averaged."""
    corrections: Annotated[int, Field(ge=1)] = AveragingSettings.corrections
    """How often at most the mean of the maps from the template is brought back to the identity in a round."""
    tolerance: Annotated[float, Field(ge=0)] = AveragingSettings.tolerance
    """Largest move of that mean, in voxels, that counts as none."""

    @property
    def averaging(self) -> AveragingSettings:
        """What the averages of a round need."""
        return AveragingSettings(
            pose=self.pose,
            match_intensities=self.match_intensities,
            corrections=self.corrections,
            tolerance=self.tolerance,
        )
