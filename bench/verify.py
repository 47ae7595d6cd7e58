"""`python -m bench.verify RUN...`: computes the metrics of runs again from the fields that they left, and compares.

    python -m bench.verify results/local/runs/NAME              a run, or several
    python -m bench.verify results/local                        all runs of a results folder

The exit status is 0 where all that left a field agree. A configuration is trusted, as `python -m bench` trusts one.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from math import inf, isnan
from pathlib import Path
from typing import Any

import torch

from bench.evaluate.evaluate import evaluate
from bench.evaluate.state import State
from bench.machine.environment import describe, flushing_denormals
from bench.records.folder import Identity
from bench.records.format import number, plural
from bench.records.read import run_folders
from bench.records.record import Record, RunStatus, link_out, read_record
from bench.setup.inputs import EvaluatesField, RunContext, build_cell
from datasets.field_files import FIELD_FILE, load_field
from renderers.checks import BadInput

SAME = 1e-4  # relative difference of a metric that the same field may have elsewhere: sums are rounded in other orders
NEAR = 1e-9  # difference, in the metric's own unit, that is none
MACHINE = ("cpu", "device", "torch", "numpy", "python", "threads", "kernels")  # of a record's environment
TIMES = re.compile(r"\.|seconds|overhead|saved|gemm")  # metrics of several fits, and those that a clock decides


class LeftOut(Exception):
    """A run has nothing to compare; the message says why."""


def main(arguments: Sequence[str]) -> int:
    """Prints a line per run; gives the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench.verify", description=__doc__.splitlines()[0].split(": ")[1])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run's folder, or a results folder")
    given = parser.parse_args(arguments)
    try:
        folders = [folder for path in given.runs for folder in _folders(path)]
        agree = [_agrees(folder) for folder in folders]
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    compared = [one for one in agree if one is not None]
    left_out = f"; {len(agree) - len(compared)} left out" if len(compared) < len(agree) else ""
    print(f"{sum(compared)} of {len(compared)} agree{left_out}")
    return 0 if compared and all(compared) else 1


def _folders(path: Path) -> list[Path]:
    """The folder of a run, or those of all runs of a results folder.

    Raises:
        ValueError: where there is none.
    """
    found = [path] if (path / "record.json").is_file() else run_folders(path)
    if not found:
        raise ValueError(f"{path} has no record.json, and no runs: name a run's folder, or a results folder")
    return found


def _agrees(folder: Path) -> bool | None:
    """Whether the metrics of a run, computed once more, are those of its record; prints a line about it.

    None where there is nothing to compare.
    """
    try:
        if link := link_out(folder, folder.parent):
            raise BadInput(f"{link} is a link out of the folder")
        record = Record.of(read_record(folder))
        metrics, device = _from_field(folder, record)
    except LeftOut as reason:
        print(f"left out: {folder.name}, from its field: {reason}")
        return None
    except (ValueError, OSError) as error:
        print(f"not compared: {folder.name}, from its field: {error}")
        return False
    numbers, again = _numbers(record.metrics), _numbers(metrics)
    if not again:
        print(f"left out: {folder.name}, from its field: no metric of its record can be computed from its field alone")
        return None
    apart = {name: _apart(numbers[name], again[name]) if name in numbers else inf for name in again}
    wrong = [name for name, gap in apart.items() if not gap <= SAME]  # nor is one that is not a number
    if not wrong:
        widest, others = max(apart.values()), len(numbers.keys() - again.keys())
        rest = f"; {others} others are not of the field" if others else ""
        metrics = plural(len(again), "metric")
        print(f"agrees: {folder.name}, from its field: {metrics}, at most {widest:.1g} apart{rest}")
        return True
    pairs = {name: [number(of[name]) if name in of else "not there" for of in (numbers, again)] for name in wrong}
    told = [f"{name} is {before} in the record, now {now}" for name, (before, now) in pairs.items()]
    why = "; ".join(_reasons(record, describe(device))) or "code and machine are the same: was the record edited?"
    print(f"differs: {folder.name}, from its field: {'; '.join(told)}. {why}")
    return False


def _numbers(metrics: dict[str, Any]) -> dict[str, float]:
    """The metrics that are compared."""
    return {name: x for name, x in metrics.items() if isinstance(x, int | float) and not TIMES.search(name)}


@flushing_denormals()
def _from_field(folder: Path, record: Record) -> tuple[dict[str, Any], torch.device]:
    """The metrics of the field that a run left, and the device that computed them.

    Raises:
        LeftOut: where it left none.
        BadInput: where its field or its configuration cannot be used.
    """
    if not (folder / FIELD_FILE).is_file():
        notes = [note for note in record.notes if FIELD_FILE in note]
        ended = "" if record.status == RunStatus.OK else f" ({record.status}: {record.reason})"
        raise LeftOut(notes[0] if notes else f"it has no {FIELD_FILE}: no field was found or looked for{ended}")
    cell = build_cell(record.config)
    cell.start()
    field = load_field(folder, cell.inputs.device)
    run = RunContext(cell.inputs, folder, record, lambda *_: None)
    judged = cell.task.field_metrics(field, run) if isinstance(cell.task, EvaluatesField) else None
    return evaluate(State(field, cell.inputs)).metrics if judged is None else judged, cell.inputs.device


def _apart(first: float, second: float) -> float:
    """The relative difference of two numbers; 0 of two that are nearer than `NEAR`, or that both are none."""
    if first == second or (isnan(first) and isnan(second)) or abs(first - second) <= NEAR:
        return 0.0
    return abs(first - second) / max(abs(first), abs(second))


def _reasons(record: Record, environment: dict[str, Any]) -> list[str]:
    """In what code and machine of a record and of this process differ."""
    code = Identity({}, record.config).code
    told = [f"the code differs: {record.code[:12]} then, {code[:12]} now"] if code != record.code else []
    for name in MACHINE:
        then, now = record.environment.get(name), environment.get(name)
        if then != now:
            told.append(f"{name} differs: {then} then, {now} now")
    return told


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
