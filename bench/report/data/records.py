"""Reads values from a record: its row, shape, numbers and settings; and groups runs by shape."""

import math
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bench.records.record import as_number, row_name

CHAMFER_SCALE = 1000.0  # tables and figures show Chamfer distances times this
ONE_WAY = "chamfer_gt_to_pred"  # the error of shape from many views
SHAPENET = "shapenet_"  # before the class, in the families of `dataset=shapenet`
DOUBTFUL = ("loaded machine", "shared device", "missing synchronisation")  # notes on times begin so
OURS = "renderers."  # the targets of this project's renderers begin so
Record = dict[str, Any]
RunKey = tuple[Any, ...]  # solid, view, seed, and further conditions, such as the number of points
Item, Key = TypeVar("Item"), TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Row:
    """The row of a table to which a run belongs."""

    preset: str  # the method, or else the renderer; it decides colours and published numbers
    name: str  # its label, or that of the renderer; with the silhouette loss if the rows of an experiment differ in it


def row_of(record: Record) -> Row:
    config = record["config"]
    name = str(record.get("row") or row_name(config, record["renderer"]))
    return Row(record.get("method") or record["renderer"], name)


def base_renderer(record: Record) -> str:
    """The class of the renderer in lower case; for a user's class, the preset."""
    target = str(setting(record["config"], "renderer", "_target_") or "")
    return target.rpartition(".")[2].lower() if target.startswith(OURS) else record["renderer"]


def family(record: Record) -> str:
    """The name of the record's data set: the family, a class of ShapeNet, or the end of the path of meshes."""
    path, synset = (setting(record["config"], "dataset", key) for key in ("path", "synset"))
    if synset:
        return f"{SHAPENET}{synset}"
    return "/".join(Path(str(path)).absolute().parts[-2:]) if path else record["dataset"]


def iterations_of(record: Record) -> int | None:
    """The number of iterations: of the optimiser, or of a task without one."""
    config = record["config"]
    return setting(config, "task", "optimiser", "iterations") or setting(config, "task", "iterations")


def doubtful(record: Record) -> bool:
    """Whether other work on the machine or device, or a missing synchronisation, makes the run's times doubtful."""
    return any(note.startswith(DOUBTFUL) for note in record["notes"])


def index(record: Record) -> Any:
    return record["config"].get("index")


def measured(record: Record, name: str) -> int | float | None:
    """The metric of that name; None if it is missing or no number."""
    return as_number(record["metrics"].get(name))


def error(record: Record, name: str) -> float:
    """The metric of that name as the run's error; infinite if the run did not end ok or has no such number."""
    value = measured(record, name) if record["status"] == "ok" else None
    return math.inf if value is None or math.isnan(value) else value


def loop_seconds(record: Record) -> float | None:
    spent = [record["seconds"].get(name) for name in ("forward", "backward")]
    return None if None in spent else sum(spent)


def value_evaluations(record: Record) -> float | None:
    """The number of field evaluations in the loop, including coarse ones; None if it is not recorded."""
    value = record["evaluations"].get("value")
    return None if value is None else value + record["evaluations"].get("coarse", 0)


def cost(record: Record) -> float | None:
    """The number of field evaluations in the loop, where a gradient counts as two; None if it is not recorded."""
    return as_number(record["evaluations"].get("cost"))


def median_or_none(values: Iterable[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return float(np.median(numbers)) if numbers else None


def setting(config: dict[str, Any], *path: str) -> Any:
    """The value of a configuration under nested keys; None if a key is missing."""
    node: Any = config
    for key in path:
        node = node.get(key) if isinstance(node, dict) else None
    return node


def shape(record: Record) -> tuple[str, Any]:
    return family(record), index(record)


def solid(record: Record) -> tuple[str, Any]:
    """The shape of a run. All indices of a mesh file without deformation are one shape: they are its views."""
    return family(record), None if _is_view(record) else index(record)


def view(record: Record) -> Any:
    """The view of a mesh file without deformation; 0 for other shapes, which have one view each."""
    return index(record) if _is_view(record) else 0


def _is_view(record: Record) -> bool:
    path, strength = (setting(record["config"], "dataset", key) for key in ("path", "strength"))
    return bool(path) and bool(Path(str(path)).suffix) and strength == 0


def run_key(record: Record) -> RunKey:
    """The shape, the view and the seed, which runs of different rows must share to be compared."""
    return solid(record), view(record), record["seed"]


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """The items of each key, with keys in the order in which they first occur."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def by_shape(values: dict[RunKey, float]) -> list[Any]:
    """One array per shape, with an entry per seed, of the numbers of runs; for shapes with views a list of such arrays.

    Runs with equal solid and view share an array, whatever else their keys have.
    """
    shapes = [grouped(runs, lambda run: run[1]).values() for runs in grouped(values, lambda run: run[0]).values()]
    arrays = [[np.array([values[run] for run in runs]) for runs in views] for views in shapes]
    return arrays if any(len(views) > 1 for views in arrays) else [views for (views,) in arrays]


def definition(texts_by_names: dict[str, Any], name: str) -> Any:
    """The definition of a metric; empty without one.

    A key lists names, such as "lost, false". A name also covers metrics of a band (frontal.code_cosine), and metrics
    that begin with it: "saved_..." covers saved_rays, and "depth_error" covers depth_error_p99.
    """
    keys = [(alias.strip(), words) for key, words in texts_by_names.items() for alias in key.split(",")]
    last = name.rsplit(".", 1)[-1]
    for matches in (
        lambda alias: alias == name,
        lambda alias: alias.endswith("...") and name.startswith(alias[:-3]),
        lambda alias: alias.rsplit(".", 1)[-1] == last,
        lambda alias: last.startswith(f"{alias.rsplit('.', 1)[-1]}_"),
    ):
        for alias, words in keys:
            if matches(alias):
                return words
    return ""


def definitions(records: list[Record], names: dict[str, str]) -> list[str]:
    """A line per definition, with the headings of its metrics; `names` maps each shown metric to its heading."""
    lines: dict[str, list[str]] = {}
    for name, heading in names.items():
        text = next(filter(None, (str(definition(record["definitions"], name)) for record in records)), "")
        lines.setdefault(text, []).append(heading)
    return [f"{', '.join(dict.fromkeys(headings))}: {text}" for text, headings in lines.items() if text]


def repeated(records: list[Record]) -> str:
    """The numbers of repeats of the timing as text, such as 3, 1 or 3, 1 to 3; empty if none is recorded."""
    times = sorted({int(n) for record in records if (n := measured(record, "repeats")) is not None})
    return " or ".join(map(str, times)) if len(times) < 3 else f"{times[0]} to {times[-1]}"
