"""Label images on disk: every value unchanged, in the type of the file."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import itk
from torchdeform.io.files import suffix
from torchdeform.io.images import FORMATS, read_image, write_image

# Types whose values float32, in which images are read, cannot all represent.
_WIDE = ("int32", "uint32", "int64", "uint64", "float64")
_VOLUMES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")


def read_labels(path: str | os.PathLike[str]) -> Image:
    """Read a label image: like `read_image`, but volumes in float64 if float32 would merge labels above 2²⁴.

    Args:
        path: the file, any format that `read_image` reads.

    Returns:
        The image. A picture with three equal channels, as drawing programs save grey values, becomes one channel.

    Raises:
        InputError: as `read_image`.
    """
    image = read_image(path)
    if image.data.shape[1] == 3 and bool((image.data == image.data[:, :1]).all()):
        image = replace(image, data=image.data[:, :1].contiguous())
    if image.pixel_type not in _WIDE or suffix(Path(path)) not in _VOLUMES:
        return image
    import SimpleITK as sitk

    values = torch.from_numpy(sitk.GetArrayFromImage(itk.load(Path(path))).astype(np.float64))
    return replace(image, data=values.view(1, *image.grid.shape, -1).movedim(-1, 1).contiguous())


def write_labels(image: Image, path: str | os.PathLike[str]) -> None:
    """Write a label image in its own ``pixel_type``, volumes too; complete or not at all.

    Args:
        image: whole numbers, with their position in the world.
        path: the file, any format that `write_image` writes.

    Raises:
        InputError: a format that cannot hold that type, or a folder that cannot be written.
    """
    ending = suffix(Path(path))
    if ending in _VOLUMES:
        values = image.data[0].detach().cpu().numpy().astype(image.pixel_type)
        itk.save(itk.from_values(values, image), Path(path))
    elif ending in FORMATS and image.pixel_type not in FORMATS[ending].types:
        raise InputError(f"{path}: {ending} files cannot hold labels of type {image.pixel_type}; use .nii.gz")
    else:
        write_image(image, path)
