"""Checks all runs of a sweep before the first one starts; `plan=true` lists them with an estimate of their duration.

A check builds the configuration with the same code as the run, `bench.setup.inputs.prepare_run`.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from itertools import islice
from math import inf
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

from bench.config import Isolation
from bench.records.folder import reusable_record
from bench.records.format import plural, seconds
from bench.records.record import digest, flat, row_name
from bench.records.results import Plan, PlannedRun, read_run, run_folders
from bench.records.shipped import CONFIG, cell_value, shipped_rows
from bench.runner.messages import reason_of
from bench.runner.process import run_in_child

# Statuses of runs whose duration says nothing about similar runs.
STATUSES_WITHOUT_DURATION = ("killed", "crashed", "refused", "oom", "unsupported", "not_run")
MAX_SIMILAR_RUNS, MAX_RECORDS_READ = 100, 300  # per group of similar runs
ITERATIONS, LOOP_PHASES = "task.optimiser.iterations", ("forward", "backward")


def plan_of(cells: list[PlannedRun]) -> Plan:
    """The plan of a sweep of these runs."""
    first = cells[0]
    name = f"{first.config['experiment'] or first.task}-{digest([cell.id for cell in cells])}"
    return Plan(name, Path(first.config["results_dir"]), cells)


def reused_ids(cells: Sequence[PlannedRun]) -> set[str]:
    """The ids of the runs that exist, are finished, and will be reused."""
    return {cell.id for cell in cells if reusable_record(cell) is not None}


def refusal_reason(config: Mapping[str, Any], built: dict[str, Any] | None = None) -> str:
    """Why the run of a configuration would be refused; empty if it would start, or fail in another way."""
    from bench.setup.inputs import prepare_run  # it imports torch

    try:
        with redirect_stdout(io.StringIO()):  # classes of the user may print
            prepare_run(config, built)
    except (ValueError, OSError) as error:
        return reason_of(error)
    except (Exception, SystemExit):  # noqa: BLE001 - a class of the user; the run will record the error
        return ""
    return ""


def refusal_reasons(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """For each configuration, why its run would be refused; empty if it would not be.

    Torch is loaded only in the process of runs, unless a run takes place in this process.
    """
    if not configs or any(config["isolation"] == Isolation.off for config in configs):
        return _refusal_reasons(configs)
    # A class that ends its process gives no reasons here, and will end the process of its run.
    return run_in_child(_refusal_reasons, configs) or [""] * len(configs)


def _refusal_reasons(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    built: dict[str, Any] = {}  # shared objects
    return [refusal_reason(config, built) for config in configs]


def check_plan(plan: Plan, reused: set[str], *, is_local: bool) -> None:
    """Checks all cells of a sweep before its plan is written.

    Args:
        reused: ids of cells whose finished run will be reused, which are not checked.
        is_local: whether the runs are on this machine; those on another one may use a GPU that this one lacks.

    Raises:
        ValueError: if a cell is invalid; the message has the cell and the reason.
    """
    device_override = {} if is_local else {"device": "cpu"}
    cells = [cell for cell in plan.cells if cell.id not in reused]
    reasons = refusal_reasons([cell.config | device_override for cell in cells])
    refused = [(cell, reason) for cell, reason in zip(cells, reasons, strict=True) if reason]
    if refused:
        raise ValueError(_refusal_message(plan, *refused[0], len(refused)))


def _refusal_message(plan: Plan, cell: PlannedRun, reason: str, count: int) -> str:
    """The message for a refused sweep: its first invalid cell, the reason, and the number of invalid cells."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.distinct_overrides(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells are invalid" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"


class Duration(NamedTuple):
    """The seconds of a finished run: of its loop, which grow with the iterations, and all others."""

    loop: float
    rest: float
    iterations: float

    def scaled(self, config: Mapping[str, Any]) -> float:
        """The seconds that this run would take with the iterations of a configuration."""
        return self.rest + self.loop * iterations(config) / self.iterations


def durations_of_similar_runs(plan: Plan, reused: set[str]) -> dict[Any, list[Duration]]:
    """The durations of finished runs that are similar to those of a plan, by `duration_group`.

    There are at most `MAX_SIMILAR_RUNS` per group. They are taken in the order of their hashes, which is as if random.

    Args:
        reused: ids of cells that will not run.
    """
    durations: dict[Any, list[Duration]] = {
        duration_group(vars(cell)): [] for cell in plan.cells if cell.id not in reused
    }
    folders = sorted(run_folders(plan.results_dir), key=lambda folder: folder.name.rpartition("-")[2])
    for names in {group[:3] for group in durations}:
        groups = [group for group in durations if group[:3] == names]
        candidates = (folder for folder in folders if _name_may_match(folder.name, *names))
        for folder in islice(candidates, MAX_RECORDS_READ * len(groups)):
            if all(len(durations[group]) >= MAX_SIMILAR_RUNS for group in groups):
                break
            record, _ = read_run(folder, plan.results_dir)
            if record is not None and duration_group(record) in groups and (duration := _full_duration(record)):
                durations[duration_group(record)].append(duration)
    return durations


def durations_of_shipped_runs(experiment: str | None) -> dict[Any, list[Duration]]:
    """The durations of the shipped runs of an experiment, by `duration_group`."""
    durations: dict[Any, list[Duration]] = {}
    for row in shipped_rows(experiment or ""):
        if row["status"] not in STATUSES_WITHOUT_DURATION and row.get("seconds.total"):
            group = row["task"], row["renderer"], cell_value(row["method"]), row["config.scale.name"]
            loop = sum(float(row.get(f"seconds.{phase}") or 0) for phase in LOOP_PHASES)
            duration = Duration(loop, float(row["seconds.total"]) - loop, float(row.get(f"{CONFIG}{ITERATIONS}") or 1))
            durations.setdefault(group, []).append(duration)
    return durations


def _name_may_match(folder: str, task: str, renderer: str, method: str) -> bool:
    """Whether the name of a folder may be that of a run of a task, renderer and method; see `planned_run`."""
    task, renderer, method = (name.replace("/", "_") for name in (task, renderer, method))
    return folder.startswith(f"{task}-{renderer}-") and (not method or f"-{method}-" in folder)


def _full_duration(record: dict[str, Any]) -> Duration | None:
    """The duration of a run, or None if it ended early."""
    total, *phases = (record["seconds"].get(name) for name in ("total", *LOOP_PHASES))
    if not (isinstance(total, int | float) and 0 < total < inf) or record["status"] in STATUSES_WITHOUT_DURATION:
        return None
    loop = min(sum(phase for phase in phases if isinstance(phase, int | float) and phase > 0), total)
    return Duration(loop, total - loop, iterations(record["config"]))


def duration_group(run: dict[str, Any]) -> Any:
    """Task, renderer, method and scale: runs that share them take about the same time, apart from their iterations."""
    scale = run["config"].get("scale")
    name = str(scale.get("name")) if isinstance(scale, dict) else None
    return run["task"], run["renderer"], run.get("method", ""), name


def iterations(config: Mapping[str, Any]) -> float:
    """The iterations of a run; 1 for tasks without such a setting."""
    value = flat(config).get(ITERATIONS)
    return value if isinstance(value, int | float) and value > 0 else 1


def show_plan(plan: Plan, reused: set[str], workers: int) -> None:
    """Prints a line for each cell, and one for all of them."""
    durations = durations_of_similar_runs(plan, reused)
    shipped = durations_of_shipped_runs(plan.cells[0].config["experiment"]) if [] in durations.values() else {}
    groups = {cell.id: duration_group(vars(cell)) for cell in plan.cells if cell.id not in reused}
    similar = {name: durations[group] or shipped.get(group, []) for name, group in groups.items()}
    configs = {cell.id: cell.config for cell in plan.cells}
    to_run = {name: [run.scaled(configs[name]) for run in runs] for name, runs in similar.items()}
    for number, cell in enumerate(plan.cells, 1):
        file = Path((cell.config["dataset"] or {}).get("path") or "").name
        title = f"{cell.task}, {row_name(cell.config, cell.renderer)}, {f'{cell.dataset} {file}'.strip()}"
        estimate = "reused" if cell.id in reused else "time unknown"
        if times := to_run.get(cell.id):
            kind = plural(len(times), "finished run" if durations[groups[cell.id]] else "shipped run")
            is_scaled = any(run.iterations != iterations(cell.config) for run in similar[cell.id])
            kind += ", scaled to these iterations" if is_scaled else ""
            estimate = f"about {seconds(median(times))} (median of {kind})"
        parts = (f"{number:>4}", " ".join(plan.distinct_overrides(cell)), title, estimate)
        print("  ".join(filter(None, parts)))
    parts = [f"{len(plan.cells)} planned: {len(to_run)} to run"]
    if reused:
        parts.append(f"{len(reused)} reused")
    if unknown := sum(not group for group in to_run.values()):
        parts.append(f"{unknown} of unknown time (no similar run has finished here, and none is shipped)")
    text = ", ".join(parts) + ("" if to_run else "; nothing is left to do")
    if means := [fmean(group) for group in to_run.values() if group]:
        concurrency = min(workers, len(to_run))
        text += f"; about {seconds(sum(means) / concurrency)} by mean times, {concurrency} at a time"
        text += f", without the {unknown} of unknown time" if unknown else ""
        text += "; the training of a missing prior is not counted"
    print(text)
