"""The site builds without a warning, needs no network, has no dead link, and names everything that is public."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import numpy as np
import pytest
from PIL import Image

from torchdeform.pipeline.config import preset_names

ROOT = Path(__file__).resolve().parents[2]
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}


class Page(HTMLParser):
    """What a page loads, what it links to, and what can be linked to in it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {name for key in ("id", "name") if (name := values.get(key))}
        if tag == "a" and (target := values.get("href")):
            self.links.append(target)
        elif (target := values.get(LOADED.get(tag, ""))) and values.get("rel") != "canonical":
            self.loads.append(target)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built with warnings as errors."""
    pytest.importorskip("mkdocstrings")
    pytest.importorskip("material", reason="mkdocs-material is not installed")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(out)]
    variables = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr.strip()
    return out


@pytest.fixture(scope="module")
def pages(site) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob("*.html") if path.name != "404.html"}


def test_nothing_comes_from_the_network(site, pages):
    for path, page in pages.items():
        assert not [target for target in page.loads if urlsplit(target).netloc], path
    for path in site.rglob("*.css"):
        assert not re.findall(r"url\(['\"]?https?:|@import", path.read_text(encoding="utf-8")), path


def test_links_lead_somewhere(pages):
    for path, page in pages.items():
        for link in page.links + page.loads:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or link == "#":
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert target.exists(), f"{path.name}: {link}"
            if parts.fragment and target in pages:
                assert unquote(parts.fragment) in pages[target].anchors, f"{path.name}: {link}"


def test_the_reference_has_every_public_name(pages):
    anchors = set().union(*(page.anchors for page in pages.values()))
    names = json.loads((ROOT / "tests" / "project" / "public_names.json").read_text(encoding="utf-8"))
    missing = [f"{module}.{name}" for module in names for name in names[module] if f"{module}.{name}" not in anchors]
    assert not missing


def test_every_preset_is_shown():
    text = (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8")
    assert all(f"## {name}\n" in text and f"presets/{name}.yaml" in text for name in preset_names())


def test_pictures_are_made_by_the_build_and_small(site):
    files = list((site / "pictures").iterdir())
    names = {"report", "overview", "brains", "lungs", "hearts", "histology", "contrasts", "grids", "volume-change"}
    names |= {"tissue", "bones", "breast", "breathing"}
    assert {path.name for path in files} == {f"{name}.jpg" for name in names}
    assert not (ROOT / "docs" / "pictures").exists()
    assert all(5_000 < path.stat().st_size < 250_000 for path in files)
    assert sum(path.stat().st_size for path in files) < 2_000_000


def test_the_picture_of_the_readme_is_what_the_default_makes(site):
    """If not, ``python scripts/make_example.py`` makes it anew."""
    now, then = (Image.open(path) for path in (site / "pictures" / "overview.jpg", ROOT / "examples" / "overview.jpg"))
    assert now.size == then.size
    small = [np.asarray(image.convert("RGB").resize((100, 60)), float) for image in (now, then)]
    assert np.abs(small[0] - small[1]).mean() < 6
