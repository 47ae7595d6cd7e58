"""Reads a results folder: the records of its runs, and the plans of its sweeps, whose cells must have a run each."""

import json
import marshal
import os
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from bench.records.names import Node
from bench.records.record import (
    NOT_RUN,
    SCHEMA,
    Record,
    decoded,
    is_plain_name,
    leads_out,
    link_out,
    now,
    read_record,
    started,
    to_json,
    write_text,
)

RESULTS = "results/local"  # the results folder unless another is given, as conf/config.yaml has it
PLAN = "plan.json"
WORDS = ('"inf"', '"-inf"', '"nan"')  # for numbers, in JSON
COSTS = ("iteration", "seconds", "value_evaluations", "gradient_evaluations", "cost")
NO_TERMS = (*COSTS, "chamfer_l1", "chamfer_l2")  # of a curve's loss
ERRORS = ("psnr", "seen_chamfer_l1", "rotation_error_deg", "translation_error", "success")  # likewise, at checkpoints
PAGE = ("page", "base", "parts", "views", "data", "list", "run", "mesh")
FOLDERS = ("runs", "sweeps", "earlier", "paper", "suite", ".locks", *PAGE)  # of a results folder, and in these
WRITTEN = (
    "*",
    "paper/*",
    "suite/*",
    "suite/*/*",
    "sweeps/*/*",
    "page/*",
    "page/data/*",
)  # where a results folder is written to


@dataclass(frozen=True)
class PlannedCell:
    """A cell of a sweep: the name of its run folder, what it overrides, and its resolved configuration."""

    id: str
    overrides: list[str]
    task: str
    renderer: str
    dataset: str
    seed: int
    config: dict[str, Any]
    method: str = ""


@dataclass(frozen=True)
class Plan:
    """All cells of a sweep, in their order."""

    name: str
    results_dir: Path
    cells: list[PlannedCell]
    asked: str = field(default_factory=now)

    @property
    def folder(self) -> Path:
        """The folder of the plan; the same sweep has the same folder."""
        return self.results_dir / "sweeps" / self.name

    @cached_property
    def common(self) -> set[str]:
        """The overrides that all cells have."""
        return set.intersection(*(set(cell.overrides) for cell in self.cells))

    def differing(self, cell: PlannedCell) -> list[str]:
        """The overrides of a cell that not all cells have."""
        return [override for override in cell.overrides if override not in self.common]

    def write(self) -> None:
        """Writes `plan.json`."""
        check_links(self.results_dir)
        self.folder.mkdir(parents=True, exist_ok=True)
        head = to_json({"schema": SCHEMA, "name": self.name, "asked": self.asked, "cells": []}).rstrip(" \n]}")
        cells = ",\n".join(to_json(vars(cell)).rstrip() for cell in self.cells)  # cell by cell, which takes less memory
        write_text(self.folder / PLAN, f"{head}\n{cells}\n]}}\n")

    def record(self, cell: PlannedCell) -> dict[str, Any] | None:
        """The record of a cell, if it was requested since the plan was made and has ended."""
        try:
            record = read_record(self.results_dir / "runs" / cell.id)
        except (OSError, ValueError, RecursionError):
            return None
        return record if record.get("ended") and record.get("asked", "") >= self.asked else None


def read_plans(results_dir: Path) -> tuple[list[Plan], list[str]]:
    """All plans of a results folder, and an error message for each that cannot be read."""
    found = [_read_plan(path, results_dir) for path in sorted((results_dir / "sweeps").glob(f"*/{PLAN}"))]
    return [plan for plan, _ in found if plan is not None], [problem for _, problem in found if problem]


def _read_plan(path: Path, results_dir: Path) -> tuple[Plan | None, str]:
    """The plan of a file, or None and why it cannot be read."""
    try:
        if leads_out(path, results_dir):
            raise ValueError("it is a link out of the results folder")
        plan = json.loads(path.read_text(encoding="utf-8"))
        if plan["schema"] != SCHEMA:
            raise ValueError(f"schema must be {SCHEMA}, found {plan['schema']!r}")
        if plan["name"] != path.parent.name:
            raise ValueError(f"its name must be that of its folder, found {plan['name']!r}")
        datetime.fromisoformat(plan["asked"])
        names = [item.name for item in fields(PlannedCell)]
        cells = [PlannedCell(**{name: cell[name] for name in names if name in cell}) for cell in plan["cells"]]
        if not all(map(_is_sound, cells)):
            raise ValueError("each cell's id must be the name of a folder, and its config an object")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        return None, f"sweeps/{path.parent.name}/{PLAN}: {error!r}"
    return Plan(plan["name"], results_dir, cells, plan["asked"]), ""


def read_records(results_dir: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The records of `results_dir/runs/*/record.json`, newest first, and a message for each that cannot be read.

    A message gives the folder's name and the reason. Hidden folders are ignored. Cells that a sweep planned and that
    have no folder are among the records, with the status `not_run` and no numbers.

    Raises:
        ValueError: if `results_dir` is not a folder, or has a link in place of a folder or file of its own.
    """
    check_results(results_dir)
    records, problems, known = list[dict[str, Any]](), list[str](), dict[bytes, Any]()
    for folder in run_folders(results_dir):
        record, said = read_run(folder, results_dir)
        if record is not None:
            records.append(_sharing(record, known))
        if said:
            problems.append(said)
    folders = {record["folder"] for record in records}
    plans, unread = read_plans(results_dir)
    missing = {cell.id: not_run(cell, plan) for plan in plans for cell in plan.cells if cell.id not in folders}
    records.extend(missing.values())
    records.sort(key=started, reverse=True)
    return records, problems + unread


def _sharing(record: dict[str, Any], known: dict[bytes, Any]) -> dict[str, Any]:
    """The same record, whose nodes of settings and whose names are those of other records where they are equal.

    10,000 records then take 53 MiB in place of 437. Nothing may change a node.

    Args:
        known: the nodes so far, by their content; it is extended.
    """

    def shared(value: Any) -> Any:
        if isinstance(value, str):
            return sys.intern(value)
        if not isinstance(value, dict | list):
            return value
        try:
            content = marshal.dumps(value, 2)  # the last version in which equal data have equal bytes
        except ValueError:  # nested too deep
            return value
        if content not in known:
            known[content] = Node(value) if isinstance(value, dict) else value
        return known[content]

    for name, value in record.items():
        if isinstance(value, dict) and name != "definitions":
            record[name] = {sys.intern(key): shared(item) for key, item in value.items()}
        else:
            record[name] = shared(value)
    return {sys.intern(name): value for name, value in record.items()}


def check_results(results_dir: Path) -> None:
    """Checks that a results folder is there, and that what is written to it stays in it.

    Raises:
        ValueError: if `results_dir` is not a folder, or has a link in place of a folder or file of its own.
    """
    if results_dir.is_file():
        raise ValueError(f"results_dir={results_dir} is a file: name the folder that has runs")
    if not results_dir.is_dir():
        raise ValueError(
            f"results_dir={results_dir}: there is no such folder; name one that has runs, or make a run: "
            f"python -m bench results_dir={results_dir}"
        )
    check_links(results_dir)


def run_folders(results_dir: Path) -> list[Path]:
    """The folders of all runs by name, but hidden ones."""
    runs = results_dir / "runs"
    if not runs.is_dir():
        return []
    with os.scandir(runs) as found:
        return [runs / name for name in sorted(f.name for f in found if not f.name.startswith(".") and f.is_dir())]


def read_run(folder: Path, results_dir: Path) -> tuple[dict[str, Any] | None, str]:
    """The record of a run's folder, or None and why it cannot be read, with the folder's name."""
    if link := link_out(folder, results_dir):
        return None, f"{folder.name}: not read, since {link} is a link out of the results folder"
    try:
        return read_record(folder), ""
    except FileNotFoundError:
        return None, f"{folder.name}: no record.json; the run has not finished, or its record was removed"
    except (OSError, ValueError, RecursionError) as error:
        return None, f"{folder.name}: {error}"


def check_links(results_dir: Path) -> None:
    """Checks that what is written to a results folder stays in it: it may be somebody else's, with links in it.

    Raises:
        ValueError: where one of its folders, a file of it or one of its tables is a link that leads out.
    """
    for path in (found for pattern in WRITTEN for found in results_dir.glob(pattern)):
        if path.is_symlink() and (path.name in FOLDERS or not path.is_dir()) and leads_out(path, results_dir):
            raise ValueError(f"{path} is a link out of the results folder: remove it, or set results_dir to another")


def _is_sound(cell: PlannedCell) -> bool:
    """Whether the fields of a planned cell have their types, and its id leads to no other folder."""
    listed = isinstance(cell.overrides, list) and isinstance(cell.config, dict)
    texts = (cell.task, cell.renderer, cell.dataset, cell.method, *cell.overrides) if listed else (None,)
    return all(isinstance(text, str) for text in texts) and is_plain_name(cell.id)


def curve_lines(folder: Path) -> list[dict[str, Any]] | None:
    """The lines of `curve.jsonl`, empty for those that cannot be read; None where there is no such file."""
    try:
        text = (folder / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    lines = text.splitlines()
    if not any(word in text for word in WORDS):
        with suppress(ValueError, RecursionError):  # all at once, where each line is sound
            found = json.loads(f"[{','.join(lines)}]")
            if len(found) == len(lines) and all(isinstance(line, dict) for line in found):
                return found
    return [_line(line) for line in lines]


def _line(text: str) -> dict[str, Any]:
    try:
        found = decoded(json.loads(text))
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def not_run(cell: PlannedCell, plan: Plan) -> dict[str, Any]:
    """A record in place of a planned cell's run that does not exist."""
    reason = f"planned by sweep {plan.name}; the same command runs it"
    record = Record(**vars(cell), started=plan.asked, asked=plan.asked, status=NOT_RUN, reason=reason)
    return asdict(record) | {"folder": cell.id}
