"""`python -m bench.tune --into conf/tuned.yaml`: writes each method's best drawn setting as a row of a table.

It reads the runs of `+experiment=tuning`. The best draw is that with the smallest geometric mean of Chamfer distances
on the validation shapes, of those with the fewest failures; the test shapes take no part in the choice. With
`--experiment tuning_one_loss` the draw that is best over all methods is written, as one row for all of them; with
`--experiment tuning_photographs` each renderer's of reconstruction, by the Chamfer distance of what is seen.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bench.records.format import number
from bench.records.read import RESULTS, read_records
from bench.records.record import is_plain_name, write_text
from bench.report.data.records import Record
from bench.report.data.runs import Runs, choose, shared_loss
from bench.report.tuning import (
    CHAMFER,
    ONE_LOSS,
    PHOTOGRAPHS,
    SPACE,
    TUNING,
    Tuning,
    left_out,
    metric_of,
    pooled,
    tunings,
    unfinished,
)
from bench.tables import read_yaml

SELECTIONS = {selection.experiment: selection for selection in (TUNING, ONE_LOSS, PHOTOGRAPHS)}
SHARED = "_one_loss"  # the row with the setting that all methods share
HEAD = "# Settings of methods, chosen on validation shapes. Written by `python -m bench.tune`; do not edit.\n"
WIDTH = 118  # of its lines
CHOSEN = (
    "draw {draw} of {draws} of {space}: geometric mean of {error} x 1000 {over} at scale={scale} of {families}{loss}: "
    "{best}, of the median draw {middle}; runs of commit {commit}"
)


def write(results_dir: Path, path: Path, *, name: str = TUNING.experiment) -> list[str]:
    """Writes a row per method of the experiment of that name to a table, or one for all; gives a line for each.

    Other rows of the table stay.

    Raises:
        ValueError: where runs of the tuning are missing, or have not ended; where one row is asked for methods whose
            drawn settings differ; for a table that is no YAML.
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
    found = tunings(experiment)
    if not found:
        raise ValueError("no draw has a run on every shape for every method: sweep over them all")
    if len(found[0].draws) < 2:
        raise ValueError(
            f"draw {found[0].draws[0]} alone has a run on every shape for every method, and one is no choice: type the "
            "command of the sweep again, it makes the others"
        )
    for method in found:
        if not is_plain_name(method.method):
            raise ValueError(f"runs name the method {method.method!r}, which is no name of a row: leave these runs out")
    new = [_shared(found, experiment)] if name == ONE_LOSS.experiment else [_own(m, experiment) for m in found]
    rows = (read_yaml(path) if path.is_file() else {}) | {row: said | settings for row, said, settings in new}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, HEAD + yaml.safe_dump(rows, sort_keys=False, width=WIDTH))
    told = {row: ", ".join(f"{key} {number(value)}" for key, value in settings.items()) for row, _, settings in new}
    return left_out(experiment, found) + [f"{path}: {row}: {text}" for row, text in told.items()]


def _own(method: Tuning, experiment: Runs) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """The name of a method's row, what it says, and its settings by dotted key."""
    records = [record for record in experiment.records if record["method"].removeprefix(SPACE) == method.method]
    over = f"on {method.validation.shape[1]} validation runs"
    space = records[0]["method"] if records[0]["method"].startswith(SPACE) else experiment.selection.experiment
    chosen = _chosen(method, records, space=space, over=over, metric=metric_of(experiment))
    said = {"chosen": chosen, "base": f"/method/{method.method}", "label": f"{method.label}, tuned"}
    return method.method, said, method.settings[method.best]


def _shared(methods: list[Tuning], experiment: Runs) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """The same of the row of all methods."""
    all_of_them = pooled(methods)
    over = f"on {methods[0].validation.shape[1]} validation runs of each of {all_of_them.method},"
    chosen = _chosen(all_of_them, experiment.records, space="_drawn", over=over, metric=CHAMFER)
    return SHARED, {"chosen": chosen}, all_of_them.settings[all_of_them.best]


def _chosen(method: Tuning, records: list[Record], *, space: str, over: str, metric: str) -> str:
    """What was drawn, chosen, and from which runs."""
    commits = {str(record["environment"].get("commit", "unknown"))[:9] for record in records if record["environment"]}
    return CHOSEN.format(
        **{"draw": method.draws[method.best], "draws": len(method.draws), "space": space, "over": over},
        error="Chamfer" if metric == CHAMFER else metric,
        best=number(np.exp(method.scores[method.best])),
        middle=number(np.exp(np.median(method.scores))),
        scale=_names(record["config"]["scale"]["name"] for record in records),
        families=_names(record["config"]["dataset"]["name"] for record in records),
        commit=_names(commits),
        loss=f", all under {loss}" if (loss := _names([shared_loss(records)])) else "",
    )


def _names(found: Iterable[Any]) -> str:
    """Names from records in one line."""
    return " and ".join(sorted({" ".join(str(name).split()) for name in found}))


def main(arguments: list[str]) -> int:
    """Writes the rows and prints a line for each."""
    parser = argparse.ArgumentParser(prog="python -m bench.tune", description=__doc__.split("\n\n")[1])
    kind = "which sweep is read; of tuning_one_loss one row is written for all methods"
    parser.add_argument("--experiment", choices=SELECTIONS, default=TUNING.experiment, help=kind)
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
