"""Images and transforms of SimpleITK for tests of their files."""

import numpy as np
import SimpleITK as sitk

SPACING, ORIGIN = (1.2, 1.0, 2.0), (-30.0, -20.0, -24.0)
TURN = np.linalg.qr(np.arange(9.0).reshape(3, 3) + 3 * np.eye(3))[0] @ np.diag([1.0, 1.0, -1.0])


def written_image(path):
    """Write an oblique, mirrored volume, and return it."""
    values = np.zeros((18, 30, 34), np.float32)
    z, y, x = np.indices(values.shape)
    values[:] = 100 + 50 * np.sin(x / 4) * np.cos(y / 5) + 20 * np.cos(z / 3)
    image = sitk.GetImageFromArray(values)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(TURN.ravel().tolist())
    sitk.WriteImage(image, str(path))
    return image


def spline_of(image, mesh=(4, 4, 3), size=1.5):
    """Return a random B-spline over an image, its coefficients of a deviation in mm."""
    spline = sitk.BSplineTransformInitializer(image, mesh, 3)
    spline.SetParameters(np.random.default_rng(0).normal(0, size, len(spline.GetParameters())).tolist())
    return spline
