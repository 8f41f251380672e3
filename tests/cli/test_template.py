"""The verb that builds a template: a broken image is left out and named."""

import json
import re

from cohort_files import cohort, write_images

from torchdeform.cli.main import torchdeform


def test_a_broken_image_is_left_out_and_the_shell_says_so(tmp_path, capsys):
    write_images(tmp_path / "images", 4)
    broken = tmp_path / "images" / "sub-2.nii.gz"
    broken.write_bytes(broken.read_bytes()[:60])
    cohort(tmp_path, rounds=1, more="match_intensities: false")
    assert torchdeform(["template", str(tmp_path / "template.yaml")]) == 1
    out, err = capsys.readouterr()
    assert "3, 1 left out" in out
    assert "without sub-2" in err
    assert re.search(r"round 1 of 1.*sub-2 failed: .*sub-2\.nii\.gz", err)
    record = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert record["left_out"].keys() == {"sub-2"}
    assert record["images"].keys() == {"sub-0", "sub-1", "sub-3"}
