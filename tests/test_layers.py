"""Who may import whom: renderers <- datasets <- bench, and a report that needs no torch."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
OURS = ("renderers", "datasets", "bench", "conf", "tests")
FORBIDDEN = {  # what the modules of a package may not import
    "renderers": ("datasets", "bench", "conf", "tests"),
    "datasets": ("bench", "conf", "tests"),
    "bench": ("tests",),
    "conf": OURS,
}
RENDERERS_MAY = {"torch", "jaxtyping", "renderers", *sys.stdlib_module_names}


def imported(tree: ast.AST, module: str, is_package: bool) -> set[str]:
    """The dotted names of everything that a module imports, anywhere in it, relative imports resolved."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".")
                parents = parents[: len(parents) - node.level + is_package]
                base = ".".join([*parents, base]).strip(".")
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def within(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def wrongs(source: str, module: str, is_package: bool = False) -> list[str]:
    """What the source of a module does that it may not do."""
    tree = ast.parse(source)
    names = imported(tree, module, is_package)
    top = module.split(".")[0]
    found = [f"imports {name}" for name in names if any(within(name, other) for other in FORBIDDEN.get(top, ()))]
    if top == "renderers":
        found += [f"imports {name}" for name in names if name.split(".")[0] not in RENDERERS_MAY]
    if within(module, "bench.report"):
        outside = [n for n in names if n.split(".")[0] in (*OURS, "torch") and not within(n, "bench.report")]
        found += [f"imports {name}" for name in outside]
    if module == "bench":  # runs before every import of bench.report, and before torch may be imported
        found += [f"imports {name}" for name in names if name.split(".")[0] not in sys.stdlib_module_names]
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names):
            found.append("has a star import")
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "sys.path":
            found.append("touches sys.path")
    return found + ["touches sys.path" for name in names if name == "sys.path"]


def modules() -> list[Path]:
    return sorted(path for package in OURS for path in (ROOT / package).rglob("*.py"))


def named(path: Path) -> tuple[str, bool]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    is_package = parts[-1] == "__init__"
    return ".".join(parts[:-1] if is_package else parts), is_package


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path):
    assert wrongs(path.read_text(), *named(path)) == []


def test_every_package_is_looked_at():
    seen = {named(path)[0] for path in modules()}
    assert seen >= {"renderers.fields.mlp", "datasets.scene", "bench", "bench.report.html", "conf", "tests.test_layers"}


def test_conf_holds_yaml_only():
    held = {path for path in (ROOT / "conf").rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert {path for path in held if path.suffix != ".yaml"} == {ROOT / "conf" / "__init__.py"}


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("renderers.dist", "import datasets"),
        ("renderers.dist", "from datasets.scene import Scene"),
        ("renderers.dist", "def f():\n    from bench.config import build"),
        ("renderers.dist", "import numpy as np"),
        ("renderers.fields.mlp", "from ...bench import config"),
        ("renderers.fields.mlp", "from torchvision import ops"),
        ("datasets.scene", "import bench.records"),
        ("datasets.scene", "from bench import records"),
        ("datasets.scene", "if True:\n    import conf"),
        ("bench.runner", "from tests.analytic_cases import CASES"),
        ("bench.report.html", "import torch.nn"),
        ("bench.report.html", "from torch import Tensor"),
        ("bench.report.html", "from bench.records import Record"),
        ("bench.report.html", "from bench import records"),
        ("bench.report.html", "from .. import records"),
        ("bench.report.html", "from ..records import Record"),
        ("bench.report.html", "from datasets.mesh import Mesh"),
        ("bench.report", "import renderers"),
        ("bench", "import torch"),
        ("conf", "from bench import config"),
        ("bench.runner", "from os import *"),
        ("tests.test_layers", "import sys\nsys.path.insert(0, '.')"),
        ("tests.test_layers", "import sys\nsys.path += ['.']"),
        ("tests.test_layers", "from sys import path"),
    ],
)
def test_the_checker_finds_what_is_wrong(module, source):
    assert wrongs(source, module, is_package=module in ("bench", "bench.report", "conf"))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("renderers.dist", "import math\nimport torch\nfrom jaxtyping import Float\nfrom renderers.field import Field"),
        ("renderers.fields.mlp", "from ..field import Kind\nfrom .analytic import Shape"),
        ("datasets.scene", "import numpy\nfrom renderers.camera import Camera\nfrom datasets import mesh"),
        ("bench.runner", "import torch, renderers, datasets\nfrom bench.report.html import write_index"),
        ("bench.report.html", "import jinja2, os.path\nfrom bench.report import format\nfrom . import records"),
        ("bench", "import os"),
        ("benchmark.report", "import datasets_of_others"),
    ],
)
def test_the_checker_lets_pass_what_is_right(module, source):
    assert wrongs(source, module, is_package=module == "bench") == []
