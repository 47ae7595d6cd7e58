"""`python -m bench.tune --into conf/method/tuned`: writes each method's best drawn setting as a file of its own.

It reads the runs of `+experiment=tuning`, or of `--experiment`. The best draw is that with the smallest geometric mean
of Chamfer distances on the validation shapes, of those with the fewest failures; the test shapes take no part in the
choice.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from bench.records.files import is_plain_name, write_text
from bench.records.format import number
from bench.records.read import read_records
from bench.report.data.experiments import Experiment, choose, shared_loss
from bench.report.data.subjects.tuning import ONE_LOSS, SPACE, TUNING, Tuning, left_out, tunings, unfinished

SELECTIONS = {selection.experiment: selection for selection in (TUNING, ONE_LOSS)}
HEAD = """# @package _global_
# Draw {draw} of {draws} of method/space/{method}: geometric mean of Chamfer x 1000 on {runs} validation runs
# at scale={scale} of {families}{loss}: {best}, of the median draw {middle}.
# Written by `python -m bench.tune` from runs of commit {commit}; do not edit.
defaults:
  - /method/{method}
  - _self_

"""


def write(results_dir: Path, folder: Path, *, name: str = TUNING.experiment) -> list[str]:
    """Writes a file per method of the experiment of that name to the folder, and gives a line for each.

    Raises:
        ValueError: where runs of the tuning are missing, or have not ended.
    """
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
            raise ValueError(
                f"runs name the method {method.method!r}, which is no name of a file: leave these runs out"
            )
    folder.mkdir(parents=True, exist_ok=True)
    lines = left_out(experiment, found)
    for method in found:
        path = folder / f"{method.method}.yaml"
        write_text(path, _text(method, experiment))
        chosen = ", ".join(f"{name} {number(value)}" for name, value in method.settings[method.best].items())
        lines.append(f"{path}: {chosen}")
    return lines


def _text(method: Tuning, experiment: Experiment) -> str:
    """The content of a method's file."""
    records = [record for record in experiment.records if record["method"] == SPACE + method.method]
    commits = {str(record["environment"].get("commit", "unknown"))[:9] for record in records if record["environment"]}
    head = HEAD.format(
        draw=method.draws[method.best],
        draws=len(method.draws),
        method=method.method,
        runs=method.validation.shape[1],
        best=number(np.exp(method.scores[method.best])),
        middle=number(np.exp(np.median(method.scores))),
        scale=_names(record["config"]["scale"]["name"] for record in records),
        families=_names(record["config"]["dataset"]["name"] for record in records),
        commit=_names(commits),
        loss=f", all under {loss}" if (loss := _names([shared_loss(records)])) else "",
    )
    node = OmegaConf.create({"label": f"{method.label}, tuned"})
    for name, value in method.settings[method.best].items():
        OmegaConf.update(node, name, value)
    return head + OmegaConf.to_yaml(node)


def _names(found: Iterable[Any]) -> str:
    """Names from records in one line, so that none of them writes a line of its own into the file."""
    return " and ".join(sorted({" ".join(str(name).split()) for name in found}))


def main(arguments: list[str]) -> int:
    """Writes the files and prints a line for each."""
    parser = argparse.ArgumentParser(prog="python -m bench.tune", description=__doc__.split("\n\n")[1])
    kind = "which sweep is read"
    parser.add_argument("--experiment", choices=SELECTIONS, default=TUNING.experiment, help=kind)
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="FOLDER", help="results folder")
    folder = "where the files go: conf/method/tuned to use them as +method=tuned/NAME; without it, RESULTS/tuned"
    parser.add_argument("--into", type=Path, metavar="FOLDER", help=folder)
    options = parser.parse_args(arguments)
    try:
        print("\n".join(write(options.results, options.into or options.results / "tuned", name=options.experiment)))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
