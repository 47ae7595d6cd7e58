"""Pages of before `bench.studies`, as studies: to go with the last of them."""

import io
import re
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pandas as pd

from bench.report.write.result import Result

PAGES = Path(__file__).parents[1] / "pages"
PLACE = re.compile(r"^PLACE(_[A-Z_]+)? = (\d+)$", re.MULTILINE)


def legacy() -> list[tuple[int, Any, dict[str, Callable[..., Result]]]]:
    """Place, selections and pages of each file."""
    found = []
    for path in sorted(PAGES.rglob("[!_]*.py")):
        module = import_module("bench.report.pages." + ".".join(path.relative_to(PAGES).with_suffix("").parts))
        for suffix, place in PLACE.findall(path.read_text(encoding="utf-8")):
            end = suffix.lower()
            make, answer = getattr(module, f"make{end}"), getattr(module, f"answer{end}", None)
            found.append((int(place), module.READS, {path.stem + end: _answered(make, answer)}))
    return found


def _answered(make: Callable[..., Result], answer: Callable[..., Any] | None) -> Callable[..., Result]:
    def made(*chosen: Any) -> Result:
        result = make(*chosen)
        if answer is None:
            return result
        try:
            found = answer(pd.read_csv(io.StringIO(result.data.to_csv(index=False))), result.shown().notes)
        except (KeyError, ValueError, TypeError, IndexError, AttributeError, ArithmeticError):
            return result
        return replace(result, question=found.question, verdict=found.verdict, chart=found.chart, atlas=found.atlas)

    return made
