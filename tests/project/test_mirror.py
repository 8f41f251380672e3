"""Every test file in a folder of a package's name belongs to a module there, and every module has its test file."""

from pathlib import Path

import pytest

# Modules without a test file of their own, and why.
UNTESTED = {
    "registration.result": "only dataclasses without a method, which every registration fills",
}


def modules(root: Path) -> set[str]:
    """Return the dotted names of all modules of the package but its ``__init__``."""
    package = root / "torchdeform"
    files = (p for p in package.rglob("*.py") if p.name != "__init__.py")
    return {".".join(p.relative_to(package).with_suffix("").parts) for p in files}


def mirrored(root: Path) -> set[str]:
    """Return ``core.warp`` for ``tests/core/test_warp.py``, in the folders that have a package's name."""
    folder, packages = root / "tests", {p.parent for p in (root / "torchdeform").rglob("__init__.py")}
    folders = {folder / p.relative_to(root / "torchdeform") for p in packages}
    files = (p for place in folders for p in place.glob("test_*.py"))
    return {".".join([*p.parent.relative_to(folder).parts, p.stem.removeprefix("test_")]) for p in files}


def homeless(tests: set[str], modules: set[str]) -> list[str]:
    """Return the tests that belong to no module; ``test_page_in_browser.py`` belongs to ``page.py``."""
    return sorted(t for t in tests if not any(t == m or t.startswith(f"{m}_") for m in modules))


def untested(tests: set[str], modules: set[str]) -> set[str]:
    """Return the modules without a test file."""
    return modules - tests


def test_every_test_file_belongs_to_a_module(root):
    assert homeless(mirrored(root), modules(root)) == []


def test_every_module_has_a_test_file(root):
    assert untested(mirrored(root), modules(root)) == UNTESTED.keys()


@pytest.mark.parametrize(
    ("test", "known"),
    [("core.warp", True), ("core.warp_long", True), ("core.warps", False), ("warp", False), ("io.warp", False)],
)
def test_names_are_compared_whole(test, known):
    assert (homeless({test}, {"core.warp", "core.grid"}) == []) == known
    assert untested({test}, {"core.warp"}) == (set() if test == "core.warp" else {"core.warp"})
