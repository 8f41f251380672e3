"""Deformations of files: settings of a grid, monitors from images, and labels that are none."""

from dataclasses import replace

import pytest
import torch

from torchdeform.errors import InputError
from torchdeform.io import write_image
from torchdeform.pipeline.deformation import GridSettings, reconstruct_file, simulate_file


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"monitor": "gradent"}, "did you mean 'gradient'"),
        ({"velocity": "poison"}, "did you mean 'poisson'"),
        ({"f_min": 0.0}, "f_min"),
        ({"smoothing": -1.0}, "smoothing"),
    ],
)
def test_settings_that_will_not_do_are_named(change, message):
    with pytest.raises(InputError, match=message):
        GridSettings(**change)


@pytest.mark.parametrize("monitor", ["gradient", "curvature", "density"])
def test_monitors_are_positive_with_the_ratio_asked_for(make_image, monitor):
    f = GridSettings(monitor=monitor, f_min=0.25, f_max=1.0).build(make_image((20, 24), channels=3))
    assert (f.dtype, tuple(f.shape)) == (torch.float64, (1, 1, 20, 24))
    assert f.min() > 0
    assert f.max() / f.min() <= 4 + 1e-9


def test_an_image_may_hold_the_monitor_itself(make_image):
    image = make_image((20, 24))
    flat = replace(image, data=torch.full_like(image.data, 3.0))
    torch.testing.assert_close(GridSettings(monitor="value").build(flat), flat.data.double())
    sharp = GridSettings(monitor="value", smoothing=0.0).build(image)
    torch.testing.assert_close(sharp, image.data.double())


def test_labels_that_are_none_leave_nothing(make_image, tmp_path):
    write_image(make_image((12, 14)), tmp_path / "a.nii.gz")
    with pytest.raises(InputError, match=r"a\.nii\.gz is no label image"):
        simulate_file(tmp_path / "a.nii.gz", tmp_path / "a.nii.gz", {1: 0.5}, tmp_path / "out", None, None)
    with pytest.raises(InputError, match=r"a\.nii\.gz"):
        reconstruct_file(tmp_path / "a.nii.gz", tmp_path / "out", 2, True, None, torch.device("cpu"))
    assert not (tmp_path / "out").exists()
