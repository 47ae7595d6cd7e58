"""Runs that are planned: each is checked before any starts; `plan=true` lists them, and what finished ones took.

A configuration is built by the code that its run builds it with, `bench.setup.inputs.build_cell`.
"""

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from itertools import islice
from pathlib import Path
from statistics import median
from typing import Any

from bench.config import Isolation, Rerun
from bench.records.folder import Identity, reusable
from bench.records.format import plural, seconds
from bench.records.read import Plan, PlannedCell, read_run, run_folders
from bench.records.record import digest, row_name
from bench.run.job import reason_of
from bench.run.process import in_child

# Statuses of runs that did not take their whole time.
UNMEASURED = ("killed", "crashed", "refused", "oom", "unsupported", "not_run")
LIKE, MOST = 100, 300  # runs of one kind whose times are taken, and whose records are read
HERE = ("basic", "workers")  # executors whose runs are on this machine


def plan_of(cells: Sequence[Identity]) -> Plan:
    """The plan of a sweep with these runs."""
    first = cells[0]
    name = f"{first.config['experiment'] or first.choices['task']}-{digest([cell.name for cell in cells])}"
    return Plan(name, Path(first.config["results_dir"]), [*map(planned, cells)])


def planned(identity: Identity) -> PlannedCell:
    """The cell of a sweep that is a run."""
    config = identity.config
    return PlannedCell(identity.name, identity.overrides, **identity.choices, seed=config["seed"], config=config)


def identity_of(cell: PlannedCell) -> Identity:
    """The identity of a planned cell's run."""
    choices = {name: getattr(cell, name) for name in ("task", "renderer", "dataset", "method")}
    return Identity(choices, cell.config, cell.overrides)


def is_reused(plan: Plan, cell: PlannedCell) -> bool:
    """Whether a cell's finished run is there already, and will be reused."""
    folder = plan.results_dir / "runs" / cell.id
    return reusable(folder, identity_of(cell), Rerun(cell.config["rerun"])) is not None


def refusal(config: Mapping[str, Any], built: dict[str, Any] | None = None) -> str:
    """Why the run of a configuration would be refused; empty where it would not, or would fail in another way."""
    from bench.setup.inputs import build_cell  # it imports torch

    try:
        with redirect_stdout(io.StringIO()):  # of classes of the user's
            build_cell(config, built)
    except (ValueError, OSError) as error:
        return reason_of(error)
    except (Exception, SystemExit):  # noqa: BLE001 - of a class of the user's; the run records it
        return ""
    return ""


def refusals(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """For each configuration, why its run would be refused; empty where it would not.

    Torch is loaded in the process of runs alone, unless a run takes place in this one.
    """
    if not configs or any(config["isolation"] == Isolation.off for config in configs):
        return _refusals(configs)
    return in_child(_refusals, configs) or [""] * len(configs)  # a class that ends its process does so in its run too


def _refusals(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    built: dict[str, Any] = {}  # what they share
    return [refusal(config, built) for config in configs]


def check_plan(plan: Plan, executor: str, reused: set[str]) -> None:
    """Checks all cells of a sweep, before it is written down.

    Args:
        executor: what makes the runs; another machine may have a GPU where this one has none.
        reused: ids of the cells whose finished run is there already, so that they need not be checked.

    Raises:
        ValueError: for an invalid cell, with the cell and what is wrong with it.
    """
    away = {} if executor in HERE else {"device": "cpu"}
    cells = [cell for cell in plan.cells if cell.id not in reused]
    found = refusals([cell.config | away for cell in cells])
    bad = [(cell, reason) for cell, reason in zip(cells, found, strict=True) if reason]
    if bad:
        raise ValueError(_of_sweep(plan, *bad[0], len(bad)))


def _of_sweep(plan: Plan, cell: PlannedCell, reason: str, count: int) -> str:
    """One line on a sweep that is refused: its first invalid cell, why, and how many are invalid."""
    if count == len(plan.cells):
        return reason
    where = " ".join(plan.differing(cell)) or cell.id
    others = f"; {count} of {len(plan.cells)} cells are invalid" if count > 1 else ""
    return f"cell {plan.cells.index(cell) + 1} of {len(plan.cells)} ({where}): {reason}{others}; nothing was run"


def times(plan: Plan, reused: set[str]) -> dict[Any, list[float]]:
    """The seconds of runs like those of a plan that took their whole time, by `kind`: of `LIKE` runs of each at most.

    A run's folder says whether it may be one of them; they are taken in the order of their hashes, as if by chance.

    Args:
        reused: ids of cells that will not run.
    """
    known: dict[Any, list[float]] = {kind(vars(cell)): [] for cell in plan.cells if cell.id not in reused}
    folders = sorted(run_folders(plan.results_dir), key=lambda folder: folder.name.rpartition("-")[2])
    for named in {like[:3] for like in known}:
        kinds = [like for like in known if like[:3] == named]
        for folder in islice((one for one in folders if _may_be(one.name, *named)), MOST * len(kinds)):
            if all(len(known[like]) >= LIKE for like in kinds):
                break
            record, _ = read_run(folder, plan.results_dir)
            if record is not None and kind(record) in kinds and (total := _whole_time(record)):
                known[kind(record)].append(total)
    return known


def _may_be(folder: str, task: str, renderer: str, method: str) -> bool:
    """Whether a run's folder may be of a task, renderer and method, by its name; see `Identity.name`."""
    task, renderer, method = (name.replace("/", "_") for name in (task, renderer, method))
    return folder.startswith(f"{task}-{renderer}-") and (not method or f"-{method}-" in folder)


def _whole_time(record: dict[str, Any]) -> float | None:
    """The seconds of a run that took its whole time; None for others."""
    total = record["seconds"].get("total")
    measured = record["status"] not in UNMEASURED and isinstance(total, int | float) and 0 < total < float("inf")
    return total if measured else None


def kind(run: dict[str, Any]) -> Any:
    """What runs that take about as long share: task, renderer, method and scale."""
    scale = run["config"].get("scale")
    name = str(scale.get("name")) if isinstance(scale, dict) else None
    return run["task"], run["renderer"], run.get("method", ""), name


def show_plan(plan: Plan, reused: set[str], workers: int) -> None:
    """Prints a line for each cell, and one for the whole plan."""
    known = times(plan, reused)
    taken = {cell.id: known[kind(vars(cell))] for cell in plan.cells if cell.id not in reused}
    for number, cell in enumerate(plan.cells, 1):
        file = Path((cell.config["dataset"] or {}).get("path") or "").name
        named = f"{cell.task}, {row_name(cell.config, cell.renderer)}, {f'{cell.dataset} {file}'.strip()}"
        about = "reused" if cell.id in reused else about_as_long(taken[cell.id])
        print("  ".join(part for part in (f"{number:>4}", " ".join(plan.differing(cell)), named, about) if part))
    parts = [f"{len(plan.cells)} planned: {len(taken)} to run"]
    if reused:
        parts.append(f"{len(reused)} reused")
    if unknown := sum(not like for like in taken.values()):
        parts.append(f"{unknown} of unknown time (no run like them has finished here)")
    text = ", ".join(parts) + ("" if taken else "; nothing is left to do")
    if each := [median(like) for like in taken.values() if like]:
        at_once = min(workers, len(taken))
        text += f"; about {seconds(sum(each) / at_once)}, {at_once} at a time"
        text += f", without the {unknown} of unknown time" if unknown else ""
        text += "; the training of a missing prior is not counted"
    print(text)


def about_as_long(like: list[float]) -> str:
    """What a run will take, in words, by what runs like it took."""
    if not like:
        return "time unknown"
    return f"about {seconds(median(like))} (median of {plural(len(like), 'finished run')})"
