"""The two examples of the paper run as they are shipped, and are as accurate as they claim."""

import subprocess
import sys

import pytest
from PIL import Image


# The second error: below the 5.225e-3 of the paper by a wide margin.
@pytest.mark.parametrize(("name", "most"), [("paper_example_1", 1e-3), ("paper_example_2", 1.6e-3)])
def test_an_example_writes_its_picture_and_prints_its_error(name, most, root, tmp_path):
    picture = tmp_path / f"{name}.png"
    command = [sys.executable, root / "examples" / f"{name}.py", picture]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 0 < float(done.stdout) < most
    with Image.open(picture) as image:
        assert min(image.size) > 300
        grey = image.convert("L").getextrema()
    assert grey[0] < 150  # ink
    assert grey[1] == 255  # on paper
    assert list(tmp_path.iterdir()) == [picture]
