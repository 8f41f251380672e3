"""Paint label maps as images: what is known of a place stays, the contrast is chosen or drawn."""

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

# Grey values of tissues, T1-weighted and T2-weighted, and the labels that show them: those of FreeSurfer up to 164
# (left and right alike), from 500 on those of a head around the brain.
TISSUES = {
    (0.00, 0.00): (0, 30, 62, 502, 514),  # air, vessels
    (0.05, 0.05): (515,),  # cortical bone
    (0.12, 0.95): (4, 5, 14, 15, 24, 43, 44, 72),  # fluid
    (0.15, 0.90): (506,),  # eyes
    (0.35, 0.60): (509,),  # mucosa
    (0.40, 0.30): (507, 508),  # muscle and what is not told apart
    (0.45, 0.75): (25, 57),  # lesions of white matter
    (0.50, 0.55): (3, 42),  # cortex
    (0.52, 0.50): (8, 47),  # cortex of the cerebellum
    (0.53, 0.57): (17, 18, 53, 54),  # hippocampus, amygdala
    (0.57, 0.47): (11, 26, 50, 58),  # caudate, accumbens
    (0.61, 0.42): (12, 51, 136, 137, 163, 164),  # putamen
    (0.66, 0.43): (10, 49),  # thalamus
    (0.72, 0.30): (13, 28, 52, 60),  # pallidum, ventral diencephalon
    (0.75, 0.38): (16, 85, 512, 530),  # brainstem, optic nerves, spinal cord
    (0.80, 0.36): (7, 46),  # white matter of the cerebellum
    (0.82, 0.34): (2, 41),  # white matter
    (0.70, 0.45): (511, 516),  # skin, marrow
}
CONTRASTS = ("t1", "t2")


def paint(labels: Tensor, contrast: str | int, seed: int = 0, *, noise: float = 0.02, blur: float = 0.6) -> Tensor:
    """Return an image of a label map: a grey value for each label, texture, blur, a smooth gain and noise.

    Args:
        labels: whole numbers, not negative ``(1, 1, *S)``.
        contrast: ``t1`` or ``t2`` with the grey values of `TISSUES` (drawn for other labels, the same each time), or a
            number from which all grey values are drawn.
        seed: of texture, gain and noise.
        noise: standard deviation of the noise, and twice that of the texture that is blurred.
        blur: standard deviation of the Gaussian in voxels.

    Returns:
        ``(1, 1, *S)`` between 0 and 1.
    """
    drawn = np.random.default_rng(seed)
    clean = _greys(int(labels.max()) + 1, contrast)[labels.long().cpu().numpy()[0, 0]]
    seen = gaussian_filter(clean + 2 * noise * drawn.standard_normal(clean.shape), blur)
    image = torch.from_numpy(seen).float()[None, None]
    coarse = torch.from_numpy(drawn.standard_normal((1, 1, *[4] * seen.ndim))).float()
    gain = F.interpolate(coarse, seen.shape, mode="trilinear" if seen.ndim == 3 else "bilinear", align_corners=True)
    image = image * torch.exp(0.15 * gain) + noise * torch.from_numpy(drawn.standard_normal(seen.shape)).float()
    return image.clamp(0, 1).to(labels.device)


def _greys(count: int, contrast: str | int) -> np.ndarray:
    """Return the grey value of each label from 0 to ``count`` − 1."""
    greys = np.random.default_rng(0 if isinstance(contrast, str) else contrast).random(count)
    if isinstance(contrast, str):
        for tissue, labels in TISSUES.items():
            greys[[label for label in labels if label < count]] = tissue[CONTRASTS.index(contrast)]
    return greys
