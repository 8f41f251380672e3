"""Every Python snippet of the site runs, and every command: those whose files are there run, the others parse."""

import re
import runpy
import shlex
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from nested_settings import changed

from torchdeform.cli.main import main, torchdeform
from torchdeform.pipeline.config import load_settings

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(p.relative_to(ROOT).as_posix() for p in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])


def blocks(page: str, *languages: str) -> list[str]:
    """Return a page's blocks of code in some languages."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^ *```(?:{'|'.join(languages)})\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)


# Pages whose snippets have a test of their own.
ELSEWHERE = {"README.md": "tests/docs/test_readme.py", "docs/layers.md": "tests/docs/test_layers_page.py"}
# What a page takes for granted.
GIVEN = {
    "docs/templates.md": (
        "import torch\nimport torchdeform as td\n"
        "images = [td.Image(torch.rand(1, 1, 24, 24, generator=torch.manual_seed(k)), td.Grid((24, 24)), name=str(k))"
        " for k in range(2)]\n"
    )
}
# Programs that are not ours: only the files of the project that they are given are looked at.
OTHERS = ("python3", "pip", ".", "export", "torchrun", "docker", "kubectl", "sbatch", ".venv/bin/register")
FILES = {".png", ".h5", ".gz", ".mha", ".csv", ".txt", ".json", ".yaml", ".mat", ".fcsv", ".nii"}


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python") and p not in ELSEWHERE])
def test_python_snippets_run(page, workplace, capsys):
    """All of a page, one after the other, as a reader would."""
    names: dict[str, object] = {}
    exec(GIVEN.get(page, ""), names)
    for number, snippet in enumerate(blocks(page, "python")):
        exec(compile(snippet, f"{page}, snippet {number + 1}", "exec"), names)
    capsys.readouterr()


def test_the_others_have_their_tests():
    for page, test in ELSEWHERE.items():
        assert page.rpartition("/")[2] in (ROOT / test).read_text(encoding="utf-8")


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "yaml") and p != "docs/clusters.md"])
def test_yaml_snippets_are_yaml(page):
    """Those of clusters are pieces of one, which tests/batch reads."""
    for snippet in blocks(page, "yaml"):
        included = re.findall(r'--8<-- "(.*)"', snippet)
        assert isinstance(
            yaml.safe_load((ROOT / included[0]).read_text(encoding="utf-8") if included else snippet), dict
        )


@pytest.fixture
def quick(monkeypatch):
    """Let registrations take three steps a level."""

    def few(*arguments: object):
        settings = load_settings(*arguments)  # type: ignore[arg-type]
        return changed(settings, steps=tuple(min(3, n) for n in settings.optimiser.steps))

    monkeypatch.setattr("torchdeform.cli.register.load_settings", few)


@pytest.fixture
def workplace(tmp_path, monkeypatch) -> Path:
    """A working folder that looks like the project's to commands of the pages."""
    for name in ("examples", "scripts", "configs"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def lines(page: str) -> list[str]:
    """Return the commands of a page."""
    found = [line.strip() for block in blocks(page, "sh", "bash") for line in block.splitlines()]
    return [line for line in found if line and not line.startswith("#")]


@pytest.mark.parametrize("page", [p for p in PAGES if lines(p)])
def test_commands_run(page, workplace, quick, capsys, monkeypatch):
    ran = 0
    for line in lines(page):
        words = shlex.split(line, comments=True)
        if words[0] in ("register", "torchdeform"):
            ran += run(words, line, capsys)
        elif words[:2] == ["python", "scripts/phantoms.py"]:
            monkeypatch.setattr(sys, "argv", words[1:])
            monkeypatch.syspath_prepend(str(ROOT / "scripts"))  # as Python does for a script
            runpy.run_path(words[1], run_name="__main__")
        else:
            assert words[0] in ("python", *OTHERS), line
            ours = [word for word in words if word.startswith(("scripts/", "examples/", "configs/"))]
            assert all((ROOT / word).is_file() for word in ours), line
    if page.startswith("docs/how-to/") and not page.endswith("training.md"):
        assert ran


def run(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> bool:
    """Run a command, and say whether its files were there; if not it fails on them, not on its words."""
    program = main if words[0] == "register" else torchdeform
    inputs = [word for before, word in pairwise(words) if before != "--out"]
    there = all(Path(word).exists() for word in inputs if Path(word).suffix in FILES)
    code = program(words[1:])
    err = capsys.readouterr().err
    if there:
        assert code == 0, f"{line}: {err}"
    else:
        assert code in (1, 2), line
        assert "--help" not in err, f"{line}: {err}"
    return there
