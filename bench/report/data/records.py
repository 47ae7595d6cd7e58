"""Reads values from a record: its row, shape, numbers and settings; and groups runs by shape."""

import math
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bench.records.record import as_number, row_name

CHAMFER_SCALE = 1000.0  # of Chamfer distances, in tables and figures
ONE_WAY = "chamfer_gt_to_pred"  # the metric of shape from many views
SHAPENET = "shapenet_"  # beginning of the families of `dataset=shapenet`; the class follows
DOUBTFUL = ("loaded machine", "shared device", "missing synchronisation")  # beginnings of notes on times
OURS = "renderers."  # beginning of the targets of this project's renderers
Record = dict[str, Any]
RunKey = tuple[Any, ...]  # solid, view, seed, and further conditions, such as the number of points
Item, Key = TypeVar("Item"), TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Row:
    """The row of a table to which a run belongs: a preset, which decides colours and published numbers, and a name.

    Args:
        preset: the chosen method, or else the renderer.
        name: the run's label, or else the renderer's label, or else the renderer's file; with its loss of the mask,
            where an experiment's rows differ in that.
    """

    preset: str
    name: str


def row_of(record: Record) -> Row:
    config = record["config"]
    name = str(record.get("row") or row_name(config, record["renderer"]))
    return Row(record.get("method") or record["renderer"], name)


def base_renderer(record: Record) -> str:
    """The renderer of which a preset is a variant: its class in lower case; for a user's class, its preset."""
    target = str(setting(record["config"], "renderer", "_target_") or "")
    return target.rpartition(".")[2].lower() if target.startswith(OURS) else record["renderer"]


def family(record: Record) -> str:
    """The name of the record's dataset: the family, a class of ShapeNet, or the end of the path of meshes."""
    path, synset = (setting(record["config"], "dataset", key) for key in ("path", "synset"))
    if synset:
        return f"{SHAPENET}{synset}"
    return "/".join(Path(str(path)).absolute().parts[-2:]) if path else record["dataset"]


def iterations_of(record: Record) -> int | None:
    """The number of the optimiser's iterations, which a task without an optimiser has among its own settings."""
    config = record["config"]
    return setting(config, "task", "optimiser", "iterations") or setting(config, "task", "iterations")


def doubtful(record: Record) -> bool:
    """Whether other work on the machine or device, or a missing synchronisation, makes the run's times doubtful."""
    return any(note.startswith(DOUBTFUL) for note in record["notes"])


def index(record: Record) -> Any:
    """The number of the shape in its family."""
    return record["config"].get("index")


def measured(record: Record, name: str) -> int | float | None:
    """The metric of that name; None where there is no such number."""
    return as_number(record["metrics"].get(name))


def error(record: Record, name: str) -> float:
    """The metric of that name as the run's error: infinite where the run did not end ok, or has no such number."""
    value = measured(record, name) if record["status"] == "ok" else None
    return math.inf if value is None or math.isnan(value) else value


def loop_seconds(record: Record) -> float | None:
    """The seconds in the optimisation loop; None where the record does not have them. A restored row has their sum."""
    spent = [record["seconds"].get(name) for name in ("forward", "backward")]
    return record["seconds"].get("loop") if None in spent else sum(spent)


def value_evaluations(record: Record) -> float | None:
    """The number of field values computed in the loop, coarse ones included; None where the record does not have it."""
    value = record["evaluations"].get("value")
    return None if value is None else value + record["evaluations"].get("coarse", 0)


def median_or_none(values: Iterable[float | None]) -> float | None:
    """The median of the values that are known; None where there is none."""
    numbers = [value for value in values if value is not None]
    return float(np.median(numbers)) if numbers else None


def setting(config: dict[str, Any], *path: str) -> Any:
    """The value of a configuration under nested keys; None where a key is missing."""
    node: Any = config
    for key in path:
        node = node.get(key) if isinstance(node, dict) else None
    return node


def shared_settings(records: list[Record], names: dict[str, tuple[str, ...]]) -> str:
    """A note on which settings all records share, and in which they differ; empty where no record has any.

    Args:
        names: the path of each setting in a configuration, by the name that the note has for it.
    """
    values = {
        name: {str(value): value for record in records if (value := setting(record["config"], *path)) is not None}
        for name, path in names.items()
    }
    shared = [f"{name} {next(iter(each))}" for name, each in values.items() if len(each) == 1]
    differ = [f"{name} ({', '.join(_ordered(each.values()))})" for name, each in values.items() if len(each) > 1]
    parts = [("Rows share: ", shared), ("Rows differ in: ", differ)]
    return " ".join(f"{word}{', '.join(listed)}." for word, listed in parts if listed)


def _ordered(values: Iterable[Any]) -> list[str]:
    """Values as text, numbers by their size and before words."""
    return [str(value) for value in sorted(values, key=lambda x: (1, str(x)) if as_number(x) is None else (0, x))]


def shape(record: Record) -> tuple[str, Any]:
    """The shape of a run: its family and its number there."""
    return family(record), index(record)


def solid(record: Record) -> tuple[str, Any]:
    """The shape of a run, one for all numbers of a mesh file that is not deformed: these are its views."""
    return family(record), None if _is_view(record) else index(record)


def view(record: Record) -> Any:
    """The number of the view of a mesh file that is not deformed; 0 for others, whose shapes have a view each."""
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
    """The numbers of runs as an array per shape, with an entry per seed; where shapes have views, as a list of these.

    Runs with equal solid and view are of one array, whatever else their keys have.
    """
    shapes = [grouped(runs, lambda run: run[1]).values() for runs in grouped(values, lambda run: run[0]).values()]
    arrays = [[np.array([values[run] for run in runs]) for runs in views] for views in shapes]
    return arrays if any(len(views) > 1 for views in arrays) else [views for (views,) in arrays]


def definition(texts_by_names: dict[str, Any], name: str) -> Any:
    """The definition of a metric; empty where there is none.

    A key is a list of names, such as "lost, false". It is also that of another band's metric of that name, such as
    "frontal.code_cosine", and of names that begin so: "saved_..." and "depth_error" of depth_error_p99.
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
    """A line with the headings and the definition of each metric that is shown; `names` has the heading by metric."""
    lines: dict[str, list[str]] = {}
    for name, heading in names.items():
        text = next(filter(None, (str(definition(record["definitions"], name)) for record in records)), "")
        lines.setdefault(text, []).append(heading)
    return [f"{', '.join(dict.fromkeys(headings))}: {text}" for text, headings in lines.items() if text]


def repeated(records: list[Record]) -> str:
    """The number of repeats of the times, as text, such as 3, 1 or 3, 1 to 3; empty where no record has it."""
    times = sorted({int(n) for record in records if (n := measured(record, "repeats")) is not None})
    return " or ".join(map(str, times)) if len(times) < 3 else f"{times[0]} to {times[-1]}"
