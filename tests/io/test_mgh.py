"""FreeSurfer's volumes, compared with nibabel."""

import gzip

import numpy as np
import pytest
import torch

from torchdeform.errors import InputError
from torchdeform.io import read_image, read_labels
from torchdeform.io.images import image_size

nibabel = pytest.importorskip("nibabel")

VALUES = (np.random.default_rng(0).random((5, 6, 7)) * 100).astype(np.float32)
TILTED = nibabel.affines.from_matvec(
    nibabel.eulerangles.euler2mat(0.3, -0.2, 0.5) @ np.diag([1.0, 1.2, 2.0]), [3.0, -4.0, 5.0]
)


@pytest.mark.parametrize("name", ["a.mgz", "a.mgh"])
@pytest.mark.parametrize("given", ["a.mgz", "no_ending", "a.nii.gz", "a.png"])
@pytest.mark.parametrize("kind", ["u1", "i2", "i4", "f4"])
def test_values_and_place(tmp_path, name, given, kind):
    theirs = nibabel.MGHImage(VALUES.astype(kind), TILTED)
    theirs.to_filename(tmp_path / name)
    (tmp_path / name).rename(tmp_path / given)
    image = read_image(tmp_path / given)
    np.testing.assert_array_equal(image.data[0, 0].numpy().T, VALUES.astype(kind))
    assert (image.pixel_type, image.unit) == (np.dtype(kind).name, "mm")
    world = image.to_world(image.grid.points(dtype=torch.float64))[0, :, 6, 5, 4].numpy()
    np.testing.assert_allclose(world, (theirs.header.get_affine() @ (4, 5, 6, 1))[:3] * (-1, -1, 1), atol=1e-5)
    assert image_size(tmp_path / given) == ((7, 6, 5), 1)


def test_labels_keep_every_value(tmp_path):
    nibabel.MGHImage(np.full((5, 6, 7), 2**24 + 1, np.int32), TILTED).to_filename(tmp_path / "a.mgz")
    assert read_labels(tmp_path / "a.mgz").data.unique().tolist() == [2**24 + 1]


def test_several_frames_are_a_series(tmp_path):
    nibabel.MGHImage(np.zeros((5, 6, 7, 2), np.float32), TILTED).to_filename(tmp_path / "a.mgz")
    with pytest.raises(InputError, match="is a series of 2 volumes"):
        read_image(tmp_path / "a.mgz")


@pytest.mark.parametrize("share", [0.3, 0.7, 0.98])
@pytest.mark.parametrize("name", ["a.mgz", "a.mgh"])
def test_files_that_break_off(tmp_path, name, share):
    nibabel.MGHImage(VALUES, TILTED).to_filename(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(len(content) * (share if name == "a.mgz" else share - 0.1))])
    with pytest.raises(InputError, match=f"{name} is damaged"):
        read_image(tmp_path / name)


def test_nan_and_what_cannot_be_there(tmp_path):
    nibabel.MGHImage(np.full((5, 6, 7), np.nan, np.float32), TILTED).to_filename(tmp_path / "a.mgh")
    with pytest.raises(InputError, match="NaN or infinite"):
        read_image(tmp_path / "a.mgh")
    content = bytearray((tmp_path / "a.mgh").read_bytes())
    content[4:16] = b"\0\1\0\0" * 3
    for name, stored in (("b.mgh", bytes(content)), ("b.mgz", gzip.compress(bytes(content)))):
        (tmp_path / name).write_bytes(stored)
        with pytest.raises(InputError, match=rf"{name} announces .*far more than it can hold"):
            read_image(tmp_path / name)


def test_a_packed_file_whose_checksum_does_not_fit_is_refused(tmp_path):
    values = np.random.default_rng(0).random((9, 8, 7)).astype(np.float32)
    content = bytearray(gzip.compress(nibabel.MGHImage(values, np.eye(4)).to_bytes(), 0))
    content[len(content) // 2] ^= 255
    (tmp_path / "a.mgz").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mgz is damaged or incomplete"):
        read_image(tmp_path / "a.mgz")
