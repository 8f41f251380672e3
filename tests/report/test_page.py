"""``report.html``: complete in itself, small, and safe whatever the files are called."""

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from torchdeform.report import make_report_data, write_report
from torchdeform.report.record import write_json

FRAMES = {2: 4, 3: 10}


VOID = {"meta", "link", "br", "img", "input", "hr", "path", "use", "rect"}


class _Page(HTMLParser):
    """The elements of a page, and whether they close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert tag in VOID or self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def _page(tmp_path, report_data, record) -> tuple[str, _Page]:
    write_report(tmp_path / "report.html", report_data, record)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    return text, _Page(text)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_page_is_complete_in_itself(tmp_path, make_full, dim):
    text, page = _page(tmp_path, *make_full(dim))
    assert page.open == []
    for tag, given in page.tags:
        for name in ("src", "href", "action", "srcset"):
            assert (given.get(name) or "#").startswith(("data:image/jpeg;base64,", "#")), tag
    assert not re.search(r"@import|url\(\s*['\"]?(?!#)", text)
    pictures = [given for tag, given in page.tags if tag == "img" and "src" in given]
    names = {given["data-name"] for given in pictures}
    known = {"fixed", "warped", "moving", "original", "before", "after", "log_det", "divergence", "rotation"}
    assert names == known | {"inverse_error"}
    assert len(pictures) == len(names) * {2: 1, 3: 3}[dim]
    assert all(given["alt"] for given in pictures)
    ids = [given["id"] for _, given in page.tags if "id" in given]
    assert len(ids) == len(set(ids))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_page_says_everything(tmp_path, make_full, dim):
    _, page = _page(tmp_path, *make_full(dim))
    for words in (
        f"one of the {FRAMES[dim]} one-sided determinants",
        "0.1 → 0.9",
        "lncc + mi",
        "0.4 → 0.8",
        "9 → 1.5 mm",
        "Warning: this is odd",
        "2.00 GB",
        "register ",
        "torchdeform apply 'my results/transform.h5'",
        "--set 'optimiser.steps=[5, 4]'",
        "torch 2.",
        "0.4 before → 0.5 aligned → 0.8 after",
        "moving, as it was",
    ):
        assert words in page.text, words


@pytest.mark.parametrize("dim", [2, 3])
def test_names_cannot_do_anything(tmp_path, make_full, dim):
    """Whatever is in a name or a message is text: no element, no script comes of it."""
    text, page = _page(tmp_path, *make_full(dim))
    assert "<script>alert" not in text
    assert "<script>alert('x')</script> & \"more\"" in page.text
    assert [given.get("type") for tag, given in page.tags if tag == "script"] == ["application/json", None]
    policy = next(given["content"] for _, given in page.tags if given.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert "default-src 'none'" in policy
    assert "'unsafe-inline'" not in policy.partition("script-src")[2].partition(";")[0]


def test_few_facts_make_a_page(tmp_path, make_image, make_result):
    """A result of two tensors' images, without alignment, levels, labels or commands, in one slice."""
    fixed = make_image((16, 18, 20))
    report_data = make_report_data(fixed, fixed, replace(make_result(fixed, fixed), levels=()), slices=1)
    _, page = _page(tmp_path, report_data, None)
    assert page.open == []
    assert "Commands" not in page.text
    assert "Landmarks" not in page.text


@pytest.mark.parametrize("dim", [2, 3])
def test_a_record_from_a_file_makes_the_same_page(tmp_path, make_full, dim):
    report_data, record = make_full(dim)
    first, _ = _page(tmp_path, report_data, record)
    write_json(record, tmp_path / "result.json")
    again, _ = _page(tmp_path, report_data, json.loads((tmp_path / "result.json").read_text(encoding="utf-8")))
    assert first == again


def test_figures_that_are_missing_are_dashes(tmp_path, make_full):
    """A record from JSON has null where a figure was not finite."""
    report_data, record = make_full(2)
    for key in ("similarity_after", "determinant_max", "inverse_error_mean", "inverse_error_max"):
        record[key] = None
    record["evaluation"]["after"]["dice"]["2"] = math.nan
    record["evaluation"]["after"]["hausdorff_95"]["2"] = None
    _, page = _page(tmp_path, report_data, record)
    assert "0.1 → –" in page.text


def test_long_tables_are_folded(tmp_path, make_full):
    _, page = _page(tmp_path, *make_full(2, labels=30, landmarks=40))
    assert "All 30 labels" in page.text
    assert "All 40 landmarks" in page.text
