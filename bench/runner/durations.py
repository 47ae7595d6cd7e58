"""How long planned runs take, from finished runs like them; `plan=true` lists a plan with these times."""

from collections.abc import Mapping
from itertools import islice
from math import inf
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

from bench.records.format import plural, seconds
from bench.records.record import flat, row_name
from bench.records.results import Plan, read_run, run_folders
from bench.records.shipped import CONFIG, cell_value, shipped_rows

# Statuses of runs whose duration says nothing about similar runs.
STATUSES_WITHOUT_DURATION = ("killed", "crashed", "refused", "oom", "unsupported", "not_run")
MAX_SIMILAR_RUNS, MAX_RECORDS_READ = 100, 300  # per group of similar runs
ITERATIONS, LOOP_PHASES = "task.optimiser.iterations", ("forward", "backward")


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
        parts.append(f"{unknown} of unknown time (no similar run with a runtime is here, or shipped)")
    text = ", ".join(parts) + ("" if to_run else "; nothing is left to do")
    if means := [fmean(group) for group in to_run.values() if group]:
        concurrency = min(workers, len(to_run))
        text += f"; about {seconds(sum(means) / concurrency)} by mean times, {concurrency} at a time"
        text += f", without the {unknown} of unknown time" if unknown else ""
        text += "; the training of a missing prior is not counted"
    print(text)
