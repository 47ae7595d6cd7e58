"""`python -m bench.tune --into conf/method/tuned`: writes each method's best drawn setting as a file of its own.

It reads the runs of `+experiment=tuning`. The best draw is that with the smallest geometric mean of Chamfer distances
on the validation shapes, of those with the fewest failures; the test shapes take no part in the choice. With
`--experiment tuning_one_loss` the draw that is best over all methods is written, as one file for all of them.
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
from bench.report.data.records import Record
from bench.report.data.subjects.tuning import (
    ONE_LOSS,
    SPACE,
    TUNING,
    Tuning,
    left_out,
    pooled,
    tunings,
    unfinished,
)

SELECTIONS = {selection.experiment: selection for selection in (TUNING, ONE_LOSS)}
SHARED = "_one_loss"  # the file with the setting that all methods share
HEAD = """# @package _global_
# Draw {draw} of {draws} of method/{space}: geometric mean of Chamfer x 1000 {over}
# at scale={scale} of {families}{loss}: {best}, of the median draw {middle}.
# Written by `python -m bench.tune` from runs of commit {commit}; do not edit.
"""
BASE = """defaults:
  - /method/{method}
  - _self_

"""


def write(results_dir: Path, folder: Path, *, name: str = TUNING.experiment) -> list[str]:
    """Writes a file per method of the experiment of that name to the folder, or one for all; gives a line for each.

    Raises:
        ValueError: where runs of the tuning are missing, or have not ended; where one file is asked for methods whose
            drawn settings differ.
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
    files = [_shared(found, experiment)] if name == ONE_LOSS.experiment else [_own(m, experiment) for m in found]
    folder.mkdir(parents=True, exist_ok=True)
    lines = left_out(experiment, found)
    for stem, settings, text in files:
        path = folder / f"{stem}.yaml"
        write_text(path, text)
        lines.append(f"{path}: " + ", ".join(f"{name} {number(value)}" for name, value in settings.items()))
    return lines


def _own(method: Tuning, experiment: Experiment) -> tuple[str, dict[str, Any], str]:
    """The name, the settings and the content of a method's file."""
    records = [record for record in experiment.records if record["method"] == SPACE + method.method]
    over = f"on {method.validation.shape[1]} validation runs"
    head = _head(method, records, space=f"space/{method.method}", over=over)
    settings = method.settings[method.best]
    body = _yaml({"label": f"{method.label}, tuned"}, settings)
    return method.method, settings, head + BASE.format(method=method.method) + body


def _shared(methods: list[Tuning], experiment: Experiment) -> tuple[str, dict[str, Any], str]:
    """The name, the settings and the content of the file of all methods."""
    all_of_them = pooled(methods)
    over = f"on {methods[0].validation.shape[1]} validation runs\n# of each of {all_of_them.method},"
    head = _head(all_of_them, experiment.records, space="_drawn", over=over)
    settings = all_of_them.settings[all_of_them.best]
    return SHARED, settings, head + _yaml({}, settings)


def _head(method: Tuning, records: list[Record], *, space: str, over: str) -> str:
    """What was drawn, chosen, and from which runs."""
    commits = {str(record["environment"].get("commit", "unknown"))[:9] for record in records if record["environment"]}
    return HEAD.format(
        **{"draw": method.draws[method.best], "draws": len(method.draws), "space": space, "over": over},
        best=number(np.exp(method.scores[method.best])),
        middle=number(np.exp(np.median(method.scores))),
        scale=_names(record["config"]["scale"]["name"] for record in records),
        families=_names(record["config"]["dataset"]["name"] for record in records),
        commit=_names(commits),
        loss=f", all under {loss}" if (loss := _names([shared_loss(records)])) else "",
    )


def _yaml(first: dict[str, Any], settings: dict[str, Any]) -> str:
    """Settings by dotted key, behind other keys, as YAML."""
    node = OmegaConf.create(first)
    for name, value in settings.items():
        OmegaConf.update(node, name, value)
    return OmegaConf.to_yaml(node)


def _names(found: Iterable[Any]) -> str:
    """Names from records in one line, so that none of them writes a line of its own into the file."""
    return " and ".join(sorted({" ".join(str(name).split()) for name in found}))


def main(arguments: list[str]) -> int:
    """Writes the files and prints a line for each."""
    parser = argparse.ArgumentParser(prog="python -m bench.tune", description=__doc__.split("\n\n")[1])
    kind = "which sweep is read; of tuning_one_loss one setting is written for all methods"
    parser.add_argument("--experiment", choices=SELECTIONS, default=TUNING.experiment, help=kind)
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="FOLDER", help="results folder")
    folder = (
        "where the files go: conf/method/tuned to use them as +method=tuned/NAME, conf/method for that of "
        "tuning_one_loss; without it, RESULTS/tuned"
    )
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
