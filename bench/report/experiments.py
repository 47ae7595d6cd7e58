"""Which records make up an experiment: the newest, those that may be compared with it, and their rows."""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.report.records import NEUTRAL_KEYS, asked, started

ROW_KEYS = {"renderer", "label", "seed", "index"}  # of a configuration: what the rows of every experiment may differ in
NOT_SHARED = {*ROW_KEYS, *NEUTRAL_KEYS, "packages"}


@dataclass(frozen=True)
class Kind:
    """What an experiment is made of.

    Args:
        tasks: of its runs.
        varies: keys of the configuration, beside `ROW_KEYS`, in which its runs differ.
        cell: settings of the task in which runs of one row differ.
    """

    tasks: tuple[str, ...]
    varies: tuple[str, ...] = ()
    cell: tuple[str, ...] = ()


KINDS = {
    "priors": Kind(("prior_fit",), ("dataset",)),
    "table1": Kind(("ablation",)),
    "table2": Kind(("completion", "deepsdf"), ("dataset", "task"), ("points",)),
    "table3": Kind(("multiview",), ("dataset", "task", "view")),
    "fig6": Kind(("pose", "pose_icp"), ("dataset", "task"), ("degrees",)),
    "fig10": Kind(("multiview",), ("dataset", "task"), ("focal", "start_scale")),
    "fig4": Kind(("ablation",)),
    "fig5": Kind(("completion",)),
    "fig7": Kind(("ablation",)),
    "gradients": Kind(("gradients",)),
    "stability": Kind(("stability",), ("stress",), ("stress",)),
    "parsimony": Kind(("capacity",), ("dataset",)),
    "speed_accuracy": Kind(("completion", "ablation"), ("dataset", "task", "view", "split")),
}
MACHINE = ("cpu", "device", "threads")


@dataclass(frozen=True)
class Experiment:
    """The comparable records of an experiment, one a row, in the order of its rows.

    `left_out` counts the records of the same experiment that may not be compared with these.
    """

    name: str
    results_dir: Path
    records: list[dict[str, Any]]
    left_out: int = 0
    everything: list[dict[str, Any]] = field(default_factory=list, repr=False)

    def beside(self, name: str) -> "Experiment | None":
        """Another experiment of the same results folder."""
        return choose(self.everything, name, self.results_dir)

    def folder(self, record: dict[str, Any]) -> Path:
        """The record's run folder."""
        return self.results_dir / "runs" / record["folder"]

    def asked(self) -> dict[str, Any]:
        """A configuration of the experiment; all rows agree on what is not a row's own."""
        return self.records[0]["config"]

    def names(self) -> list[str]:
        """A readable name for each record: its row's, with family, seed and shape where the rows differ in these.

        Rows of the same name whose renderers are set in different ways have those settings in their names.
        """
        seeds, shapes, families = ({part(record) for record in self.records} for part in (_seed, _index, family))
        kind = KINDS[self.name]
        return [
            row_name(record)
            + (self._own_settings(record) if not kind.varies else "")
            + "".join(
                f", {value} {key}"
                for key in kind.cell
                if isinstance(value := setting(record["config"], "task", key), str | int | float)
            )
            + (f", {family(record)}" if len(families) > 1 else "")
            + (f", seed {_seed(record)}" if len(seeds) > 1 else "")
            + (f", shape {_index(record)}" if len(shapes) > 1 else "")
            for record in self.records
        ]

    def _own_settings(self, record: dict[str, Any]) -> str:
        alike = [_renderer(other) for other in self.records if row_name(other) == row_name(record)]
        mine = _renderer(record)
        keys = [key for key in mine if any(other.get(key) != mine[key] for other in alike)]
        told = [f"{key.strip('_')} {mine[key]}" for key in keys]
        return f" ({', '.join(told)})" if told else ""

    def machines(self) -> dict[tuple[Any, ...], list[str]]:
        """The names of the rows by what their times depend on: processor, accelerator, threads."""
        found: dict[tuple[Any, ...], list[str]] = {}
        for name, record in zip(self.names(), self.records, strict=True):
            if record["environment"]:
                found.setdefault(tuple(record["environment"].get(key) for key in MACHINE), []).append(name)
        return found

    def of_newest_scene(self) -> "Experiment":
        """The same, with only those rows that have the seed and the shape of the row that was asked for last."""
        newest = max(self.records, key=asked)
        kept = [r for r in self.records if (_seed(r), _index(r)) == (_seed(newest), _index(newest))]
        return replace(self, records=kept, left_out=self.left_out + len(self.records) - len(kept))


def choose(records: list[dict[str, Any]], name: str, results_dir: Path) -> Experiment | None:
    """The record that was asked for last and those that may be compared with it; None without a record.

    These share all of the configuration but for `NOT_SHARED` and what the experiment varies; runs of one task share the
    split and the camera, too. Rows stand in the order in which they started; a run that was made more than once is its
    newest record. Where an experiment varies more than its rows, a row is of one setting, the one asked for last: two
    settings under one label would be one row otherwise. The rows may be of different machines: captions say so.
    """
    kind = KINDS[name]
    found = [r for r in records if r["config"].get("experiment") == name and r["task"] in kind.tasks]
    if not found:
        return None
    found.sort(key=started)
    same = _like_newest(found, lambda record: _shared(record, kind))
    if kind.varies:
        by_task = [[r for r in same if r["task"] == task] for task in kind.tasks]
        same = [r for own in by_task for r in _like_newest(own, _seen)]
        named = {(row_name(r), r["task"]): r for r in sorted(same, key=asked)}
        same = [r for r in same if _variant(r, kind) == _variant(named[row_name(r), r["task"]], kind)]
        same.sort(key=started)
    rows: dict[Hashable, dict[str, Any]] = {}
    for record in same:
        rows[_key(record, kind)] = record  # takes the place of the first, with the content of the newest
    return Experiment(name, results_dir, list(rows.values()), len(found) - len(same), records)


def row_name(record: dict[str, Any]) -> str:
    """The name of the record's row: its label, or else its renderer's name."""
    return str(record["config"].get("label") or record["renderer"])


def family(record: dict[str, Any]) -> str:
    """The name of the record's dataset: a family's, or the end of the path of a mesh file or folder."""
    path = setting(record["config"], "dataset", "path")
    return "/".join(Path(path).absolute().parts[-2:]) if path else record["dataset"]


def measured(record: dict[str, Any], name: str) -> int | float | None:
    """The metric of that name; None where there is no such number."""
    value = record["metrics"].get(name)
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def loop_seconds(record: dict[str, Any]) -> float | None:
    """The time in the loop; None where the record does not have it."""
    spent = [record["seconds"].get(name) for name in ("forward", "backward")]
    return None if None in spent else sum(spent)


def value_evaluations(record: dict[str, Any]) -> float | None:
    """The field values that were computed in the loop; None where the record does not say."""
    return record["evaluations"].get("value")


def median_of_known(values: Iterable[float | None]) -> float | None:
    """The median of the values that are known; None where there is none."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def error(record: dict[str, Any], name: str) -> float:
    """The metric of that name as an error of the run: infinite where it did not end ok, or has no such number."""
    value = measured(record, name) if record["status"] == "ok" else None
    return math.inf if value is None or math.isnan(value) else value


def setting(config: dict[str, Any], *path: str) -> Any:
    """The value of a configuration under nested keys; None where a key is missing."""
    node: Any = config
    for key in path:
        node = node.get(key) if isinstance(node, dict) else None
    return node


def identity(record: dict[str, Any]) -> dict[str, Any]:
    """What tells rows apart, and what became of them: the columns that every table of an experiment has."""
    columns = {"row": row_name(record), "renderer": record["renderer"], "seed": _seed(record), "index": _index(record)}
    return {**columns, "status": record["status"], "reason": record["reason"], "folder": record["folder"]}


def definitions(records: list[dict[str, Any]], names: dict[str, str]) -> list[str]:
    """A line for each definition of a metric that is shown, under the headings of its columns.

    Args:
        records: of the experiment. A definition may be of several metrics, such as "lost, false", of all that begin
            alike, such as "depth_error", or of one band's, such as "frontal.code_cosine".
        names: heading by metric.
    """
    lines: dict[str, str] = {}
    for record in records:
        for key, text in record["definitions"].items():
            parts = [part.strip().rsplit(".", 1)[-1] for part in key.split(",")]
            own = [h for name, h in names.items() if any(name == p or name.startswith(f"{p}_") for p in parts)]
            if own:
                lines.setdefault(", ".join(dict.fromkeys(own)), text)
    return [f"{headings}: {text}" for headings, text in lines.items()]


def repeated(records: list[dict[str, Any]]) -> str:
    """How often the times were taken, in words; empty where no record says so."""
    times = Counter(n for record in records if (n := measured(record, "repeats")) is not None)
    return " or ".join(f"{int(n)}" for n in sorted(times)) if times else ""


def _like_newest(records: list[dict[str, Any]], part: Callable[[dict[str, Any]], Any]) -> list[dict[str, Any]]:
    """The records that are in some part as the one that was asked for last."""
    if not records:
        return []
    newest = part(max(records, key=asked))
    return [record for record in records if part(record) == newest]


def _key(record: dict[str, Any], kind: Kind) -> Hashable:
    """What tells a run from the others of its experiment."""
    return (
        *(row_name(record), _seed(record), _index(record), str(sorted(_renderer(record).items())), record["task"]),
        *((family(record), *(str(setting(record["config"], "task", key)) for key in kind.cell)) if kind.varies else ()),
    )


def _seen(record: dict[str, Any]) -> tuple[Any, Any]:
    """The split and the camera, whose resolution is a setting."""
    view = record["config"].get("view") or {}
    return record["config"].get("split"), {key: value for key, value in view.items() if key != "resolution"}


def _variant(record: dict[str, Any], kind: Kind) -> Any:
    """All settings of a row: its renderer's, its task's but for those that tell its cells apart, and the resolution."""
    task = {key: value for key, value in (record["config"].get("task") or {}).items() if key not in kind.cell}
    return _renderer(record), task, setting(record["config"], "view", "resolution")


def _renderer(record: dict[str, Any]) -> dict[str, str]:
    """The settings of the record's renderer, as words."""
    return {str(key): str(value) for key, value in (record["config"].get("renderer") or {}).items()}


def _seed(record: dict[str, Any]) -> Any:
    return record["seed"]


def _index(record: dict[str, Any]) -> Any:
    return record["config"].get("index")


def _shared(record: dict[str, Any], kind: Kind) -> dict[str, Any]:
    shared = {key: value for key, value in record["config"].items() if key not in {*NOT_SHARED, *kind.varies}}
    if isinstance(shared.get("task"), dict):
        shared["task"] = {key: value for key, value in shared["task"].items() if key not in kind.cell}
    return shared
