"""The layers: imports point downwards only, and importing the package stays cheap."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

# From the top down. A module may import its own layer and everything below.
LAYERS = [
    ["cli", "commands", "batch"],
    ["pair", "deform"],
    ["check", "memory"],
    ["config", "citations", "nn", "io", "report"],
    ["registration"],
    ["deformation"],
    ["flow", "diagnostics"],
    ["fem", "solvers"],
    ["transform", "interpolation", "warp", "stencil", "grid", "image"],
    ["errors"],
]
# Within a layer, what must not import what.
FORBIDDEN = {("solvers", "fem")}
# What nobody but its one home may import, so that it can be replaced in one place.
HOMES = {
    "torchdeform": set(),
    "torchdiffeq": {"flow"},
    "SimpleITK": {"io"},
    "matplotlib": {"report"},
    "typer": {"cli", "commands"},
    "rich": {"cli", "commands"},
    "pydantic": {"config", "batch"},
    "yaml": {"config"},
    "kornia": {"warp", "image"},
}
HEAVY = ["SimpleITK", "matplotlib", "typer", "pydantic", "kornia", "torchdiffeq", "scipy", "skimage", "yaml", "rich"]


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
            if rank.get(target, -1) < rank[home] or (home, target) in FORBIDDEN:
                found.append(f"{module} imports upwards: {name}")
        elif home not in HOMES.get(package, {home}) and package != "torchdeform":
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
        ("grid", "from torchdeform.warp import sample", 0),
        ("grid", "from torchdeform.fem.form import DivCurl", 1),
        ("errors", "def f():\n    import torchdeform.grid", 1),
        ("errors", "from torchdeform import grid", 1),
        ("solvers.cg", "from torchdeform.fem import Weights", 1),
        ("fem.form", "from torchdeform.solvers.cg import solve", 0),
        ("warp", "from .grid import Grid", 1),
        ("registration.result", "import SimpleITK", 1),
        ("io.itk", "import SimpleITK", 0),
        ("report.record", "from torchdeform import __version__", 0),
        ("somewhere", "import torch", 1),
    ],
)
def test_the_test_sees_violations(module, source, wrong):
    assert len(violations(module, source)) == wrong


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
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = torchdeform.nothing
