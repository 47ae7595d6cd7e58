"""Exports finished runs to experiment trackers; never during a run, and a failed export loses no run."""

import json
import math
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

LISTS = ("metrics", "metrics_start", "evaluations", "seconds")
SINGLE = ("peak_memory_bytes", "flops", "gemm_fraction")


@runtime_checkable
class Tracker(Protocol):
    """Exports finished runs to an experiment tracker."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Exports a run.

        Args:
            folder: of the run, with its curve and pictures.
            record: as `bench.records.record.read_record` gives it.
        """
        ...


class Nothing:
    """The tracker that exports nothing."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Does nothing."""


def settings(node: dict[str, Any], prefix: str = "") -> dict[str, str]:
    """A configuration as dotted keys and strings."""
    flat: dict[str, str] = {}
    for key, value in node.items():
        flat |= settings(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": str(value)}
    return flat


def values(record: dict[str, Any]) -> dict[str, float]:
    """All finite numbers of a record, such as `metrics.chamfer_l2`."""
    flat = {f"{part}.{name}": value for part in LISTS for name, value in record[part].items()}
    flat |= {name: record[name] for name in SINGLE}
    return {name: float(value) for name, value in flat.items() if _finite(value)}


def curve(folder: Path) -> list[tuple[int, dict[str, float]]]:
    """The lines of `curve.jsonl` as iteration and finite numbers by name; empty where there is no curve."""
    path = folder / "curve.jsonl"
    if not path.is_file():
        return []
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [
        (
            line["iteration"],
            {name: float(value) for name, value in line.items() if name != "iteration" and _finite(value)},
        )
        for line in lines
    ]


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
