"""The benchmark: tasks, the runner, records and reports.

From Python, `bench.load("results")` gives all runs as a pandas table, and `bench.run(task="completion")` makes one.
"""

import os
from importlib import import_module
from typing import Any

# Threads of OpenMP that wait must sleep: where they spin, a second process on the same cores makes both 4 to 20 times
# slower. Read by the runtime once, when torch is first imported, hence here.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")

__all__ = ["load", "run"]


def __getattr__(name: str) -> Any:
    """`load` and `run`, which are imported when they are first asked for: pandas alone takes half a second."""
    if name == "load":
        return import_module("bench.report.data.frame").load
    if name == "run":
        return import_module("bench.run")
    raise AttributeError(f"module 'bench' has no attribute {name!r}")
