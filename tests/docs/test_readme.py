"""The README: its Python runs as it stands, and its commands are those that exist."""

import re
import shlex
from pathlib import Path

import pytest

from torchdeform.pipeline.config import load_settings


def _blocks(root: Path, language: str) -> list[str]:
    return re.findall(
        rf"^```{language}\n(.*?)^```", (root / "README.md").read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )


def test_python_snippets_run(root, tmp_path, monkeypatch, capsys):
    """All of them, one after the other, as a reader would."""
    (tmp_path / "examples").symlink_to(root / "examples")
    monkeypatch.chdir(tmp_path)
    snippets = _blocks(root, "python")
    assert len(snippets) >= 3
    names: dict[str, object] = {}
    for number, snippet in enumerate(snippets):
        exec(compile(snippet, f"README.md, snippet {number + 1}", "exec"), names)
    capsys.readouterr()
    assert [p.name for p in tmp_path.iterdir()] == ["examples"]


def test_yaml_snippets_load(root, tmp_path):
    for snippet in _blocks(root, "yaml"):
        (tmp_path / "settings.yaml").write_text(snippet, encoding="utf-8")
        load_settings(file=tmp_path / "settings.yaml")


def test_commands_are_understood(root, monkeypatch):
    """Every ``register`` line of the README parses: it fails on the missing files at most."""
    from torchdeform.cli.main import main

    lines = [line for block in _blocks(root, "sh") for line in block.splitlines() if line.startswith("register ")]
    assert len(lines) >= 3
    seen = []
    monkeypatch.setattr("torchdeform.cli.register.load_settings", lambda *arguments: seen.append(arguments))
    for line in lines:
        assert main(shlex.split(line, comments=True)[1:]) in (1, 2)
    assert len(seen) == len(lines)


@pytest.mark.parametrize("link", ["examples/overview.jpg", "configs/presets/default.yaml", "LICENSE", "CITATION.cff"])
def test_linked_files_exist(root, link):
    assert f"({link})" in (root / "README.md").read_text(encoding="utf-8")
    assert (root / link).is_file()


def test_example_is_what_its_script_makes(root, tmp_path, monkeypatch):
    """The pair in the repository can be made again, pixel for pixel but for rounding."""
    import importlib.util

    import torch

    from torchdeform.io import read_image

    spec = importlib.util.spec_from_file_location("make_example", root / "scripts" / "make_example.py")
    assert spec is not None and spec.loader is not None  # noqa: PT018
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "ROOT", tmp_path)
    script.make_pair()
    for name in ("fixed.png", "moving.png"):
        ours, theirs = (read_image(folder / "examples" / name).data for folder in (root, tmp_path))
        assert torch.allclose(ours, theirs, atol=1.5)
        assert (root / "examples" / name).stat().st_size < 200_000
