"""A hundred and more files that something is wrong with: one sentence, an exit code, nothing left behind."""

import gzip
import os
import struct

import pytest
import torch
from broken_files import CONTENT, META, NAMES, NIFTI, NRRD, SHAPE, WHOLE, refused, save, volume

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.pipeline.preflight import preflight


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.7, 0.97])
@pytest.mark.parametrize("name", WHOLE)
def test_a_file_that_breaks_off(folder, capfd, name, share):
    path = folder / name
    WHOLE[name](path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    partner = "sound.nii.gz" if name.partition(".")[2] not in ("png", "jpg", "bmp", "dcm") else "sound.png"
    assert name in refused(folder, capfd, partner, name)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("wrong", NIFTI)
def test_a_nifti_header_without_sense(folder, capfd, wrong, packed):
    name = "bad.nii.gz" if packed else "bad.nii"
    save(volume(), folder / "bad.nii")
    content = bytearray((folder / "bad.nii").read_bytes())
    struct.pack_into("<2h", content, 252, 0, 1)  # the matrix is what counts
    position, form, values = NIFTI[wrong]
    if wrong == "singular direction":
        struct.pack_into("<12f", content, 280, *[0.0] * 12)
    struct.pack_into(form, content, position, *values)
    (folder / "bad.nii").unlink()
    (folder / name).write_bytes(gzip.compress(bytes(content)) if packed else bytes(content))
    assert name in refused(folder, capfd, "sound.nii.gz", name)


@pytest.mark.parametrize("name", CONTENT)
def test_contents_that_cannot_be_registered(folder, capfd, name):
    CONTENT[name](folder / name)
    assert name in refused(folder, capfd, "sound.nii.gz", name)


@pytest.mark.parametrize("name", NAMES)
def test_names_that_do_not_fit_what_is_there(folder, capfd, name):
    if name == "pipe.nii" and not hasattr(os, "mkfifo"):
        pytest.skip("no pipes here")
    NAMES[name](folder / name)
    assert name in refused(folder, capfd, "sound.nii.gz", name)
    assert name in refused(folder, capfd, name, "sound.nii.gz")


def _mask(values: torch.Tensor, **how) -> Image:
    return Image(values.float().expand(1, 1, *SHAPE), Grid(SHAPE), name="mask.nii.gz", **how)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (lambda: _mask(torch.zeros(SHAPE)), "mask.nii.gz is empty"),
        (lambda: _mask(torch.full(SHAPE, torch.nan)), "mask.nii.gz has pixels that are NaN"),
        (lambda: _mask(torch.ones(SHAPE), origin=(1e4, 0, 0)), "mask.nii.gz excludes all of"),
        (lambda: Image(torch.ones(1, 1, 30, 40), Grid((30, 40)), name="mask.nii.gz"), "mask.nii.gz is 2D"),
        (lambda: Image(torch.ones(1, 3, *SHAPE), Grid(SHAPE), name="mask.nii.gz"), "3 channels"),
    ],
)
def test_masks_that_cannot_be_used(folder, mask, message):
    image = read_image("sound.nii.gz")
    with pytest.raises(InputError, match=message):
        preflight(image, image, fixed_mask=mask()).require_ok()


def test_there_are_a_hundred():
    count = 5 * len(WHOLE) + len(META) + len(NRRD) + 2 * len(NIFTI) + len(CONTENT) + len(NAMES)
    assert count >= 100
