"""``torchdeform cite``: the entries are whole, and each setting brings its own."""

import re

import pytest
from nested_settings import settings_of

from torchdeform.metrics.similarity import MEASURES
from torchdeform.pipeline.citations import bibliography, citations
from torchdeform.pipeline.config import load_settings

ALWAYS = {"torchdeform", "liu2007reconstruction", "liu2024finite"}


NEEDED = {
    "article": {"title", "author", "journal", "volume", "pages", "year", "doi"},
    "inproceedings": {"title", "author", "booktitle", "pages", "year"},
    "techreport": {"title", "author", "institution", "number", "year"},
    "misc": {"title", "author"},
}


@pytest.mark.parametrize(("key", "entry"), bibliography().items(), ids=lambda v: v[:20])
def test_entries_are_whole(key, entry):
    kind, found = re.match(r"@(\w+)\{([^,]+),", entry).groups()
    assert found == key
    assert set(re.findall(r"^  (\w+) *= \{", entry, re.MULTILINE)) >= NEEDED[kind]
    assert entry.count("{") == entry.count("}")
    assert entry.isascii() or "é" not in entry


def test_every_entry_is_cited_by_some_settings():
    assert set(citations(settings_of(features="mind", similarity="ssd"))) - set(
        citations(settings_of(similarity="ssd"))
    ) == {"heinrich2013towards"}
    several = [settings_of(similarity=dict.fromkeys(MEASURES, 1.0), start=start) for start in ("discrete", "keypoints")]
    assert set().union(*map(citations, several)) == set(bibliography())


@pytest.mark.parametrize(
    ("overrides", "keys"),
    [
        ({"similarity": "ssd"}, set()),
        ({"similarity": "lncc"}, {"avants2008symmetric"}),
        ({"similarity": {"nmi": 1, "ngf": 0.5}}, {"studholme1999overlap", "haber2006intensity"}),
        ({"similarity": "mi"}, {"viola1997alignment", "thevenaz2000optimization"}),
        (
            {"similarity": "mind", "start": "discrete"},
            {"heinrich2013towards", "steinbruecker2009large", "siebert2021fast"},
        ),
        (
            {"similarity": "ssd", "start": "keypoints"},
            {"foerstner1987fast", "heinrich2015estimating", "steinbruecker2009large", "heinrich2013towards"},
        ),
    ],
)
def test_settings_bring_their_methods(overrides, keys):
    assert set(citations(load_settings(overrides=overrides))) == ALWAYS | keys
