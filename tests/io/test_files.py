"""Places that cannot be written are named before any work."""

import pytest
from broken_files import files_in, save, volume

from torchdeform.cli.main import main


@pytest.mark.parametrize("out", ["sound.nii.gz", "sound.nii.gz/deeper", "/proc/nothing/here", "/dev/null"])
def test_places_that_cannot_be_written(folder, capfd, out):
    save(volume(), folder / "moving.mha")
    before = files_in(folder)
    assert main(["sound.nii.gz", "moving.mha", "--out", out]) == 2
    assert "cannot write to" in capfd.readouterr().err
    assert files_in(folder) == before
