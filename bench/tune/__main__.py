"""`python -m bench.tune`: writes each method's best drawn setting as a file of method/tuned.

It reads the runs of `+experiment=tuning`. The best draw is that with the smallest geometric mean of Chamfer distances
on the validation shapes; the test shapes take no part in the choice.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from bench.config import CONF
from bench.records.files import write_text
from bench.records.format import number
from bench.records.read import read_records
from bench.report.data.experiments import Experiment, choose
from bench.report.data.tuning import TUNING, Tuned, tuned

HEAD = """# @package _global_
# Draw {draw} of {draws} of method/space/{method}: geometric mean of Chamfer x 1000 on {runs} validation runs
# {best}, of the median draw {middle}. Written by `python -m bench.tune` from runs of commit {commit}; do not edit.
defaults:
  - /method/{method}
  - _self_

"""


def write(results_dir: Path, folder: Path) -> list[str]:
    """Writes a file per method to the folder, and gives a line for each.

    Raises:
        ValueError: where there are no runs of the tuning, or a method has no draw with all shapes.
    """
    experiment = choose(read_records(results_dir)[0], TUNING, results_dir)
    found = tuned(experiment) if experiment is not None else []
    if experiment is None or not found:
        raise ValueError(f"{results_dir} has no complete runs: type python -m bench -m +experiment=tuning")
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for method in found:
        path = folder / f"{method.method}.yaml"
        write_text(path, _text(method, experiment))
        chosen = ", ".join(f"{name} {number(value)}" for name, value in method.settings[method.best].items())
        lines.append(f"{path}: {chosen}")
    return lines


def _text(method: Tuned, experiment: Experiment) -> str:
    """The content of a method's file."""
    records = [record for record in experiment.records if record["method"].endswith(method.method)]
    commits = {str(record["environment"].get("commit", "unknown"))[:9] for record in records if record["environment"]}
    head = HEAD.format(
        draw=method.draws[method.best],
        draws=len(method.settings),
        method=method.method,
        runs=method.validation.shape[1],
        best=number(np.exp(method.scores.min())),
        middle=number(np.exp(np.median(method.scores))),
        commit=" and ".join(sorted(commits)),
    )
    node = OmegaConf.create({"label": f"{method.label}, tuned"})
    for name, value in method.settings[method.best].items():
        OmegaConf.update(node, name, value)
    return head + OmegaConf.to_yaml(node)


def main(arguments: list[str]) -> int:
    """Writes the files and prints a line for each."""
    parser = argparse.ArgumentParser(prog="python -m bench.tune", description=__doc__.split("\n\n")[1])
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="FOLDER", help="results folder")
    parser.add_argument(
        "--into", type=Path, default=CONF / "method" / "tuned", metavar="FOLDER", help="where the files go"
    )
    options = parser.parse_args(arguments)
    try:
        print("\n".join(write(options.results, options.into)))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
