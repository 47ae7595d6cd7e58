"""The runs that a study reads: the newest run of each cell of its experiment, as records and as a typed table."""

from collections import Counter
from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from bench.records.metrics import HIGHER, LOWER, Metric, better_direction
from bench.records.record import flat, requested, row_name, started
from bench.report.data.frame import to_frame
from bench.report.data.kept import FROM_RUNS_CSV, UNMEASURED
from bench.report.data.records import (
    CHAMFER_SCALE,
    Record,
    Row,
    doubtful,
    family,
    grouped,
    index,
    row_of,
    setting,
    shape,
    solid,
    view,
)
from bench.tables import nearest

MACHINE_KEYS = ("cpu", "device", "threads")
MEASUREMENT_METRICS = {  # for tasks that measure without optimising
    "forward_seconds": Metric("forward (s)", better=LOWER),
    "step_seconds": Metric("step (s)", better=LOWER),
    "queries": Metric("values of a rendering", better=LOWER),
    "error_p95": Metric("depth error, 95 % (x1000)", 1000.0, LOWER),
    "breakdown": Metric("breaks at"),
    "trials": Metric("trials"),
    "recommended_error": Metric("error of the chosen field (x1000)", 1000.0, LOWER),
    "frontal.code_pooled_cosine": Metric("gradient's cosine, frontal", better=HIGHER),
    "grazing.code_pooled_cosine": Metric("gradient's cosine, grazing", better=HIGHER),
    "silhouette.image_cosine": Metric("cosine at the outline", better=HIGHER),
}
ROW_SECTIONS = ("renderer", "task", "silhouette", "field")  # settings in which rows of equal names may differ


@dataclass(frozen=True)
class Selection:
    """The runs that a study reads."""

    WITHOUT_MACHINE: ClassVar[tuple[str, ...]] = ("scenes", "pixels", "network")  # a setup, of pages without runtimes

    experiment: str
    conditions: tuple[str, ...] = ()  # settings in which runs of one row differ, such as task.points or split
    setup: tuple[str, ...] = (*WITHOUT_MACHINE, "machine")  # parts of the setup that captions name if they are known
    alike: tuple[str, ...] = ()  # parts of the configuration, such as task, that must equal those of the newest run
    must_agree: tuple[str, ...] = ()  # further settings in which rows must agree to be compared, see `Runs.mixed`
    may_differ: tuple[str, ...] = ()  # settings in which rows that are compared may differ


class NoFolder(LookupError):
    """A page needs a file of a run, such as its curve, but the run folder is gone."""


@dataclass(frozen=True)
class Runs:
    """The runs of an experiment in the order of their rows, including failed and planned ones."""

    selection: Selection
    results_dir: Path
    records: list[Record]
    left_out: Counter[str] = field(default_factory=Counter)  # runs at another scale or replaced, by experiment
    renamed: dict[str, list[str]] = field(default_factory=dict)  # left out: rows with other settings
    everything: list[Record] = field(default_factory=list, repr=False)

    @cached_property
    def frame(self) -> pd.DataFrame:
        """The table of `bench.load` for these runs, in the order of `records`, with further columns.

        row, the name of the row in tables; preset, which decides its look; family; solid and view, the numbers of the
        shape and of its view; loop, the seconds of the loop; values, the field evaluations including coarse ones.
        """
        table = to_frame(self.records)
        rows = [row_of(record) for record in self.records]
        coarse = table.evaluations_coarse.fillna(0) if "evaluations_coarse" in table else 0
        missing = pd.Series(pd.NA, table.index, dtype="Float64")
        forward, backward = (table.get(f"seconds_{phase}", missing) for phase in ("forward", "backward"))
        return table.assign(
            row=[row.name for row in rows],
            preset=[row.preset for row in rows],
            family=[family(record) for record in self.records],
            solid=[str(solid(record)[1]) for record in self.records],
            view=[view(record) for record in self.records],
            loop=(forward + backward).astype(float),
            values=(table.get("evaluations_value", missing) + coarse).astype(float),
        )

    def error(self, metric: str, scale: float = CHAMFER_SCALE) -> pd.Series:
        """A metric of each run, times `scale`; infinite if the run did not end ok or lacks the metric."""
        ok = (self.frame.status == "ok").to_numpy(bool)
        return self.number(metric).where(ok, np.inf).fillna(np.inf) * scale

    def number(self, column: str, *, optional: bool = False) -> pd.Series:
        """A column as floats; nan for missing values and text. Raises ValueError if no run has it, unless optional."""
        if not optional:
            self.check_metric(column)
        values = self.frame[column] if column in self.frame else pd.Series(np.nan, self.frame.index)
        return pd.to_numeric(values.astype(object).where(values.notna(), np.nan), errors="coerce").astype(float)

    def check_metric(self, name: str) -> None:
        """Raises ValueError if runs have metrics, but none of this name, and the name is no metric of this project."""
        names = list(dict.fromkeys(key for run in self.records for key in run["metrics"]))
        if names and name not in self.frame and not better_direction(name) and name not in MEASUREMENT_METRICS:
            is_setting, key = name.startswith("config."), name.removeprefix("config.")
            if is_setting:
                names = [column.removeprefix("config.") for column in self.frame if column.startswith("config.")]
            kind = "setting" if is_setting else "metric"
            raise ValueError(
                f"no run of the experiment {self.selection.experiment} has a {kind} {key!r}{nearest(key, names)}"
            )

    @property
    def timed(self) -> bool:
        """Whether the times of most runs are reliable; if not, charts show field evaluations only."""
        return 2 * sum(map(doubtful, self.records)) < len(self.records)

    def setting(self, key: str) -> pd.Series:
        """A setting of each run as text, such as task.points; empty if it is missing."""
        column = self.frame.get(f"config.{key}")
        return pd.Series("", self.frame.index) if column is None else column.astype("string").fillna("").astype(object)

    def where(self, kept: pd.Series) -> "Runs":
        """The runs for which `kept` is true. The others do not count as left out."""
        return replace(self, records=[record for record, keep in zip(self.records, kept, strict=True) if keep])

    @property
    def executed(self) -> "Runs":
        """The runs that are not just planned, killed or refused, as these are no failures; all runs without others."""
        executed = ~self.frame.status.isin(UNMEASURED)
        return self.where(executed) if executed.any() else self

    def other(self, selection: Selection) -> "Runs | None":
        return choose(self.everything, selection, self.results_dir)

    def folder(self, record: Record) -> Path:
        """The run folder of a record; raises NoFolder if it was read from a shipped file."""
        if FROM_RUNS_CSV in record:
            raise NoFolder(record["folder"])
        return self.results_dir / "runs" / record["folder"]

    def requested(self) -> dict[str, Any]:
        return self.records[0]["config"]

    def rows(self) -> dict[Row, list[Record]]:
        return grouped(self.records, row_of)

    def families(self) -> dict[str, list[Record]]:
        return grouped(self.records, family)

    def named(self) -> list[Record]:
        return [{**record, "name": name} for record, name in zip(self.records, self.names(), strict=True)]

    def names(self) -> list[str]:
        """A readable name of each run: its row, its conditions, and family, seed and shape if they vary."""
        getters = {"": family, "seed ": itemgetter("seed"), "shape ": index}
        varying = [(word, get) for word, get in getters.items() if len({str(get(run)) for run in self.records}) > 1]
        names = []
        fixed = self._fixed_by_labels()
        for record in self.records:
            keys = [key for key in self.selection.conditions if key not in fixed]
            values = {key: setting(record["config"], *key.split(".")) for key in keys}
            shown = {key.rpartition(".")[2]: value for key, value in values.items()}
            conditions = [f"{value} {key}" for key, value in shown.items() if isinstance(value, str | int | float)]
            names.append(", ".join([row_of(record).name, *conditions, *(f"{w}{get(record)}" for w, get in varying)]))
        return names

    def _fixed_by_labels(self) -> set[str]:
        """The conditions that differ between rows and not within one, if all runs have labels, which then name them."""
        if not all(record["config"].get("label") for record in self.records):
            return set()
        values = {
            key: [{str(setting(run["config"], *key.split("."))) for run in row} for row in self.rows().values()]
            for key in self.selection.conditions
        }
        return {
            key
            for key, of_rows in values.items()
            if all(len(of_row) == 1 for of_row in of_rows) and len(set[str]().union(*of_rows)) > 1
        }

    def machines(self) -> dict[tuple[Any, ...], list[str]]:
        """The names of the runs by machine: processor, accelerator, threads, and whether kernels are compiled."""

        def machine_of(record: Record) -> tuple[Any, ...]:
            environment = record["environment"]
            return (*(environment.get(key) for key in MACHINE_KEYS), environment.get("kernels") == "compiled")

        machines = grouped([record for record in self.named() if record["environment"].get("cpu")], machine_of)
        return {machine: [record["name"] for record in records] for machine, records in machines.items()}

    def mixed(self) -> list[str]:
        """The settings in which rows differ, so that they do not compare, as the selection extends or limits them.

        These are view and evaluation in an experiment, and prior and field in a family.
        """
        experiments = grouped(self.records, lambda record: record["config"].get("experiment")).values()
        comparisons = [(records, ("view", "evaluation")) for records in experiments]
        families = (records for group in experiments for records in grouped(group, family).values())
        comparisons += [(records, ("prior", "field")) for records in families]
        differing, ignored = dict[str, None](), {*self.selection.conditions, *self.selection.may_differ}
        for records, sections in comparisons:
            configs = [flat({key: record["config"].get(key) for key in sections}, "") for record in records]
            keys = dict.fromkeys(key for config in configs for key in config if key not in ignored)
            texts = {key: {str(config[key]) for config in configs if key in config} for key in keys}
            differing |= {key: None for key in keys if len(texts[key]) > 1}
        differing |= {key: None for key in self.selection.must_agree if self.setting(key).nunique() > 1}
        return list(differing)

    def of_newest_scene(self) -> "Runs":
        """The runs with the seed and the shape of the run that was requested last."""
        newest = max(self.records, key=requested)
        kept = [r for r in self.records if (r["seed"], index(r)) == (newest["seed"], index(newest))]
        return self.only(kept)

    def only(self, kept: list[Record]) -> "Runs":
        others = Counter({self.selection.experiment: len(self.records) - len(kept)})
        return replace(self, records=kept, left_out=self.left_out + others)


def choose(records: list[Record], selection: Selection, results_dir: Path) -> Runs | None:
    """The newest run of each cell of an experiment, at the scale of the run requested last; None without runs.

    Runs at scale=smoke are read only if there are no others, since their numbers mean nothing.
    A cell is a row, task, split, draw, shape, view, seed and the conditions of the selection. Of a row, only runs with
    the settings requested last are read, so that no average mixes settings. On one scene nothing is averaged: there,
    rows of one name are distinguished by the settings of their renderers. Rows are in the order of their first start.
    """
    candidates = sorted((r for r in records if r["config"].get("experiment") == selection.experiment), key=started)
    if not candidates:
        return None
    shared = [key for key in ("scale.name", "split", *selection.alike) if key not in selection.conditions]
    newest = max(candidates, key=lambda run: (setting(run["config"], "scale", "name") != "smoke", requested(run)))
    wanted = [_without_conditions(newest, key, selection) for key in shared]
    same_scale = [run for run in candidates if [_without_conditions(run, key, selection) for key in shared] == wanted]
    chosen = same_scale
    if "dataset" not in selection.alike:
        newest = {_row_key(run): _row_settings(run, selection) for run in sorted(chosen, key=requested)}
        chosen = [record for record in chosen if _row_settings(record, selection) == newest[_row_key(record)]]
    cells: dict[Hashable, Record] = {}
    for record in chosen:  # a cell keeps the position of its first record, with the content of the newest
        cells[_cell_key(record, selection)] = record
    left_out = Counter({selection.experiment: len(candidates) - len(cells)})
    renamed = _renamed(same_scale, list(cells.values()), selection)
    return Runs(selection, results_dir, named_rows(list(cells.values())), +left_out, renamed, records)


def merge_runs(*runs_or_none: Runs | None) -> Runs:
    """The runs of several experiments as one object, for a common caption."""
    present = [runs for runs in runs_or_none if runs is not None]
    records = sorted((record for runs in present for record in runs.records), key=started)
    left_out = sum((runs.left_out for runs in present), Counter())
    renamed = {row: keys for runs in present for row, keys in runs.renamed.items()}
    return replace(present[0], records=records, left_out=left_out, renamed=renamed)


def shared_loss(records: list[Record]) -> str:
    """The label of the silhouette loss that all records share; empty if they differ or use their renderer's loss."""
    labels = {setting(record["config"], "silhouette", "_label_") or "" for record in records}
    return str(labels.pop()) if len(labels) == 1 else ""


def named_rows(records: list[Record]) -> list[Record]:
    """The records with the names of their rows as `row`.

    A silhouette loss that all records share is left out, since captions name it. Rows of one name get the settings of
    the renderer in which they differ, and their presets if these differ.
    """
    shared = {"silhouette": {}} if shared_loss(records) else {}
    names = [row_name(record["config"] | shared, record["renderer"]) for record in records]
    presets = [row_of(record).preset for record in records]
    positions_by_row = grouped(range(len(records)), lambda position: (names[position], presets[position]))
    for positions in positions_by_row.values():
        settings = {position: renderer_settings(records[position]) for position in positions}
        keys = dict.fromkeys(key for values in settings.values() for key in values)
        differ = [key for key in keys if len({values.get(key) for values in settings.values()}) > 1]
        for position, row_settings in settings.items():
            differences = [f"{key.strip('_')} {row_settings[key]}" for key in differ if key in row_settings]
            names[position] += f" ({', '.join(differences)})" if differences else ""
    presets_by_name = grouped(zip(names, presets, strict=True), lambda pair: pair[0])
    ambiguous = {name for name, pairs in presets_by_name.items() if len({*pairs}) > 1}
    names = [f"{name}, {preset}" if name in ambiguous else name for name, preset in zip(names, presets, strict=True)]
    return [record | {"row": name} for record, name in zip(records, names, strict=True)]


def renderer_settings(record: Record) -> dict[str, str]:
    """The settings of the record's renderer as text; empty for a draw, as its row covers all drawn settings."""
    if record["config"].get("draw") is not None:
        return {}
    return {str(key): str(value) for key, value in (record["config"].get("renderer") or {}).items()}


def _without_conditions(record: Record, key: str, selection: Selection) -> Any:
    node = setting(record["config"], *key.split("."))
    if not isinstance(node, dict) or not any(condition.startswith(f"{key}.") for condition in selection.conditions):
        return node
    names = [name for name in node if f"{key}.{name}" not in selection.conditions]
    return {name: _without_conditions(record, f"{key}.{name}", selection) for name in names}


def _renamed(runs: Iterable[Record], kept: list[Record], selection: Selection) -> dict[str, list[str]]:
    """The rows of which runs with other settings than those of a kept run are left out, with the keys that differ."""
    newest, kept_ids = {(_row_key(run), shape(run)): run for run in kept}, {run["id"] for run in kept}
    renamed: dict[str, list[str]] = {}
    for run in runs:
        other = newest.get((_row_key(run), shape(run)))
        if run["id"] not in kept_ids and other is not None:
            settings, others = (flat({key: r["config"].get(key) for key in ROW_SECTIONS}) for r in (run, other))
            keys = [key for key in settings if key in others and str(settings[key]) != str(others[key])]
            differing = [key for key in keys if key not in selection.conditions and not key.endswith("seed")]
            renamed |= {row_of(run).name: differing} if differing else {}
    return renamed


def _row_key(record: Record) -> Hashable:
    """The key of runs that must share their settings: a row in a task, and a draw of a search space."""
    return row_of(record), record["task"], record["config"].get("draw")


def _row_settings(record: Record, selection: Selection) -> Any:
    """The settings of a row: renderer, task and silhouette loss without conditions, and the resolution."""
    settings = [_without_conditions(record, key, selection) for key in ("renderer", "task", "silhouette")]
    resolution = None if "view.resolution" in selection.conditions else setting(record["config"], "view", "resolution")
    return [*settings, resolution]


def _cell_key(record: Record, selection: Selection) -> Hashable:
    """The key of a cell. A condition that is a node, such as a stress, is part of the shape's family already."""
    values = (setting(record["config"], *key.split(".")) for key in (*selection.conditions, "split"))
    conditions = (str(value) for value in values if not isinstance(value, dict))
    settings = str(sorted(renderer_settings(record).items()))
    return (*_row_key(record), settings, *solid(record), view(record), record["seed"], *conditions)
