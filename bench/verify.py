"""`python -m bench.verify RUN...`: computes the metrics of runs again from their stored fields, and compares.

    python -m bench.verify results/local/runs/NAME              a run, or several
    python -m bench.verify results/local                        all runs of a results folder

The exit status is 0 if all runs with a field agree. Configurations are trusted, as by `python -m bench`.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from math import inf, isnan
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from bench.evaluate.evaluate import evaluate
from bench.evaluate.state import State
from bench.machine.environment import describe, flushing_denormals
from bench.records.folder import code_hash
from bench.records.format import number, plural
from bench.records.record import Record, RunStatus, bad_link, read_record
from bench.records.results import run_folders
from bench.setup.inputs import RunContext, prepare_run
from datasets.files.field_files import load_field
from datasets.saved_field import FIELD_FILE
from renderers.checks import BadInput
from renderers.field import Field

METRIC_TOLERANCE = 1e-4  # relative: other machines add numbers in another order
ABSOLUTE_TOLERANCE = 1e-9
MACHINE_KEYS = ("cpu", "device", "torch", "numpy", "python", "threads", "kernels")
EXCLUDED_METRICS = re.compile(r"\.|seconds|overhead|saved|gemm")  # metrics of several fits or of the clock


class NothingToCompare(Exception):
    """A run has nothing to compare; the message has the reason."""


@runtime_checkable
class EvaluatesField(Protocol):
    """A task with its own evaluation of a final field, in place of `bench.evaluate.evaluate.evaluate`."""

    def field_metrics(self, field: Field, run: RunContext) -> dict[str, float]:
        """The metrics of the final field of a run of the task."""
        ...


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.verify", description=__doc__.splitlines()[0].split(": ")[1])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="a run's folder, or a results folder")
    options = parser.parse_args(arguments)
    try:
        folders = [folder for path in options.runs for folder in _run_folders(path)]
        results = [_agrees(folder) for folder in folders]
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    compared = [result for result in results if result is not None]
    left_out = f"; {len(results) - len(compared)} left out" if len(compared) < len(results) else ""
    print(f"{sum(compared)} of {len(compared)} agree{left_out}")
    return 0 if compared and all(compared) else 1


def _run_folders(path: Path) -> list[Path]:
    """The folder of a run, or those of all runs of a results folder; raises ValueError if there are none."""
    folders = [path] if (path / "record.json").is_file() else run_folders(path)
    if not folders:
        raise ValueError(f"{path} has no record.json, and no runs: name a run's folder, or a results folder")
    return folders


def _agrees(folder: Path) -> bool | None:
    """Whether the recomputed metrics of a run agree with its record, None if it has none; prints a line on it."""
    try:
        if link := bad_link(folder, folder.parent):
            raise BadInput(f"{link} is a link out of the folder")
        record = Record.of(read_record(folder))
        metrics, device = _from_field(folder, record)
    except NothingToCompare as reason:
        print(f"left out: {folder.name}, from its field: {reason}")
        return None
    except (ValueError, OSError) as error:
        print(f"not compared: {folder.name}, from its field: {error}")
        return False
    recorded, recomputed = _compared_metrics(record.metrics), _compared_metrics(metrics)
    if not recomputed:
        print(f"left out: {folder.name}, from its field: no metric of its record can be computed from its field alone")
        return None
    differences = dict.fromkeys(recomputed, inf)
    for name in recomputed.keys() & recorded.keys():
        differences[name] = _relative_difference(recorded[name], recomputed[name])
    wrong = [name for name, difference in differences.items() if not difference <= METRIC_TOLERANCE]  # nan differs too
    if not wrong:
        largest, other_count = max(differences.values()), len(recorded.keys() - recomputed.keys())
        rest = f"; {other_count} others are not of the field" if other_count else ""
        metrics = plural(len(recomputed), "metric")
        print(f"agrees: {folder.name}, from its field: {metrics}, at most {largest:.1g} apart{rest}")
        return True
    old = {name: number(recorded[name]) if name in recorded else "not there" for name in wrong}
    texts = [f"{name} is {old[name]} in the record, now {number(recomputed[name])}" for name in wrong]
    reason = "; ".join(_changes(record, describe(device))) or "code and machine are the same: was the record edited?"
    print(f"differs: {folder.name}, from its field: {'; '.join(texts)}. {reason}")
    return False


def _compared_metrics(metrics: dict[str, Any]) -> dict[str, float]:
    return {name: x for name, x in metrics.items() if isinstance(x, int | float) and not EXCLUDED_METRICS.search(name)}


@flushing_denormals()
def _from_field(folder: Path, record: Record) -> tuple[dict[str, Any], torch.device]:
    """The metrics of a run's stored field, and the device that computed them; raises NothingToCompare, BadInput."""
    if not (folder / FIELD_FILE).is_file():
        notes = [note for note in record.notes if FIELD_FILE in note]
        status = "" if record.status == RunStatus.OK else f" ({record.status}: {record.reason})"
        raise NothingToCompare(notes[0] if notes else f"it has no {FIELD_FILE}, since it optimised no field{status}")
    task, inputs = prepare_run(record.config)
    inputs.configure_process()
    field = load_field(folder, inputs.device)
    run = RunContext(inputs, folder, record, lambda *_: None)
    metrics = task.field_metrics(field, run) if isinstance(task, EvaluatesField) else None
    return evaluate(State(field, inputs)).metrics if metrics is None else metrics, inputs.device


def _relative_difference(first: float, second: float) -> float:
    """The relative difference of two numbers; 0 if both are nan, or differ by at most `ABSOLUTE_TOLERANCE`."""
    if first == second or (isnan(first) and isnan(second)) or abs(first - second) <= ABSOLUTE_TOLERANCE:
        return 0.0
    return abs(first - second) / max(abs(first), abs(second))


def _changes(record: Record, environment: dict[str, Any]) -> list[str]:
    code = code_hash(record.config)
    differences = [f"the code differs: {record.code[:12]} then, {code[:12]} now"] if code != record.code else []
    for name in MACHINE_KEYS:
        then, now = record.environment.get(name), environment.get(name)
        if then != now:
            differences.append(f"{name} differs: {then} then, {now} now")
    return differences


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
