"""The outcome's files: every pair once, every text escaped, every link to something."""

import csv
from html.parser import HTMLParser
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


class Page(HTMLParser):
    """What a browser sees: tags, links and texts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src") and value]

    def handle_data(self, data: str) -> None:
        self.texts.append(data.strip())


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


def test_failures_tell_why_and_where_to_look(tmp_path, outcome):
    rows = {row["name"]: row for row in table(tmp_path / "failures.csv")}
    assert rows["bad"] == {"name": "bad", "sentence": NASTY, "log": str(Path("logs") / "bad.log")}
    assert rows["never"]["log"] == ""
    assert {failure.name for failure in outcome.failures} == {"bad", "never"}


def test_every_text_is_escaped(tmp_path, outcome):
    page = Page((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert page.tags.count("script") == 1  # the page's own
    assert any(NASTY in text for text in page.texts)


def test_links_lead_to_files(tmp_path, outcome):
    links = Page((tmp_path / "index.html").read_text(encoding="utf-8")).links
    assert sorted(links) == ["logs/bad.log", "sub%201/good/report.html"]


def test_a_pair_without_a_report_shows_its_overview(tmp_path, outcome):
    job = make_job(tmp_path, "good")
    (job.files.out / "report.html").unlink()
    summarise([job], tmp_path, {"good": PairReport(DONE, files=("overview.png",))})
    assert Page((tmp_path / "index.html").read_text(encoding="utf-8")).links == ["sub%201/good/overview.png"]


def test_columns_without_any_figure_are_not_shown(tmp_path, outcome):
    texts = Page((tmp_path / "index.html").read_text(encoding="utf-8")).texts
    assert "dice after" in texts
    assert "gpu memory mb" not in texts


def test_the_page_asks_nothing_of_the_network(tmp_path, outcome):
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "http:" not in text
    assert "https:" not in text


def test_an_empty_cohort_has_tables_too(tmp_path):
    assert summarise([], tmp_path, {}).done == 0
    assert table(tmp_path / "summary.csv") == []
    assert (tmp_path / "index.html").is_file()
