"""Imports go one way: renderers <- datasets <- bench, in bench package by package; and tests check types."""

import ast
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from jaxtyping import Float, TypeCheckError, jaxtyped
from torch import Tensor

from tests.conftest import checked, forgetting_modules
from tests.runner.driving import by_program

ROOT = Path(__file__).resolve().parent.parent
OURS = ("renderers", "datasets", "bench", "conf", "tests")
FORBIDDEN = {  # what the modules of a package may not import
    "renderers": ("datasets", "bench", "conf", "tests"),
    "datasets": ("bench", "conf", "tests"),
    "bench": ("tests",),
    "conf": OURS,
}
# The packages of bench in the order of imports: a package may use those before it, and none a command.
PACKAGES = (
    "tables", "config", "progress", "records", "machine", "trackers", "exports", "shape_prior",
    "setup", "evaluate", "solve", "pictures", "tasks",
    "runner", "clusters", "report", "studies",
)  # fmt: skip
COMMANDS = (
    "bench.external", "bench.judge", "bench.merge", "bench.photos", "bench.prior", "bench.ray", "bench.suite",
    "bench.train", "bench.tune", "bench.turntable", "bench.verify",
)  # fmt: skip
# Three layers: a file imports only from its layer and the layers below. Files that are not listed are the core.
DATA_LAYER = (
    "datasets.files", "renderers.fields.networks", "renderers.fields.parts", "renderers.fields.textured",
    "bench.clusters", "bench.exports", "bench.runner.durations",
)  # fmt: skip
STUDIES_LAYER = (
    "bench.report", "bench.studies", "bench.pictures", "renderers.later", "renderers.newton",
    "bench.evaluate.along_ray", "bench.evaluate.colours", "bench.evaluate.distances", "bench.evaluate.ray_derivatives",
    "bench.evaluate.prior_errors", "bench.evaluate.refined",
    "bench.evaluate.ray_scene",
    "bench.records.names", "bench.records.published", "bench.records.read", "bench.runner.library",
    "bench.setup.auto", "bench.setup.colour_codes", "bench.setup.spaces",
    "bench.tasks.baselines", "bench.tasks.capacity", "bench.tasks.gradients", "bench.tasks.outline",
    "bench.tasks.reconstruction",
    "bench.tasks.single_view", "bench.tasks.stability",
    "bench.external", "bench.judge", "bench.merge", "bench.photos", "bench.prior", "bench.ray", "bench.suite",
    "bench.train", "bench.tune", "bench.turntable", "bench.verify",
)  # fmt: skip
LISTS = ("bench", "bench.__main__", "renderers")  # import from all layers, to list what there is
MAX_CORE_LINES = 13_000
CORE_MAY = {  # the libraries of the core
    "torch", "jaxtyping", "safetensors", "numpy", "scipy", "skimage", "trimesh", "open3d", "matplotlib", "PIL", "hydra",
    "omegaconf", "yaml", "rich", "filelock", "psutil",
}  # fmt: skip
# These modules decide what is run; no run imports them.
STUDIES = "bench.studies"  # one file a question; this empty package is imported to list them
PASSES_PATH_ON = ("bench.runner.library",)  # reads where this process finds modules, for the process that it starts
RENDERERS_MAY = {"torch", "jaxtyping", "renderers", *sys.stdlib_module_names}
ALSO = {"renderers.later.mesh_proxy": {"numpy", "open3d", "skimage"}}  # a renderer built on other libraries
PICTURES = ("bench.pictures.style", "bench.pictures.figure_style", "bench.pictures.size_chart")  # without torch
WITHOUT_TORCH = ("bench.records", "bench.report", STUDIES, *PICTURES)
COMMON = "datasets.extras"  # without torch; renderers may not use it
DATA_PACKAGES = ("bench.report", "bench.records", "bench.tables")
REPORT_MAY = (COMMON, *DATA_PACKAGES, *PICTURES)


def imported(nodes: Iterable[ast.AST], module: str, is_package: bool) -> set[str]:
    """The dotted names of everything that a module imports, anywhere in it, relative imports resolved."""
    names = set()
    for node in nodes:
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


def within(name: str, *packages: str) -> bool:
    return any(name == package or name.startswith(package + ".") for package in packages)


def package_of(name: str) -> str:
    """The package of bench that a dotted name is in; empty for other packages."""
    parts = name.split(".")
    return parts[1] if parts[0] == "bench" and len(parts) > 1 else ""


def backward(module: str, names: set[str]) -> list[str]:
    """The imports of a module from packages behind its own."""
    if module.endswith(".__main__") or module in COMMANDS:  # nothing imports them
        return []
    own_package, messages = package_of(module), []
    for name in (name for name in names if package_of(name) in PACKAGES and own_package in PACKAGES):
        other_package = package_of(name)
        if other_package != own_package and PACKAGES.index(other_package) > PACKAGES.index(own_package):
            messages.append(f"imports {name} from a package behind {own_package}")
    return messages


def layer(module: str) -> int:
    """0 for the core, 1 for what users bring, 2 for studies."""
    return 2 if within(module, *STUDIES_LAYER) else 1 if within(module, *DATA_LAYER) else 0


def upward(module: str, names: set[str]) -> list[str]:
    """The imports of a module from a layer above it, and those of the core from other libraries than `CORE_MAY`."""
    if not within(module, "renderers", "datasets", "bench") or module in LISTS:
        return []
    messages = [f"imports {name} from a layer above" for name in names if layer(name) > layer(module)]
    libraries = {name.split(".")[0] for name in names} - {*OURS, *sys.stdlib_module_names}
    return messages + [f"imports {name}" for name in libraries - CORE_MAY if layer(module) == 0]


def wrongs(source: str, module: str, is_package: bool = False) -> list[str]:
    """The faults of a module's source."""
    nodes = [*ast.walk(ast.parse(source))]
    names = imported(nodes, module, is_package) - {STUDIES}
    top = module.split(".")[0]
    messages = [f"imports {name}" for name in names if within(name, *FORBIDDEN.get(top, ()))]
    command = [name for name in names if ".__main__" in name or within(name, *COMMANDS)]
    messages += [f"imports a command: {name}" for name in command if top == "bench"]
    messages += backward(module, names) + upward(module, names)
    if top == "renderers":
        allowed = RENDERERS_MAY | ALSO.get(module, set())
        messages += [f"imports {name}" for name in names if name.split(".")[0] not in allowed]
    if within(module, *WITHOUT_TORCH):
        slow = [name for name in names if within(name, "torch", "renderers", "datasets")]
        messages += [f"imports {name}" for name in slow if not within(name, COMMON)]
    if within(module, "bench.report", STUDIES):
        ours = [name for name in names if name.split(".")[0] in OURS]
        messages += [f"imports {name}" for name in ours if not within(name, *REPORT_MAY)]
    if top == "bench":  # a study neither
        messages += [f"imports a study: {name}" for name in names if within(name, STUDIES)]
    if module == "bench":  # runs before every import of bench.report, and before torch may be imported
        messages += [f"imports {name}" for name in names if name.split(".")[0] not in sys.stdlib_module_names]
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names):
            messages.append("has a star import")
        of_sys = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "sys"
        if of_sys and node.attr == "path" and module not in PASSES_PATH_ON:
            messages.append("touches sys.path")
    return messages + ["touches sys.path" for name in names if name == "sys.path"]


def modules() -> list[Path]:
    return sorted(path for package in OURS for path in (ROOT / package).rglob("*.py"))


def named(path: Path) -> tuple[str, bool]:
    parts = path.relative_to(ROOT).with_suffix("").parts
    is_package = parts[-1] == "__init__"
    return ".".join(parts[:-1] if is_package else parts), is_package


def test_imports_go_one_way():
    faults = {str(path): wrongs(path.read_text(), *named(path)) for path in modules()}
    assert {path.relative_to(ROOT).parts[0] for path in modules()} == {*OURS} and len(faults) > 200
    assert {path: wrong for path, wrong in faults.items() if wrong} == {}


def test_every_package_is_in_the_order_of_imports():
    packages = {path.stem for path in (ROOT / "bench").iterdir() if path.is_dir() and list(path.glob("*.py"))}
    packages |= {path.stem for path in (ROOT / "bench").glob("*.py")} - {"__init__", "__main__"}
    assert packages | {"studies"} == {*PACKAGES, *map(package_of, COMMANDS)}


def test_the_core_is_small():
    core = [path for path in modules() if named(path)[0].split(".")[0] not in ("tests", "conf")]
    core = [path for path in core if layer(named(path)[0]) == 0]
    assert sum(len(path.read_text().splitlines()) for path in core) <= MAX_CORE_LINES


def test_conf_holds_yaml_only():
    held = {path for path in (ROOT / "conf").rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert {path.name for path in held if path.suffix != ".yaml"} <= {"__init__.py", "README.md"}


WRONG = (
    ("renderers.dist", "from datasets.scene import Scene"), ("renderers.dist", "import numpy as np"),
    ("renderers.dist", "def f():\n    from bench.config import build"),
    ("renderers.fields.mlp", "from ...bench import config"),
    ("datasets.scene", "import bench.records"), ("datasets.scene", "if True:\n    import conf"),
    ("bench.runner.run", "from tests.renderers.analytic_cases import CASES"),
    ("bench.runner.run", "from bench.report.write.html import write_index"),
    ("bench.records.record", "def f():\n    import bench.report"), ("bench.records.record", "import torch"),
    ("bench.runner.run", "from bench.merge import merge"), ("bench.report.write.html", "from torch import Tensor"),
    ("bench.report.write.html", "from bench import solve"), ("bench.report", "import renderers"),
    ("bench.report.write.html", "from ...solve.solve import COST_DEFINITIONS"),
    ("bench", "import torch"), ("conf", "from bench import config"), ("bench.runner.run", "from os import *"),
    ("tests.test_layers", "import sys\nsys.path.insert(0, '.')"), ("tests.test_layers", "from sys import path"),
    ("bench.__main__", "import bench.studies.completion"),
    ("bench.solve.solve", "from bench.tasks.capacity.field import fit_view"),
    ("datasets.mesh", "from datasets.files.meshes import read_mesh"),
    ("renderers.dist", "import renderers.later.neus"), ("bench.records.folder", "import pandas"),
    ("bench.report.write.html", "from ...studies.completion import make"),
    ("bench.studies.completion", "from .table1 import make"),
    ("bench.studies.completion", "from bench.setup.inputs import Task"),
)  # fmt: skip
RIGHT = (
    ("renderers.dist", "import math\nimport torch\nfrom jaxtyping import Float\nfrom renderers.field import Field"),
    ("renderers.fields.mlp", "from ..field import Kind\nfrom .analytic import Shape"),
    ("datasets.scene", "import numpy\nfrom renderers.camera import Camera\nfrom datasets import mesh"),
    ("bench.runner.run", "import torch, renderers, datasets\nfrom bench.solve.solve import solve"),
    ("bench.tasks.stability.task", "from datasets.files.meshes import read_mesh\nfrom bench.solve.solve import solve"),
    ("renderers", "from renderers.later.neus import NeuS"),
    ("bench.__main__", "from bench.report.write.html import write_index"),
    ("bench.report.write.html", "import plotly, os.path\nfrom bench.records import format\nfrom . import caption"),
    ("bench", "import os"), ("benchmark.report", "import datasets_of_others"),
    ("bench.report.write.paper", "from bench import studies"),
    ("bench.studies.completion", "import pandas as pd\nfrom bench.report.data.statistics import geometric"),
)  # fmt: skip


def test_the_checker_finds_what_is_wrong_and_lets_pass_what_is_right():
    for module, source in (*WRONG, *RIGHT):
        messages = wrongs(source, module, is_package=module in ("bench", "bench.report", "conf"))
        assert bool(messages) is ((module, source) in WRONG), (module, source, messages)


@jaxtyped(typechecker=checked)
def _first(points: Float[Tensor, "*n 3"], wrong: int = 0) -> Float[Tensor, "*n"]:
    return points[..., 0] if wrong == 0 else points


def test_types_and_shapes_are_checked_of_arguments_and_of_results():
    assert _first(torch.zeros(4, 3)).shape == (4,)
    wrong: tuple[tuple[Any, ...], ...] = ((torch.zeros(4, 2),), (torch.zeros(4, 3), "no"), ([0.0],))
    for arguments in wrong:
        with pytest.raises(TypeCheckError, match="parameters"):
            _first(*arguments)
    with pytest.raises(TypeCheckError, match="return value"):  # its shape is (4, 3), but n is (4,)
        _first(torch.zeros(4, 3), 1)


def test_only_modules_that_a_test_wrote_are_forgotten_after_it(tmp_path):
    """PyTorch itself may be under the system's temporary folder, in the virtual environment of a clone."""
    with forgetting_modules(tmp_path):
        for name, folder in (("written_by_a_test", tmp_path), ("of_an_environment", tmp_path.parent)):
            sys.modules[name] = ModuleType(name)
            sys.modules[name].__file__ = str(folder / f"{name}.py")
    assert "written_by_a_test" not in sys.modules and sys.modules.pop("of_an_environment").__file__


@pytest.mark.slow
def test_make_test_types_checks_every_call_of_ours():
    code = "import tests.conftest, torch; from renderers.fields.analytic import sphere; sphere().rotate(torch.eye(4))"
    assert "TypeCheckError" in by_program("-c", code, PYTHONPATH=str(ROOT), CHECK_TYPES="1").err
