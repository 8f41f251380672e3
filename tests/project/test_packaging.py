"""What a user installs: the wheel holds the presets and the type marker, and its versions agree."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

import torchdeform


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from the checkout without a network."""
    pytest.importorskip("hatchling")
    root, out = Path(__file__).resolve().parents[2], tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return next(out.glob("*.whl"))


def test_wheel_holds_what_is_needed(wheel, root):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    presets = {f"torchdeform/configs/presets/{p.name}" for p in (root / "configs" / "presets").iterdir()}
    modules = {str(p.relative_to(root)) for p in (root / "torchdeform").rglob("*.py")}
    templates = {f"torchdeform/report/templates/report.{kind}" for kind in ("html", "css", "js")}
    assert (
        presets
        | modules
        | templates
        | {"torchdeform/py.typed", "torchdeform/__init__.pyi", "torchdeform/pipeline/references.bib"}
        <= names
    )
    assert not any(name.startswith(("tests/", "configs/")) for name in names)


def test_presets_are_found_in_an_installed_package(wheel, tmp_path):
    """Unpacked anywhere, the package finds its presets inside itself."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    code = (
        "from torchdeform.pipeline.config import configs_folder, load_settings\n"
        "load_settings('fast'); print(configs_folder())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == tmp_path / "torchdeform" / "configs"


def test_versions_agree(root):
    citation = yaml.safe_load((root / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == torchdeform.__version__
    assert f"## {torchdeform.__version__}" in (root / "CHANGELOG.md").read_text(encoding="utf-8")


def test_constraints_cover_what_is_declared(root):
    import tomllib

    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = project["dependencies"] + project["optional-dependencies"]["test"]
    declared += project["optional-dependencies"]["docs"]
    pinned = (root / "constraints.txt").read_text(encoding="utf-8").lower()
    missing = [d for d in declared if not re.search(rf"^{re.split('[<>=;]', d)[0].lower()}==", pinned, re.MULTILINE)]
    assert not missing
