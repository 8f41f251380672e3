"""Label images: their values stay, whatever program saved them."""

import torch

from torchdeform.io import read_image, read_labels, write_image
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
