"""The outcome's tables: every pair once, with its figures, and why those failed that failed."""

import csv
from pathlib import Path

import pytest

from torchdeform.cohort.plan import Failure, Job
from torchdeform.cohort.summary import COLUMNS, log_of, summarise
from torchdeform.cohort.task import DONE, FAILED, PairReport
from torchdeform.pipeline.register import PairFiles
from torchdeform.registration.settings import RegistrationSettings

NASTY = """<script>alert("1")</script> & "quotes" 'too'"""


def make_job(out: Path, name: str) -> Job:
    files = PairFiles(fixed=Path("f.png"), moving=Path("m.png"), out=out / "sub 1" / name)
    return Job(name=name, files=files, settings=RegistrationSettings())


@pytest.fixture
def outcome(tmp_path):
    """A pair that is done, one that failed, one that waits and one that cannot run."""
    jobs = [make_job(tmp_path, name) for name in ("good", "bad", "later")]
    for name in ("overview.png", "report.html"):
        jobs[0].files.out.mkdir(parents=True, exist_ok=True)
        (jobs[0].files.out / name).touch()
    log_of(tmp_path, "bad").parent.mkdir()
    log_of(tmp_path, "bad").touch()
    known = {
        "good": PairReport(DONE, "", 2.25, 300_000_000, 0, {"folds": 0, "dice_after": 0.912345678}, ("overview.png",)),
        "bad": PairReport(FAILED, NASTY, 0.5),
    }
    return summarise(jobs, tmp_path, known, [Failure("never", f"no file {NASTY}")])


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_every_pair_has_one_row(tmp_path, outcome):
    rows = table(tmp_path / "summary.csv")
    assert tuple(rows[0]) == COLUMNS
    assert {row["name"]: row["status"] for row in rows} == {
        "good": "done",
        "bad": "failed",
        "later": "waiting",
        "never": "failed",
    }
    assert len(rows) == 4
    good = rows[0]
    assert (good["folds"], good["dice_after"], good["seconds"]) == ("0", "0.912345678", "2.25")
    assert (good["peak_memory_mb"], good["gpu_memory_mb"], good["dice_before"]) == ("300", "", "")
    assert good["folder"] == str(Path("sub 1") / "good")
    assert rows[1]["folder"] == ""


def test_counts(outcome):
    assert (outcome.done, outcome.failed, outcome.waiting) == (1, 2, 1)
    assert outcome.badges == {"done": 1, "failed": 2, "waiting": 1}
    assert outcome.means == {"Dice": "0.912", "folds": "0", "time": "2.25 s", "memory": "300 MB"}


def test_failures_tell_why_and_where_to_look(tmp_path, outcome):
    rows = {row["name"]: row for row in table(tmp_path / "failures.csv")}
    assert rows["bad"] == {"name": "bad", "sentence": NASTY, "log": str(Path("logs") / "bad.log")}
    assert rows["never"]["log"] == ""
    assert {failure.name for failure in outcome.failures} == {"bad", "never"}


def test_an_empty_cohort_has_tables_too(tmp_path):
    assert summarise([], tmp_path, {}).done == 0
    assert table(tmp_path / "summary.csv") == []
    assert (tmp_path / "index.html").is_file()
