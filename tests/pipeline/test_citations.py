"""``torchdeform cite``: the entries are whole, and each setting brings its own."""

import json
import re
from dataclasses import asdict

import pytest

from torchdeform.cli.main import torchdeform
from torchdeform.metrics.similarity import SIMILARITIES
from torchdeform.pipeline.citations import bibliography, bibtex, citations
from torchdeform.pipeline.config import load_settings
from torchdeform.registration.settings import RegistrationSettings

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
    several = RegistrationSettings(similarity=dict.fromkeys(SIMILARITIES, 1.0), start="discrete")
    assert set(citations(several)) == set(bibliography())


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
    ],
)
def test_settings_bring_their_methods(overrides, keys):
    assert set(citations(load_settings(overrides=overrides))) == ALWAYS | keys


def test_the_verb_reads_settings_and_records(tmp_path, capsys):
    assert torchdeform(["cite", "--set", "similarity=mind"]) == 0
    direct = capsys.readouterr().out
    assert direct.strip() == bibtex(load_settings(overrides={"similarity": "mind"}))
    record = {"settings": {**asdict(load_settings(overrides={"similarity": "mind"})), "of_an_older_version": 1}}
    (tmp_path / "result.json").write_text(json.dumps(record))
    assert torchdeform(["cite", str(tmp_path / "result.json")]) == 0
    assert capsys.readouterr().out == direct
    (tmp_path / "my.yaml").write_text("similarity: mind\n")
    assert torchdeform(["cite", "--config", str(tmp_path / "my.yaml")]) == 0
    assert capsys.readouterr().out == direct


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("no json", "no record of a registration"),
        ("[1]", "no record of a registration"),
        ('{"settings": {"similarity": "mindd"}}', "similarity must be one of"),
    ],
)
def test_wrong_records_are_one_sentence(tmp_path, capsys, text, message):
    if text is not None:
        (tmp_path / "result.json").write_text(text)
    assert torchdeform(["cite", str(tmp_path / "result.json")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1


def test_a_record_and_settings_do_not_go_together(tmp_path, capsys):
    (tmp_path / "result.json").write_text('{"settings": {}}')
    assert torchdeform(["cite", str(tmp_path / "result.json"), "--preset", "fast"]) == 2
    assert "leave --preset" in capsys.readouterr().err
