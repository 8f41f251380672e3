"""Headers of MetaImage and NRRD that make no sense are refused in one sentence."""

import pytest
import torch
from broken_files import META, NRRD, meta_image, nrrd_image, refused, volume

from torchdeform.io import read_image


@pytest.mark.parametrize("wrong", META)
def test_a_metaimage_header_without_sense(folder, capfd, wrong):
    (folder / "bad.mha").write_bytes(meta_image(**META[wrong]))
    assert "bad.mha" in refused(folder, capfd, "bad.mha", "sound.nii.gz")


@pytest.mark.parametrize("wrong", NRRD)
def test_an_nrrd_header_without_sense(folder, capfd, wrong):
    (folder / "bad.nrrd").write_bytes(nrrd_image(**NRRD[wrong]))
    assert "bad.nrrd" in refused(folder, capfd, "sound.nii.gz", "bad.nrrd")


def test_the_headers_are_sound_but_for_what_is_changed(folder):
    (folder / "a.mha").write_bytes(meta_image())
    (folder / "a.nrrd").write_bytes(nrrd_image())
    for name in ("a.mha", "a.nrrd"):
        assert torch.equal(read_image(name).data[0, 0], torch.from_numpy(volume()))
