"""Files in and out: images, labels, points, displacement fields and transforms, in ITK's conventions."""

from torchdeform.io.images import read_image, read_labels, write_image, write_labels
from torchdeform.io.points import Points, matched, read_points, write_points
from torchdeform.io.transforms import read_displacement, read_transform, write_displacement, write_transform

__all__ = [
    "Points",
    "matched",
    "read_displacement",
    "read_image",
    "read_labels",
    "read_points",
    "read_transform",
    "write_displacement",
    "write_image",
    "write_labels",
    "write_points",
    "write_transform",
]
