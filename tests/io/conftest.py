"""A folder with sound images, for the tests of files."""

import pytest
import torch
from broken_files import SHAPE, volume

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.io import write_image


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a sound volume and a sound picture; nothing else may be in it after a failure."""
    monkeypatch.chdir(tmp_path)
    write_image(Image(torch.from_numpy(volume())[None, None], Grid(SHAPE)), "sound.nii.gz")
    values = torch.from_numpy(volume("float32", (30, 40)))[None, None]
    write_image(Image(values, Grid((30, 40)), pixel_type="uint8"), "sound.png")
    return tmp_path
