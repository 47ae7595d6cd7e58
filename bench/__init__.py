"""The benchmark: tasks, the runner, records and reports.

From Python, `bench.load()` returns all runs as a pandas table, `bench.run(task="completion")` makes a run,
`bench.load_field(RUN)` loads the final field of a run, `bench.compare(["dist", "newton"])` compares renderers on the
suite, and `bench.plot(RUNS)` draws error over cost of runs of one task.
"""

import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

# Waiting OpenMP threads must sleep: if they spin, a second process on the same cores makes both 4 to 20 times slower.
# OpenMP reads these variables once, at the first import of torch, so they are set here.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")

MODULES = {
    "compare": "bench.report.library",
    "load": "bench.report.data.frame",
    "load_field": "datasets.files.field_files",
    "plot": "bench.report.library",
    "run": "bench.runner.library",
}
__all__ = [*MODULES]

SIBLING_PACKAGES = ("conf", "datasets", "renderers")  # `datasets` is also the name of a Hugging Face package
PROJECT = "implicit-bench"  # the first line of each sibling package contains it


def __getattr__(name: str) -> Any:
    """Imports the names of `__all__` at their first use: pandas alone takes half a second."""
    if name in MODULES:
        return getattr(import_module(MODULES[name]), name)
    raise AttributeError(f"module 'bench' has no attribute {name!r}")


def __dir__() -> list[str]:
    """What a user of the library needs."""
    return [*__all__]


def _foreign_package_message() -> str:
    """Returns an error message if one of our package names leads to a package of another project, else "".

    Nothing is imported: a foreign package might fail or run code.
    """
    root = Path(__file__).resolve().parent.parent
    for name in SIBLING_PACKAGES:
        if name == "conf":  # found by its path, so that a conf.py in the current folder does no harm
            file = root / name / "__init__.py"
        elif (spec := find_spec(name)) is None:
            continue  # the import will report it
        else:
            file = Path(spec.origin or next(iter(spec.submodule_search_locations or [name])))
        try:
            first_line = file.read_text(encoding="utf-8").partition("\n")[0]
        except (OSError, UnicodeError):
            first_line = ""
        if PROJECT not in first_line:
            return (
                f"{file} is not the package {name} of {PROJECT}, but another of that name: give {PROJECT} an "
                "environment of its own (python -m venv), or start where no such file is found first"
            )
    return ""


def _print_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Prints one line after a Ctrl-C that nothing caught, also if a library made another error of it."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    if cause is None:
        sys.__excepthook__(kind, error, trace)
    else:
        print("error: stopped by Ctrl-C", file=sys.stderr)


if sys.argv[:1] == ["-m"]:  # `python -m bench.NAME`, or another module that imports this one at once
    sys.excepthook = _print_uncaught

if foreign_package := _foreign_package_message():
    if sys.argv[:1] == ["-m"]:  # `python -m bench` is still looking for the command
        sys.exit(f"error: {foreign_package}")
    raise ImportError(foreign_package)
