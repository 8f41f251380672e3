"""The layers: imports point downwards only, and importing the package stays cheap."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

# From the top down. A module may import its own layer and everything below.
LAYERS = [
    ["cli"],
    ["cohort"],
    ["pipeline"],
    ["nn", "report"],
    ["registration"],
    ["deformation"],
    ["fem", "metrics", "io"],
    ["solvers"],
    ["core"],
    ["errors"],
]
# What nobody but its one home may import, so that it can be replaced in one place.
HOMES = {
    "torchdeform": set(),
    "torchdiffeq": {"core.flow"},
    "SimpleITK": {"io"},
    "pydicom": {"io"},
    "nibabel": {"io"},
    "tifffile": {"io"},
    "matplotlib": {"report"},
    "typer": {"cli"},
    "rich": {"cli"},
    "pydantic": {"pipeline.config", "cohort"},
    "yaml": {"io.texts"},
    "kornia": {"core.image"},
}
HEAVY = [
    "SimpleITK", "matplotlib", "typer", "pydantic", "kornia", "torchdiffeq", "scipy", "skimage", "yaml", "rich",
    "pydicom", "nibabel", "tifffile",
]  # fmt: skip


def imports(source: str) -> list[str]:
    """Return the full names of all modules that a source imports, wherever in the file."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            names += [f"{base}.{alias.name}" if base == "torchdeform" else base for alias in node.names]
    return names


def violations(module: str, source: str) -> list[str]:
    """Return what is wrong with the imports of ``module``, a dotted name below ``torchdeform``."""
    home = module.split(".")[0]
    rank = {name: level for level, names in enumerate(LAYERS) for name in names}
    if home not in rank:
        return [f"{module} is in no layer"]
    found = []
    for name in imports(source):
        package, _, rest = name.partition(".")
        target = rest.split(".")[0]
        if not package:
            found.append(f"{module} imports {name} relatively")
        elif package == "torchdeform" and target != "__version__":
            if rank.get(target, -1) < rank[home]:
                found.append(f"{module} imports upwards: {name}")
        elif package != "torchdeform" and not {home, module} & HOMES.get(package, {home}):
            found.append(f"{module} imports {package}, which only {', '.join(sorted(HOMES[package]))} may")
    return found


def sources(root: Path) -> dict[str, str]:
    """Return the text of every module of the package but its ``__init__``, by dotted name."""
    package = root / "torchdeform"
    files = sorted(p for p in package.rglob("*.py") if p != package / "__init__.py")
    names = [".".join(p.relative_to(package).with_suffix("").parts).removesuffix(".__init__") for p in files]
    return dict(zip(names, (p.read_text(encoding="utf-8") for p in files), strict=True))


def test_imports_point_downwards(root):
    found = [line for name, text in sources(root).items() for line in violations(name, text)]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("core.grid", "from torchdeform.core.warp import sample", 0),
        ("core.grid", "from torchdeform.fem.form import DivCurl", 1),
        ("errors", "def f():\n    import torchdeform.core.grid", 1),
        ("errors", "from torchdeform import core", 1),
        ("solvers.cg", "from torchdeform.fem import Weights", 1),
        ("fem.form", "from torchdeform.solvers.cg import solve", 0),
        ("core.warp", "from .grid import Grid", 1),
        ("registration.result", "import SimpleITK", 1),
        ("io.itk", "import SimpleITK", 0),
        ("report.record", "from torchdeform import __version__", 0),
        ("somewhere", "import torch", 1),
    ],
)
def test_the_test_sees_violations(module, source, wrong):
    assert len(violations(module, source)) == wrong


def arrows(texts: dict[str, str]) -> dict[str, set[str]]:
    """Return for each module the modules of the package that its source imports, wherever in the file."""
    found: dict[str, set[str]] = {}
    for name, source in texts.items():
        tree, targets = ast.parse(source), set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                targets |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                modules = {f"{node.module}.{alias.name}" for alias in node.names}
                targets |= {m for m in modules if m.removeprefix("torchdeform.") in texts} or {str(node.module)}
        inner = {t.removeprefix("torchdeform.") for t in targets if t.startswith("torchdeform.")}
        found[name] = inner & texts.keys() - {name}
    return found


def test_no_circle_of_files(root):
    """Files do not import each other in a circle, not even inside functions."""
    graphlib.TopologicalSorter(arrows(sources(root))).prepare()


def test_a_circle_is_seen():
    texts = {"a": "from io import x\nfrom torchdeform.b import x", "b": "def f():\n    import torchdeform.a"}
    with pytest.raises(graphlib.CycleError):
        graphlib.TopologicalSorter(arrows(texts)).prepare()


def test_importing_the_package_is_light():
    """A fresh interpreter imports torch and little else, and the public names appear when asked for."""
    code = (
        "import sys, torchdeform\n"
        f"heavy = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "assert not heavy, heavy\n"
        "torchdeform.read_image, torchdeform.load_settings, torchdeform.RegistrationSettings\n"
        f"heavy = [name for name in {HEAVY!r} if name in sys.modules]\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_public_names_are_all_there():
    import torchdeform

    for name in torchdeform.__all__:
        assert getattr(torchdeform, name).__doc__, name
    assert set(torchdeform.__all__) <= set(dir(torchdeform))
    assert callable(torchdeform.warp)  # not the module of the same name
    with pytest.raises(AttributeError, match=r"attribute.*nothing"):
        _ = torchdeform.nothing
