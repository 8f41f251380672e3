"""The page about layers: its Python runs as it stands, its commands name files and settings that exist."""

import re
import shlex

import pytest


def blocks(root, language: str) -> list[str]:
    text = (root / "docs" / "layers.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def test_python_snippets_run(root, tmp_path, monkeypatch):
    """All of them, one after the other, as a reader would."""
    pytest.importorskip("matplotlib")
    (tmp_path / "examples").symlink_to(root / "examples")
    monkeypatch.chdir(tmp_path)
    snippets = blocks(root, "python")
    assert len(snippets) >= 8
    names: dict[str, object] = {}
    for number, snippet in enumerate(snippets):
        exec(compile(snippet, f"layers.md, snippet {number + 1}", "exec"), names)
    assert (tmp_path / "layers.png").stat().st_size > 10_000
    assert (root / "docs" / "layers.png").is_file()


def test_commands_name_what_exists(root):
    """`tests/examples` runs the scripts themselves, the one that trains on one process and on two."""
    commands = [shlex.split(line) for block in blocks(root, "sh") for line in block.splitlines()]
    files = {word for words in commands for word in words if word.endswith((".py", ".yaml"))}
    assert len(files) == 3
    assert all((root / name).is_file() for name in files)


def test_every_layer_is_on_the_page(root):
    from torchdeform import nn as layers

    text = (root / "docs" / "layers.md").read_text(encoding="utf-8")
    missing = [name for name in layers.__all__ if name not in text and name != "RandomMap"]
    assert not missing
