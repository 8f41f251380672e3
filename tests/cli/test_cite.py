"""The verb that prints citations."""

import json
from dataclasses import asdict

import pytest

from torchdeform.cli.main import torchdeform
from torchdeform.pipeline.citations import bibtex
from torchdeform.pipeline.config import load_settings


def test_the_verb_reads_settings_and_records(tmp_path, capsys):
    assert torchdeform(["cite", "--set", "similarity=mind"]) == 0
    direct = capsys.readouterr().out
    assert direct.strip() == bibtex(load_settings(overrides={"similarity": "mind"}))
    record = {"settings": {**asdict(load_settings(overrides={"similarity": "mind"})), "of_an_older_version": 1}}
    (tmp_path / "result.json").write_text(json.dumps(record), encoding="utf-8")
    assert torchdeform(["cite", str(tmp_path / "result.json")]) == 0
    assert capsys.readouterr().out == direct
    (tmp_path / "my.yaml").write_text("similarity: mind\n", encoding="utf-8")
    assert torchdeform(["cite", "--config", str(tmp_path / "my.yaml")]) == 0
    assert capsys.readouterr().out == direct


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "result.json does not exist"),
        (
            "no json",
            "is no valid JSON (Expecting value: line 1 column 1 (char 0)); give a result.json of a registration",
        ),
        ("[1]", "no record of a registration"),
        ('{"settings": {"similarity": "mindd"}}', "similarity must be one of"),
    ],
)
def test_wrong_records_are_one_sentence(tmp_path, capsys, text, message):
    if text is not None:
        (tmp_path / "result.json").write_text(text, encoding="utf-8")
    assert torchdeform(["cite", str(tmp_path / "result.json")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1


def test_a_record_and_settings_do_not_go_together(tmp_path, capsys):
    (tmp_path / "result.json").write_text('{"settings": {}}', encoding="utf-8")
    assert torchdeform(["cite", str(tmp_path / "result.json"), "--preset", "fast"]) == 2
    assert "leave out --preset" in capsys.readouterr().err
