"""The runs of the crossing: errors of every renderer under every loss of the mask."""

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    Record,
    Row,
    by_shape,
    grouped,
    median_of_known,
    row_of,
    setting,
    value_evaluations,
)
from bench.report.data.statistics import geometric_mean
from bench.report.data.subjects.completions import Completions
from bench.report.data.subjects.wins import Gap, gap

CROSSING = Selection("crossing", ("completion",), ("dataset", "task", "silhouette"), ("points",))
OWN = {  # the loss of each renderer's paper; the naive one and newton have that of DIST
    "renderers.DIST": "Hinge",
    "renderers.IDR": "CrossEntropy",
    "renderers.DVR": "Occupancy",
    "renderers.Naive": "Hinge",
    "renderers.Newton": "Hinge",
}
LOSSES = (
    "Losses have the numbers of conf/losses: DIST's weight 1, IDR's 100 and sharpness 50, as printed, and DVR's 3, "
    "chosen on validation shapes; `+experiment=tuning` gives every method its own. DVR's loss puts the points of "
    "L_occupancy (Eq. 15) at random depths, where its paper has the given depth (`occupied_at`).",
)
Setting = tuple[str, str]  # renderer, by its preset; loss, by its class


class Crossed:
    """The completions of an experiment, whose rows are settings.

    Args:
        runs: their errors.
        rows: the row of each setting.
        labels: the names of renderers and losses for readers.
        own: the loss of each renderer's paper, where it is known.
    """

    def __init__(self, experiment: Experiment):
        self.runs = Completions(experiment)
        self._records = grouped(experiment.records, _setting_of)
        self.rows: dict[Setting, Row] = {key: row_of(records[0]) for key, records in self._records.items()}
        self.labels: dict[str, str] = {}
        self.own: dict[str, str] = {}
        for (renderer, loss), (first, *_) in self._records.items():
            for name, part in ((renderer, "renderer"), (loss, "silhouette")):
                self.labels[name] = str(setting(first["config"], part, "_label_") or name)
            if own := OWN.get(str(setting(first["config"], "renderer", "_target_"))):
                self.own[renderer] = own
        self.renderers, self.losses = (list(dict.fromkeys(key[i] for key in self.rows)) for i in (0, 1))

    def cost(self, key: Setting) -> float | None:
        """The median number of field values of a setting's runs that ended ok."""
        return median_of_known(value_evaluations(record) for record in self._records[key] if record["status"] == "ok")

    def gap(self, name: str, first: tuple[Setting, ...], second: tuple[Setting, ...]) -> Gap | None:
        """The gap between two groups of settings in a family, each by the geometric mean of its settings' errors.

        On the shapes and seeds that all of them have; None where there is none.
        """
        if not {*first, *second} <= {*self.rows}:
            return None
        tables = {key: self.runs.over_points(name, self.rows[key], finite=True) for key in (*first, *second)}
        common = [run for run in tables[first[0]] if all(run in table for table in tables.values())]
        means = (
            {run: geometric_mean([tables[key][run] for key in keys]) for run in common} for keys in (first, second)
        )
        return gap(*map(by_shape, means))


def _setting_of(record: Record) -> Setting:
    return record["renderer"], str(setting(record["config"], "silhouette", "_target_") or "").rpartition(".")[2]
