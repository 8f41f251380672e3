"""The page of a cohort: every pair once, the worst first, every text escaped, every link to something."""

import base64
import hashlib
from html.parser import HTMLParser
from pathlib import Path

import chromium
import pytest
from skimage.io import imsave
from skimage.util import img_as_ubyte

import torchdeform.cohort.page as pages
from torchdeform.cohort.page import BADGES, means, write_page
from torchdeform.cohort.summary import COLUMNS
from torchdeform.cohort.task import DONE, FAILED

NASTY = """<script>alert("1")</script> & "quotes" 'too'"""
PAIRS = {"sub-1": "good", "sub-2": "good", "sub-3": "look", "sub-4": "good", "sub-5": "good", "bad one": "bad"}


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


def row(name: str, **known: str | float) -> dict[str, str | float]:
    return dict.fromkeys(COLUMNS, "") | {"name": name} | known


def row_of(k: int, name: str, verdict: str) -> dict[str, str | float]:
    bad = verdict == "bad"
    return row(
        name,
        status=DONE,
        verdict=verdict,
        headline=f"{verdict}: {NASTY}",
        similarity_before=0.5 + 0.01 * k,
        similarity_after=0.1 if bad else 0.8 + 0.01 * k,
        landmark_error_after=9.0 if bad else 1.0 + 0.1 * k,
        unit="px",
        folds=0,
        determinant_min=0.5,
        determinant_max=1.5 + 0.1 * k,
        seconds=4.0,
        folder=f"sub 1/{name}",
    )


@pytest.fixture
def page(tmp_path):
    """A page of six pairs that are done, one that failed, one that waits and one that cannot run."""
    for name in PAIRS:
        folder = tmp_path / "sub 1" / name
        folder.mkdir(parents=True)
        (folder / "report.html").touch()
        imsave(folder / "thumb.jpg", img_as_ubyte([[0.1] * 90] * 60), check_contrast=False)
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "lost.log").touch()
    rows = [row_of(k, *pair) for k, pair in enumerate(PAIRS.items())]
    rows += [row("lost", status=FAILED, seconds=99.0), row("later", status="waiting"), row("never", status=FAILED)]
    failures = {
        "lost": {"name": "lost", "sentence": f"why: {NASTY}", "log": "logs/lost.log"},
        "never": {"name": "never", "sentence": "no file", "log": "logs/never.log"},
    }
    write_page(tmp_path / "index.html", rows, failures)
    return tmp_path / "index.html"


def read(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


def test_every_text_is_escaped(page):
    found = read(page)
    assert found.tags.count("script") == 1  # the page's own
    assert sum(NASTY in text for text in found.texts) == 3  # why one failed, and two headlines that are not good


def test_no_script_but_the_page_s_own_can_run(page):
    text = page.read_text(encoding="utf-8")
    script = text.partition("<script>")[2].partition("</script>")[0]
    known = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = text.partition('Content-Security-Policy" content="')[2].partition('"')[0]
    rules = dict(rule.strip().partition(" ")[::2] for rule in policy.split(";"))
    assert rules["script-src"] == f"'sha256-{known}'"
    assert [rules[name] for name in ("default-src", "base-uri", "form-action")] == ["'none'"] * 3
    assert rules["img-src"] == "'self' file:"


def test_links_lead_to_files(page):
    from urllib.parse import unquote

    links = read(page).links
    assert len(links) > 2 * len(PAIRS)
    assert all((page.parent / unquote(link)).is_file() for link in links)
    assert "logs/lost.log" in links


def test_the_worst_come_first(page):
    texts = read(page).texts
    names = [text for text in texts[texts.index("Find") :] if text in {*PAIRS, "lost", "later", "never"}]
    assert names == ["lost", "never", "bad one", "sub-3", "later", "sub-1", "sub-2", "sub-4", "sub-5"]


def test_outliers_are_named_with_their_values(page):
    texts = read(page).texts
    above = texts[: texts.index("Find")]
    assert above.count("bad one") == 2  # of similarity and of landmarks
    assert "9" in above
    assert "landmark error, px" in above


def test_measures_that_no_pair_has_are_not_shown(page):
    texts = read(page).texts
    assert "folds" in texts
    assert not {"Dice", "GPU memory, MB", "memory, MB"} & set(texts)


def test_without_verdicts_and_thumbnails_there_are_states_and_overviews(tmp_path):
    folder = tmp_path / "pair"
    folder.mkdir()
    (folder / "overview.png").touch()
    write_page(tmp_path / "index.html", [row("a", status=DONE, folds=0, folder="pair")], {})
    found = read(tmp_path / "index.html")
    assert found.links == ["pair/overview.png"] * 3  # around the picture, the picture, the name
    assert BADGES[DONE][1] in found.texts


def test_means_are_those_of_the_pairs_that_are_done():
    rows = [row_of(k, *pair) for k, pair in enumerate(PAIRS.items())] + [row("lost", status=FAILED, seconds=99.0)]
    assert means(rows) == {
        "similarity": "0.525 → 0.7",
        "landmark error": "2.5 px",
        "folds": "0",
        "determinant": "0.5 to 1.75",
        "time": "4 s",
    }
    assert means([*rows, row("mm", status=DONE, landmark_error_after=1.0, unit="mm")])["landmark error"] == "2.29"


def test_the_page_asks_nothing_of_the_network(page):
    text = page.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert "http:" not in text
    assert "https:" not in text


def test_a_pair_takes_a_kilobyte_at_most(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "_link", lambda folder, row, names: f"{row['folder']}/{names[0]}")
    sizes = []
    for count in (1000, 2000):
        write_page(tmp_path / "index.html", [row_of(k % 7, f"sub-{k:05d}", "good") for k in range(count)], {})
        sizes.append((tmp_path / "index.html").stat().st_size)
    assert sizes[1] - sizes[0] < 1000 * 1000


@pytest.mark.parametrize("width", [1400, 800, 400])
def test_a_browser_shows_all_of_it(page, width):
    program = chromium.find_chromium()
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with chromium.Browser(program) as browser:
        browser.resize(width, 2000)
        browser.open(page)
        assert browser.run("document.documentElement.scrollWidth") <= width
        assert browser.run("[...document.images].every(image => image.naturalWidth === 90)")
        visible = "[...document.querySelectorAll('tbody tr')].filter(row => row.offsetHeight).map(row => row.className)"
        assert len(browser.run(visible)) == 9
        browser.run("document.querySelector('.counts [data-kind=good]').click()")
        assert set(browser.run(visible)) == {"good"}
        browser.run("document.querySelector('.counts [data-kind=\"\"]').click()")
        browser.run("filter.value = 'SUB-3'; filter.dispatchEvent(new Event('input'))")
        assert browser.run(visible) == ["look"]
        browser.run("filter.value = ''; filter.dispatchEvent(new Event('input'))")
        browser.run("document.querySelectorAll('th button')[1].click()")
        first = "document.querySelector('tbody tr').className"
        assert browser.run(first) == "bad"  # the lowest similarity
        assert browser.complaints == []
        assert all(url.startswith("file:") for url in browser.requests)
