"""What tests of cohorts share: folders of empty files, and cohort files."""

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from torchdeform.cohort.schema import Cohort, read_cohort


@pytest.fixture
def touch(tmp_path) -> Callable[..., Path]:
    """Return ``touch(names)``: makes empty files below the test's folder, and returns the folder."""

    def make(names: Iterable[str]) -> Path:
        for name in names:
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
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
