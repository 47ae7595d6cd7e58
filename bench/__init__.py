"""The benchmark: tasks, the runner, records and reports.

From Python, `bench.load()` gives all runs as a pandas table, and `bench.run(task="completion")` makes one;
`bench.load_field(RUN)` gives the field that it ended on.
"""

import os
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# Threads of OpenMP that wait must sleep: where they spin, a second process on the same cores makes both 4 to 20 times
# slower. Read by the runtime once, when torch is first imported, hence here.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")

__all__ = ["load", "load_field", "run"]

BESIDE = ("conf", "datasets", "renderers")  # our other packages; `datasets` is also the name of Hugging Face's
OURS = "implicit-bench"  # stands in the first line of each


def __getattr__(name: str) -> Any:
    """What `__all__` names, imported when first asked for: pandas alone takes half a second."""
    if name == "load":
        return import_module("bench.report.data.frame").load
    if name == "load_field":
        return import_module("datasets.field_files").load_field
    if name == "run":
        return import_module("bench.run")
    raise AttributeError(f"module 'bench' has no attribute {name!r}")


def _foreign() -> str:
    """One line on a package of another project that has the place of one of ours; empty where all are ours.

    Nothing is imported: one that is not ours would fail somewhere else, or run.
    """
    beside = Path(__file__).resolve().parent.parent
    for name in BESIDE:
        if name == "conf":  # read by its path, so that a conf.py of the current folder does no harm
            file = beside / name / "__init__.py"
        elif (spec := find_spec(name)) is None:
            continue  # the import will say so
        else:
            file = Path(spec.origin or next(iter(spec.submodule_search_locations or [name])))
        try:
            first = file.read_text(encoding="utf-8").partition("\n")[0]
        except (OSError, UnicodeError):
            first = ""
        if OURS not in first:
            return (
                f"{file} is not the package {name} of {OURS}, but another of that name: give {OURS} an environment of "
                "its own (python -m venv), or start where no such file is found first"
            )
    return ""


if foreign := _foreign():
    if sys.argv[:1] == ["-m"]:  # of `python -m bench`, while the command is looked for
        sys.exit(f"error: {foreign}")
    raise ImportError(foreign)
