"""Files in and out: images, displacement fields and transforms, in ITK's conventions."""

from torchdeform.io.images import read_image, write_image
from torchdeform.io.transforms import read_displacement, write_displacement, write_transform

__all__ = ["read_displacement", "read_image", "write_displacement", "write_image", "write_transform"]
