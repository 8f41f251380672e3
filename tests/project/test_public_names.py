"""What is public: a committed list, and docstrings that say what goes in, what comes out and what is refused.

After a change that is meant: ``python tests/project/test_public_names.py``.
"""

import ast
import inspect
import json
import textwrap
from dataclasses import fields, is_dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("public_names.json")
MODULES = ("torchdeform", "torchdeform.nn", "torchdeform.report")


def public_names() -> dict[str, list[str]]:
    """Return the names of each public module, sorted."""
    return {module: sorted(import_module(module).__all__) for module in MODULES}


def listed() -> list[str]:
    """Return the full names in the committed list."""
    names = json.loads(LIST.read_text(encoding="utf-8"))
    return [f"{module}.{name}" for module in names for name in names[module]]


def test_the_list_is_kept():
    assert public_names() == json.loads(LIST.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", listed())
def test_docstrings_are_whole(name):
    module, _, last = name.rpartition(".")
    assert not missing(getattr(import_module(module), last))


def missing(value: object) -> list[str]:
    """Return what the docstring of something public does not say."""
    text = inspect.getdoc(value) or ""
    if not text.partition("\n")[0].endswith("."):
        return ["one sentence"]
    if inspect.isclass(value) and issubclass(value, Enum | Exception):
        return []
    named = arguments(value)
    lacks = [f"argument {argument}" for argument in named if argument not in text]
    if named and not any(section in text for section in ("Args:", "Attributes:")):
        lacks.append("Args")
    if inspect.isfunction(value):
        result = inspect.signature(value).return_annotation
        lacks += ["Returns"] if result not in (None, "None") and "Returns:" not in text else []
        lacks += ["Raises"] if raises(value) and "Raises:" not in text else []
    return lacks


def arguments(value: object) -> list[str]:
    """Return the arguments of a function or a class, those of a class being its fields where it is a dataclass."""
    if is_dataclass(value):
        return [field.name for field in fields(value) if not field.name.startswith("_")]
    assert callable(value)
    return [name for name in inspect.signature(value).parameters if name not in ("args", "kwargs")]


def raises(function: object) -> bool:
    """Say whether a function raises anything in its own body."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))  # type: ignore[arg-type]
    return any(isinstance(node, ast.Raise) for node in ast.walk(tree))


@pytest.mark.parametrize(
    ("source", "wrong"),
    [
        ("def f(x: int) -> None:\n    'No stop'", ["one sentence"]),
        ("def f(x: int) -> int:\n    'Return y.'", ["argument x", "Args", "Returns"]),
        ("def f(x: int) -> int:\n    'Return y.\\n\\nArgs:\\n    x: it.\\n\\nReturns:\\n    y.'", []),
    ],
)
def test_the_test_sees_what_is_missing(source, wrong, tmp_path, monkeypatch):
    (tmp_path / "some_functions.py").write_text(source + "\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(__import__("sys").modules, "some_functions", raising=False)
    assert missing(import_module("some_functions").f) == wrong


if __name__ == "__main__":
    LIST.write_text(json.dumps(public_names(), indent=1) + "\n", encoding="utf-8")
