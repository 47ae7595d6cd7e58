"""`python -m bench.tune --into conf/tuned.yaml`: writes each method's best drawn setting as a row of a table.

It reads the runs of `+experiment=tuning`. Of the draws with the fewest failures, the best has the smallest geometric
mean of Chamfer distances on the validation shapes; test shapes are not used. `--experiment tuning_photographs` chooses
settings of reconstruction, by the Chamfer distance of the seen surface.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bench.records.format import number
from bench.records.read import read_records
from bench.records.record import is_plain_name, write_text
from bench.records.results import RESULTS
from bench.report.data.records import Record
from bench.report.data.runs import Runs, choose, shared_loss
from bench.report.tuning import (
    CHAMFER,
    PHOTOGRAPHS,
    SPACE_PREFIX,
    TUNING,
    Tuning,
    left_out,
    metric_of,
    tunings,
    unfinished,
)
from bench.tables import read_yaml

SELECTIONS = {selection.experiment: selection for selection in (TUNING, PHOTOGRAPHS)}
HEADER = "# Settings of methods, chosen on validation shapes. Written by `python -m bench.tune`; do not edit.\n"
LINE_WIDTH = 118
CHOSEN_TEXT = (
    "draw {draw} of {draws} of {space}: geometric mean of {error} x 1000 on {runs} validation runs at scale={scale} of "
    "{families}{loss}: {best}, of the median draw {middle}; runs of commit {commit}"
)


def write(results_dir: Path, path: Path, *, name: str = TUNING.experiment) -> list[str]:
    """Writes a row per method of an experiment to a table; returns a line for each.

    Other rows of the table stay.

    Raises:
        ValueError: if runs of the tuning are missing or have not ended, or the table is not a YAML file.
    """
    if path.suffix != ".yaml":
        raise ValueError(f"{path} is no table of settings: type --into conf/tuned.yaml")
    experiment = choose(read_records(results_dir)[0], SELECTIONS[name], results_dir)
    if experiment is None:
        raise ValueError(f"{results_dir} has no runs of the tuning: type python -m bench -m +experiment={name}")
    if waiting := unfinished(experiment):
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
    new = {method.method: _origin_keys(method, experiment) | settings[method.method] for method in methods}
    rows = (read_yaml(path) if path.is_file() else {}) | new
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, HEADER + yaml.safe_dump(rows, sort_keys=False, width=LINE_WIDTH))
    texts = {row: ", ".join(f"{key} {number(x)}" for key, x in values.items()) for row, values in settings.items()}
    return left_out(experiment, methods) + [f"{path}: {row}: {text}" for row, text in texts.items()]


def _origin_keys(method: Tuning, experiment: Runs) -> dict[str, Any]:
    """The keys of a method's row that are not settings: how the settings were chosen, base and label."""
    records = [record for record in experiment.records if record["method"].removeprefix(SPACE_PREFIX) == method.method]
    chosen = _chosen_text(method, records, experiment)
    return {"chosen": chosen, "base": f"/method/{method.method}", "label": f"{method.label}, tuned"}


def _chosen_text(method: Tuning, records: list[Record], experiment: Runs) -> str:
    """A sentence on the draws, the choice and the runs."""
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
    """The different names in one line."""
    return " and ".join(sorted({" ".join(str(name).split()) for name in names}))


def main(arguments: list[str]) -> int:
    """Writes the rows and prints a line for each."""
    parser = argparse.ArgumentParser(prog="python -m bench.tune", description=__doc__.split("\n\n")[1])
    parser.add_argument("--experiment", choices=SELECTIONS, default=TUNING.experiment, help="which sweep is read")
    parser.add_argument("--results", type=Path, default=Path(RESULTS), metavar="FOLDER", help="results folder")
    into = "the table: conf/tuned.yaml to use its rows as +method=tuned/NAME; without it, RESULTS/tuned.yaml"
    parser.add_argument("--into", type=Path, metavar="FILE", help=into)
    options = parser.parse_args(arguments)
    try:
        print(
            "\n".join(write(options.results, options.into or options.results / "tuned.yaml", name=options.experiment))
        )
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
