"""The modules and kernels of this project that a run imports: only an edit of these makes it stale."""

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from bench.config import OUR_PACKAGES

ROOT = Path(__file__).resolve().parents[2]
ENTRY = "bench.runner.execute"  # the process of every run begins here
LISTED = ("datasets.files.captures.formats",)  # packages of which all modules are imported, found by listing
FOR_TYPES = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.MULTILINE)
IMPORT = re.compile(r"^[ \t]*(?:from ([\w.]+) import (\([^)]*\)|.*)|import ([\w.]+))", re.MULTILINE)


def imported_files(targets: Iterable[str]) -> list[Path]:
    """The files of this project that a run imports, in order, with the C++ file of a module that has one.

    Args:
        targets: dotted names of the classes that its configuration names.
    """
    remaining, modules = [ENTRY, *targets], set[str]()
    while remaining:
        module = _module_of(remaining.pop())
        if module and module not in modules:
            modules.add(module)
            remaining += _imports(module)
            if module in LISTED:
                remaining += [f"{module}.{path.stem}" for path in (ROOT / module.replace(".", "/")).glob("*.py")]
    files = [path for module in modules if (path := _file(module))]
    return sorted([*files, *(kernel for path in files if (kernel := path.with_suffix(".cpp")).is_file())])


@cache
def _file(module: str) -> Path | None:
    """The file of a module or package; None if there is none."""
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


@cache
def _module_of(name: str) -> str:
    """The module that defines a dotted name, also if its package only passes it on; empty for other projects."""
    if name.split(".")[0] not in OUR_PACKAGES:
        return ""
    if _file(name) is not None:
        return name
    package, _, attribute = name.rpartition(".")
    passed_on = [origin for origin in _imports(package) if origin.endswith(f".{attribute}")] if _file(package) else []
    return _module_of(passed_on[0]) if passed_on else package if _file(package) else _module_of(package)


@cache
def _imports(module: str) -> list[str]:
    """The dotted names that a module imports from this project, also within functions."""
    file, names = _file(module), list[str]()
    source = FOR_TYPES.sub("", file.read_text(encoding="utf-8")) if file else ""
    for origin, imported, plain in IMPORT.findall(source):
        if (origin or plain).split(".")[0] in OUR_PACKAGES:
            items = re.sub(r"#.*", "", imported).strip("( )").split(",")
            words = [words[0] for item in items if (words := item.split())]  # of `a as b`, a
            names += [f"{origin}.{word}" for word in words] if origin else [plain]
    return names
