"""What tests of cohorts share: folders of empty files, and cohort files."""

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from nested_settings import settings_of

from torchdeform.cohort.plan import Job
from torchdeform.cohort.schema import Cohort, read_cohort
from torchdeform.io import write_image
from torchdeform.pipeline.register import PairFiles


@pytest.fixture
def touch(tmp_path) -> Callable[..., Path]:
    """Return ``touch(names)``: makes small files below the test's folder, and returns the folder."""

    def make(names: Iterable[str]) -> Path:
        for name in names:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("x", encoding="ascii")
        return tmp_path

    return make


@pytest.fixture
def cohort_of(tmp_path) -> Callable[[str], Cohort]:
    """Return ``cohort_of(text)``: the cohort that a file with this text describes; ``out: results`` comes first."""

    def read(text: str) -> Cohort:
        path = tmp_path / "cohort.yaml"
        path.write_text(f"out: results\n{text}", encoding="utf-8")
        return read_cohort(path)

    return read


FAST = settings_of(align="none", similarity="ssd", steps=(2,), length_scale=8.0)


@pytest.fixture
def jobs(tmp_path, make_image) -> list[Job]:
    """Four pairs of small images."""
    paths = [tmp_path / "fixed.png", tmp_path / "moving.png"]
    for path, shift in zip(paths, (0.0, 3.0), strict=True):
        write_image(make_image((16, 16), origin=(shift, 0.0), pixel_type="uint8"), path)
    return [
        Job(
            name=name,
            files=PairFiles(fixed=paths[0], moving=paths[1], out=tmp_path / "out" / name),
            settings=FAST,
            device="cpu",
        )
        for name in "abcd"
    ]
