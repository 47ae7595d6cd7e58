"""`python -m bench.tune --into conf/tuned.yaml`: writes each method's best drawn setting as a row of a table.

It reads the runs of `+experiment=tuning`. Of the draws with the fewest failures, the best has the smallest geometric
mean of Chamfer distances on the validation shapes; test shapes are not used. `--experiment tuning_photographs` chooses
settings of reconstruction, by the Chamfer distance of the seen surface. All methods are compared on the same draws,
shapes and seeds: those for which every method has a finished run.
"""

import argparse
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from bench.records.format import number
from bench.records.read import is_plain_name, read_records
from bench.records.record import NEUTRAL_KEYS, flat, write_text
from bench.records.results import RESULTS
from bench.report.data.kept import UNFINISHED
from bench.report.data.records import CHAMFER_SCALE, Record, RunKey, error, grouped, run_key
from bench.report.data.runs import Runs, Selection, choose, shared_loss
from bench.tables import read_yaml

TUNING = Selection("tuning", ("split",))
PHOTOGRAPHS = replace(TUNING, experiment="tuning_photographs")  # it has validation shapes only
CHAMFER = "chamfer_l2"
SELECTION_METRICS = {PHOTOGRAPHS.experiment: "seen_chamfer_l1"}  # other experiments choose draws by CHAMFER
SPACE_PREFIX = "space/"  # before the names of methods whose settings are drawn
VALIDATION = "validation"
NOT_DRAWN = ("label", "draw", "dataset", "index", "seed", "split")  # keys of the configuration that are not drawn
SELECTIONS = {selection.experiment: selection for selection in (TUNING, PHOTOGRAPHS)}
HEADER = "# Settings of methods, chosen on validation shapes. Written by `python -m bench.tune`; do not edit.\n"
LINE_WIDTH = 118
CHOSEN_TEXT = (
    "draw {draw} of {draws} of {space}: geometric mean of {error} x 1000 on {runs} validation runs at scale={scale} of "
    "{families}{loss}: {best}, of the median draw {middle}; runs of commit {commit}"
)


@dataclass(frozen=True)
class Tuning:
    """The draws of one method."""

    method: str
    label: str  # for readers
    draws: list[int]  # their numbers
    settings: list[dict[str, Any]]  # of each draw, by dotted key
    validation: np.ndarray  # logarithms [draws, runs] of errors; of a failed run, the largest of any draw and method
    failures: np.ndarray  # validation runs of each draw that failed

    @property
    def scores(self) -> np.ndarray:
        """The mean logarithmic error [draws] on the validation shapes."""
        return self.validation.mean(axis=1)

    @property
    def order(self) -> np.ndarray:
        """The draws from the best to the worst: by their failures, then by the mean logarithmic validation error."""
        return np.lexsort((self.scores, self.failures))

    @property
    def best(self) -> int:
        return int(self.order[0])


def metric_of(runs: Runs) -> str:
    return SELECTION_METRICS.get(runs.selection.experiment, CHAMFER)


def tunings(runs: Runs) -> list[Tuning]:
    """The methods of an experiment, on the draws and shapes that all of them have; empty without validation runs."""
    ended = [record for record in runs.records if record["status"] not in UNFINISHED]
    by_method = grouped(ended, lambda record: record["method"])
    keys = sorted({run_key(record) for record in ended})
    cells = pd.DataFrame([_cell(record, keys, metric_of(runs)) for record in ended])
    if cells.empty:
        return []
    cells = cells[cells.groupby(["split", "draw", "run"]).method.transform("nunique") == len(by_method)]
    places = cells.groupby(["split", "run"]).ngroups  # needed per draw and method
    cells = cells[cells.groupby("draw").draw.transform("size") == places * len(by_method)]
    if VALIDATION not in {*cells.split}:
        return []
    worst = cells.error.where(np.isfinite(cells.error)).groupby([cells.split, cells.run]).transform("max").fillna(1.0)
    cells = cells.assign(error=np.log(np.minimum(cells.error, worst)))
    return [_tuning(cells[cells.method == method], records) for method, records in by_method.items()]


def left_out(runs: Runs, methods: list[Tuning]) -> list[str]:
    """A note on draws that are left out because not all methods have them; empty if there are none."""
    used = {draw for method in methods for draw in method.draws}
    draws = sorted({record["config"]["draw"] for record in runs.records} - used)
    return [f"Left out, since a method or a shape lacks them: draws {', '.join(map(str, draws))}."] if draws else []


def _cell(record: Record, keys: list[RunKey], metric: str) -> dict[str, Any]:
    """A line of the table of runs; `run` is the number of its shape and seed."""
    config, ok = record["config"], record["status"] == "ok"
    return {
        **{"method": record["method"], "split": config["split"], "draw": config["draw"]},
        **{"run": keys.index(run_key(record)), "failed": not ok, "record": record},
        "error": CHAMFER_SCALE * error(record, metric),
    }


def _tuning(runs: pd.DataFrame, records: list[Record]) -> Tuning:
    runs = runs[runs.split == VALIDATION]
    first = runs.groupby("draw").record.first()
    method, config = runs.method.iloc[0].removeprefix(SPACE_PREFIX), first.iloc[0]["config"]
    return Tuning(
        method=method,
        label=str(config.get("label") or method),
        draws=first.index.tolist(),
        settings=_settings(first.tolist(), records),
        validation=runs.pivot(index="draw", columns="run", values="error").to_numpy(),
        failures=runs.groupby("draw").failed.sum().to_numpy(),
    )


def _settings(records: list[Record], among: list[Record]) -> list[dict[str, Any]]:
    """The settings in which the draws `among` differ, by dotted key, for each of `records`."""
    configs = [flat(record["config"]) for record in among]
    varies = [name for name in configs[0] if len({str(config.get(name)) for config in configs}) > 1]
    names = [name for name in varies if name.partition(".")[0] not in {*NOT_DRAWN, *NEUTRAL_KEYS}]
    return [{name: config[name] for name in names} for config in (flat(record["config"]) for record in records)]


def write(results_dir: Path, path: Path, *, name: str = TUNING.experiment) -> list[str]:
    """Writes a row per method to a table, whose other rows stay; returns a line for each. Raises ValueError."""
    if path.suffix != ".yaml":
        raise ValueError(f"{path} is no table of settings: type --into conf/tuned.yaml")
    experiment = choose(read_records(results_dir)[0], SELECTIONS[name], results_dir)
    if experiment is None:
        raise ValueError(f"{results_dir} has no runs of the tuning: type python -m bench -m +experiment={name}")
    if waiting := sum(record["status"] in UNFINISHED for record in experiment.records):
        raise ValueError(
            f"{waiting} runs of the tuning have not ended: type the command of the sweep again, it goes on"
        )
    methods = tunings(experiment)
    if not methods:
        raise ValueError("no draw has a run on every shape for every method: sweep over them all")
    if len(methods[0].draws) < 2:
        raise ValueError(
            f"draw {methods[0].draws[0]} alone has a run on every shape for every method, and one is no choice: type "
            "the command of the sweep again, it makes the others"
        )
    for method in methods:
        if not is_plain_name(method.method):
            raise ValueError(f"runs name the method {method.method!r}, which is no name of a row: leave these runs out")
    settings = {method.method: method.settings[method.best] for method in methods}
    rows = dict(read_yaml(path)) if path.is_file() else {}
    for method in methods:
        origin = {"chosen": _chosen_text(method, experiment), "base": f"/method/{method.method}"}
        rows[method.method] = origin | {"label": f"{method.label}, tuned"} | settings[method.method]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, HEADER + yaml.safe_dump(rows, sort_keys=False, width=LINE_WIDTH))
    texts = {row: ", ".join(f"{key} {number(x)}" for key, x in values.items()) for row, values in settings.items()}
    return left_out(experiment, methods) + [f"{path}: {row}: {text}" for row, text in texts.items()]


def _chosen_text(method: Tuning, experiment: Runs) -> str:
    records = [record for record in experiment.records if record["method"].removeprefix(SPACE_PREFIX) == method.method]
    commits = {str(record["environment"].get("commit", "unknown"))[:9] for record in records if record["environment"]}
    name, metric = records[0]["method"], metric_of(experiment)
    return CHOSEN_TEXT.format(
        **{"draw": method.draws[method.best], "draws": len(method.draws), "runs": method.validation.shape[1]},
        space=name if name.startswith(SPACE_PREFIX) else experiment.selection.experiment,
        error="Chamfer" if metric == CHAMFER else metric,
        best=number(np.exp(method.scores[method.best])),
        middle=number(np.exp(np.median(method.scores))),
        scale=_join_names(record["config"]["scale"]["name"] for record in records),
        families=_join_names(record["config"]["dataset"]["name"] for record in records),
        commit=_join_names(commits),
        loss=f", all under {loss}" if (loss := _join_names([shared_loss(records)])) else "",
    )


def _join_names(names: Iterable[Any]) -> str:
    return " and ".join(sorted({" ".join(str(name).split()) for name in names}))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.tune", description=__doc__.split("\n\n")[1])
    parser.add_argument("--experiment", choices=SELECTIONS, default=TUNING.experiment, help="which sweep is read")
    parser.add_argument("--results", type=Path, default=Path(RESULTS), metavar="FOLDER", help="results folder")
    into = "the table: conf/tuned.yaml to use its rows as +method=tuned/NAME; without it, RESULTS/tuned.yaml"
    parser.add_argument("--into", type=Path, metavar="FILE", help=into)
    options = parser.parse_args(arguments)
    try:
        into = options.into or options.results / "tuned.yaml"
        print(*write(options.results, into, name=options.experiment), sep="\n")
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
