"""docs/cohorts.md: its files are cohort files, and its commands exist."""

import re

import pytest

from torchdeform.cli.main import torchdeform
from torchdeform.cohort.schema import read_cohort


def blocks(root, language):
    """Return the page's blocks of a language."""
    text = (root / "docs" / "cohorts.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def test_cohort_files_are_read(root, tmp_path):
    files = [text for text in blocks(root, "yaml") if text.startswith("out:")]
    assert len(files) >= 5
    for text in files:
        (tmp_path / "cohort.yaml").write_text(text, encoding="utf-8")
        assert read_cohort(tmp_path / "cohort.yaml").resolve()


def test_links_lead_somewhere(root):
    text = (root / "docs" / "cohorts.md").read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert links
    for link in links:
        assert (root / "docs" / link).exists(), link


@pytest.mark.parametrize("verb", ["batch", "schema"])
def test_verbs_have_help(verb, capsys):
    assert torchdeform([verb, "--help"]) == 0
    assert verb in capsys.readouterr().out
