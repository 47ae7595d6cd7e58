"""Selects the records of an experiment: the newest, and those that can be compared with it, in rows."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from operator import itemgetter
from pathlib import Path
from typing import Any

from bench.records.record import NEUTRAL_KEYS, requested, row_name, started
from bench.report.data.records import Record, Row, family, grouped, index, row_of, setting

seed = itemgetter("seed")
# Keys of a configuration in which the rows of every experiment may differ.
ROW_KEYS = {"renderer", "method", "label", "seed", "index"}
NOT_SHARED = {*ROW_KEYS, *NEUTRAL_KEYS, "packages"}
MACHINE = ("cpu", "device", "threads")


@dataclass(frozen=True)
class Selection:
    """The runs that a page reads, and the settings in which they differ.

    Args:
        experiment: name of the experiment in the runs' configurations.
        tasks: tasks of the runs.
        varies: keys of the configuration, in addition to `ROW_KEYS`, in which the runs differ.
        cell: settings of the task in which runs of one row differ.
        setup: parts of the setup that captions name, where they are known.
        splits: whether runs of one task on several splits are read together.
    """

    experiment: str
    tasks: tuple[str, ...]
    varies: tuple[str, ...] = ()
    cell: tuple[str, ...] = ()
    setup: tuple[str, ...] = ("scenes", "pixels", "network", "machine")
    splits: bool = False


@dataclass(frozen=True)
class Experiment:
    """The comparable records of an experiment, one per row and run, in the order of their rows.

    `left_out` is the number of records of the same experiment that cannot be compared with these.
    """

    selection: Selection
    results_dir: Path
    records: list[Record]
    left_out: int = 0
    everything: list[Record] = field(default_factory=list, repr=False)

    def other(self, selection: Selection) -> "Experiment | None":
        """Another experiment of the same results folder."""
        return choose(self.everything, selection, self.results_dir)

    def folder(self, record: Record) -> Path:
        """The record's run folder."""
        return self.results_dir / "runs" / record["folder"]

    def requested(self) -> dict[str, Any]:
        """The configuration of a run; all runs agree in it except for the settings of their rows."""
        return self.records[0]["config"]

    def rows(self) -> dict[Row, list[Record]]:
        """The records of each row."""
        return grouped(self.records, row_of)

    def families(self) -> dict[str, list[Record]]:
        """The records of each family."""
        return grouped(self.records, family)

    def named(self) -> list[Record]:
        """The records with their readable names under `name`."""
        return [{**record, "name": name} for record, name in zip(self.records, self.names(), strict=True)]

    def names(self) -> list[str]:
        """A readable name for each record: its row's, with family, seed and shape where the records differ in these.

        Rows with the same name but different renderer settings get these settings in their names.
        """
        seeds, shapes, families = ({part(record) for record in self.records} for part in (seed, index, family))
        selection = self.selection
        return [
            row_of(record).name
            + (self._differing_settings(record) if not selection.varies else "")
            + "".join(
                f", {value} {key}"
                for key in selection.cell
                if isinstance(value := setting(record["config"], "task", key), str | int | float)
            )
            + (f", {family(record)}" if len(families) > 1 else "")
            + (f", seed {record['seed']}" if len(seeds) > 1 else "")
            + (f", shape {index(record)}" if len(shapes) > 1 else "")
            for record in self.records
        ]

    def _differing_settings(self, record: Record) -> str:
        """The renderer's settings in which records of the same name differ, in brackets."""
        alike = [_renderer(other) for other in self.records if row_of(other).name == row_of(record).name]
        mine = _renderer(record)
        keys = [key for key in mine if any(other.get(key) != mine[key] for other in alike)]
        settings = [f"{key.strip('_')} {mine[key]}" for key in keys]
        return f" ({', '.join(settings)})" if settings else ""

    def machines(self) -> dict[tuple[Any, ...], list[str]]:
        """The names of the rows by the machine that their times depend on: processor, accelerator, threads."""
        known = [record for record in self.named() if record["environment"]]
        machines = grouped(known, lambda record: tuple(record["environment"].get(key) for key in MACHINE))
        return {machine: [record["name"] for record in records] for machine, records in machines.items()}

    def of_newest_scene(self) -> "Experiment":
        """The experiment with only those records that have the seed and the shape of the one requested last."""
        newest = max(self.records, key=requested)
        kept = [r for r in self.records if (seed(r), index(r)) == (seed(newest), index(newest))]
        return replace(self, records=kept, left_out=self.left_out + len(self.records) - len(kept))


def choose(records: list[Record], selection: Selection, results_dir: Path) -> Experiment | None:
    """The record that was requested last and those that can be compared with it; None without a record.

    These share all of the configuration except `NOT_SHARED` and the keys that the experiment varies; runs of one task
    also share the split and the camera. Rows are in the order in which they started; of a run that was made more than
    once the newest record counts. Where an experiment varies more than its rows, a row keeps only the setting that was
    requested last, since different settings under one name would become one row. Rows can come from different machines,
    which a note says.
    """
    found = [
        r for r in records if r["config"].get("experiment") == selection.experiment and r["task"] in selection.tasks
    ]
    if not found:
        return None
    found.sort(key=started)
    same = _like_newest(found, lambda record: _shared(record, selection))
    if selection.varies:
        by_task = [[r for r in same if r["task"] == task] for task in selection.tasks]
        same = [r for runs in by_task for r in _like_newest(runs, lambda record: _seen(record, selection))]
        newest = {_row(r): r for r in sorted(same, key=requested)}
        same = [r for r in same if _variant(r, selection) == _variant(newest[_row(r)], selection)]
        same.sort(key=started)
    rows: dict[Hashable, Record] = {}
    for record in same:
        rows[_key(record, selection)] = record  # keeps the place of the first record, with the content of the newest
    return Experiment(selection, results_dir, named_by_rows(list(rows.values())), len(found) - len(same), records)


def together(*experiments: Experiment | None) -> Experiment:
    """The records of several experiments as one experiment, for a common caption."""
    known = [experiment for experiment in experiments if experiment is not None]
    records = sorted((record for experiment in known for record in experiment.records), key=started)
    return replace(known[0], records=records, left_out=sum(experiment.left_out for experiment in known))


def shared_loss(records: list[Record]) -> str:
    """The label of the mask loss that all records have; empty where they differ, or have their renderers' own."""
    labels = {setting(record["config"], "silhouette", "_label_") or "" for record in records}
    return str(labels.pop()) if len(labels) == 1 else ""


def named_by_rows(records: list[Record]) -> list[Record]:
    """The records with the names of their rows under `row`, without a mask loss that all share: captions name it."""
    if not shared_loss(records):
        return records
    return [record | {"row": row_name(record["config"] | {"silhouette": {}}, record["renderer"])} for record in records]


def _like_newest(records: list[Record], part: Callable[[Record], Any]) -> list[Record]:
    """The records that agree, in the given part, with the one that was requested last."""
    if not records:
        return []
    newest = part(max(records, key=requested))
    return [record for record in records if part(record) == newest]


def _row(record: Record) -> Hashable:
    """What has one setting: a row, in a task, and of a search space a draw."""
    return row_of(record), record["task"], record["config"].get("draw")


def _key(record: Record, selection: Selection) -> Hashable:
    """The key that identifies a run within its experiment."""
    key = (*_row(record), seed(record), index(record), str(sorted(_renderer(record).items())))
    key += (record["config"].get("split"),)
    cell = (str(setting(record["config"], "task", name)) for name in selection.cell)
    return (*key, family(record), *cell) if selection.varies else key


def _seen(record: Record, selection: Selection) -> tuple[Any, Any]:
    """The split, unless several are read together, and the camera without its resolution, a setting of a row."""
    view = record["config"].get("view") or {}
    split = None if selection.splits else record["config"].get("split")
    return split, {key: value for key, value in view.items() if key != "resolution"}


def _variant(record: Record, selection: Selection) -> Any:
    """All settings of a row: the renderer's, the task's without those that vary within a row, and the resolution."""
    resolution = setting(record["config"], "view", "resolution")
    return _renderer(record), _task(record["config"].get("task") or {}, selection), resolution


def _renderer(record: Record) -> dict[str, str]:
    """The settings of the record's renderer, as text."""
    return {str(key): str(value) for key, value in (record["config"].get("renderer") or {}).items()}


def _task(task: dict[str, Any], selection: Selection) -> dict[str, Any]:
    return {key: value for key, value in task.items() if key not in selection.cell}


def _shared(record: Record, selection: Selection) -> dict[str, Any]:
    shared = {key: value for key, value in record["config"].items() if key not in {*NOT_SHARED, *selection.varies}}
    if isinstance(shared.get("task"), dict):
        shared["task"] = _task(shared["task"], selection)
    return shared
