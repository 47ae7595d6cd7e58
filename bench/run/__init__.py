"""The runner; the package itself can be called: `bench.run(task="completion", renderer="dist")` makes a run."""

import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any


class _Runner(ModuleType):
    """This package as a function, since `bench.run` names both."""

    def __call__(self, overrides: Sequence[str] = (), **choices: Any) -> Any:
        """The record of a run; see `bench.run.library.run_once`."""
        from bench.run.library import run_once

        return run_once(overrides, choices)


sys.modules[__name__].__class__ = _Runner
