"""Label images on disk: every value as it is, in the type it is stored with."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from torchdeform.errors import InputError
from torchdeform.image import Image
from torchdeform.io import itk
from torchdeform.io.files import staged, suffix
from torchdeform.io.images import FORMATS, read_image, write_image

# Types with values that float32, in which images are read, does not tell apart.
_WIDE = ("int32", "uint32", "int64", "uint64", "float64")
_VOLUMES = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr")


def read_labels(path: str | os.PathLike[str]) -> Image:
    """Read a label image: like `read_image`, but volumes in float64 where float32 would merge labels above 2²⁴.

    Raises:
        InputError: as `read_image`.
    """
    image = read_image(path)
    if image.pixel_type not in _WIDE or suffix(Path(path)) not in _VOLUMES:
        return image
    import SimpleITK as sitk

    values = torch.from_numpy(sitk.GetArrayFromImage(itk.load(Path(path))).astype(np.float64))
    return replace(image, data=values.view(1, *image.grid.shape, -1).movedim(-1, 1).contiguous())


def write_labels(image: Image, path: str | os.PathLike[str]) -> None:
    """Write a label image in its own ``pixel_type``, volumes too; whole or not at all.

    Raises:
        InputError: a format that cannot hold that type, or a place that cannot be written.
    """
    file, ending = Path(path), suffix(Path(path))
    if ending not in _VOLUMES:
        if ending in FORMATS and image.pixel_type not in FORMATS[ending].types:
            raise InputError(f"{path}: {ending} files cannot hold labels of type {image.pixel_type}; use .nii.gz")
        return write_image(image, file)
    values = image.data[0].detach().cpu().numpy().astype(image.pixel_type)
    with staged(file.parent) as folder:
        itk.save(itk.from_values(values, image), folder / file.name)
    return None
