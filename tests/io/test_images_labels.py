"""Label images: their values stay, whatever program saved them."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from broken_files import SHAPE, Make, bytes_of, itk_image, refused, save

from torchdeform.io import read_image, write_image
from torchdeform.io.images import read_labels
from torchdeform.metrics.evaluation import dice


def test_a_grey_picture_saved_in_colour_is_one_label_image(tmp_path, make_image):
    """Drawing programs save masks as three equal channels."""
    place = make_image((12, 14), channels=3, pixel_type="uint8")
    labels = torch.zeros(1, 1, 12, 14)
    labels[..., 3:9, 4:10] = 255
    write_image(type(place)(labels.expand(1, 3, 12, 14), place.grid, pixel_type="uint8"), tmp_path / "mask.png")
    assert read_image(tmp_path / "mask.png").data.shape[1] == 3
    found = read_labels(tmp_path / "mask.png").data
    assert torch.equal(found, labels)
    assert dice(found, labels, labels=[255]).item() == 1


def test_colours_stay_colours(tmp_path, make_image):
    write_image(make_image((12, 14), channels=3, pixel_type="uint8"), tmp_path / "picture.png")
    assert read_labels(tmp_path / "picture.png").data.shape[1] == 3


@pytest.mark.parametrize("channels", [3, 4])
def test_a_grey_picture_in_colour_has_one_label_a_pixel(tmp_path, channels):
    values = np.zeros((20, 24, channels), np.uint8)
    values[5:9, 6:14, :3] = 255
    values[..., 3:] = 255
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=True), str(tmp_path / "labels.png"))
    found = read_labels(tmp_path / "labels.png")
    assert torch.equal(found.data[0, 0], torch.from_numpy(values[..., 0]).float())
    values[6, 7, 0] = 200
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=True), str(tmp_path / "colours.png"))
    assert read_labels(tmp_path / "colours.png").data.shape[1] == channels


def _labels(offset: int = 0, kind: str = "uint8") -> np.ndarray:
    """Two slabs, labelled 1 and 2 and what is added to them."""
    values = np.zeros(SHAPE, kind)
    values[2:4], values[5:7] = 1 + offset, 2 + offset
    return values


def _moved_away(path: Path) -> None:
    image = itk_image(_labels())
    image.SetOrigin((1e4, 0.0, 0.0))
    sitk.WriteImage(image, str(path))


LABELS: dict[str, tuple[Make, str]] = {
    "none in common": (lambda p: save(_labels(7), p), "no label in common"),
    "nothing": (lambda p: save(np.zeros(SHAPE, np.uint8), p), "no label in common"),
    "fractions": (lambda p: save(_labels(kind="float32") * np.float32(0.5), p), "must hold whole numbers"),
    "NaN": (lambda p: save(np.full(SHAPE, np.nan, np.float32), p), "NaN or infinite"),
    "infinite": (lambda p: save(np.full(SHAPE, np.inf, np.float32), p), "NaN or infinite"),
    "a picture": (lambda p: save(_labels()[3], p), "must be 3D"),
    "two channels": (lambda p: save(np.stack([_labels()] * 2, -1), p, vector=True), "one channel"),
    "cut off": (lambda p: p.write_bytes(bytes_of(".nii")[:300]), "bad.nii"),
    "absent": (lambda p: None, "does not exist"),
}


@pytest.mark.parametrize("side", ["fixed", "moving"])
@pytest.mark.parametrize("wrong", LABELS)
def test_labels_that_do_not_fit(folder, capfd, wrong, side):
    """Found out before the registration, by file name."""
    make, message = LABELS[wrong]
    make(folder / "bad.nii")
    save(_labels(), folder / "good.nii")
    names = {"fixed": "good.nii", "moving": "good.nii", side: "bad.nii"}
    options = [word for key, name in names.items() for word in (f"--{key}-labels", name)]
    said = refused(folder, capfd, "sound.nii.gz", "sound.nii.gz", *options)
    assert "bad.nii" in said
    assert message in said


def test_labels_of_one_image_only_or_of_another_place(folder, capfd):
    save(_labels(), folder / "good.nii")
    _moved_away(folder / "bad.nii")
    assert "--moving-labels" in refused(folder, capfd, "sound.nii.gz", "sound.nii.gz", "--fixed-labels", "good.nii")
    options = ["--fixed-labels", "bad.nii", "--moving-labels", "good.nii"]
    assert "bad.nii lies beside sound.nii.gz" in refused(folder, capfd, "sound.nii.gz", "sound.nii.gz", *options)


@pytest.mark.parametrize("ending", [".tif", ".nii.gz", ".mha", ".nrrd"])
@pytest.mark.parametrize("kind", ["int32", "uint32"])
def test_every_label_of_wide_integers_is_kept(tmp_path, ending, kind):
    values = np.zeros((20, 24), kind)
    values[5:9], values[9:12] = 2**24 + 1, 2**24 + 2
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / f"labels{ending}"))
    np.testing.assert_array_equal(read_labels(tmp_path / f"labels{ending}").data[0, 0], values)
