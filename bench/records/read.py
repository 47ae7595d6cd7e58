"""Reads a results folder: the records of its runs, and the plans of its sweeps."""

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

from bench.records.names import SharedSettings
from bench.records.record import (
    NOT_RUN,
    SCHEMA,
    Record,
    bad_link,
    from_json_values,
    is_outside,
    is_plain_name,
    now,
    read_record,
    started,
    to_json,
    write_text,
)

RESULTS = "results/local"  # the default results folder; conf/config.yaml has the same
PLAN_FILE = "plan.json"
NON_FINITE_STRINGS = ('"inf"', '"-inf"', '"nan"')
CURVE_COST_KEYS = ("iteration", "seconds", "value_evaluations", "gradient_evaluations", "cost")
NOT_LOSS_TERMS = (
    *CURVE_COST_KEYS,
    *("chamfer_l1", "chamfer_l2", "psnr", "seen_chamfer_l1", "rotation_error_deg", "translation_error", "success"),
)
PAGE_FOLDERS = ("page", "base", "parts", "views", "data", "list", "run", "mesh")
SUBFOLDERS = ("runs", "sweeps", "earlier", "paper", "suite", ".locks", *PAGE_FOLDERS)
# The files and folders of a results folder that this project writes.
WRITABLE_PATTERNS = ("*", "paper/*", "suite/*", "suite/*/*", "sweeps/*/*", "page/*", "page/data/*")


@dataclass(frozen=True)
class PlannedRun:
    """A run to be made: the name of its folder, its overrides, its choices, and its resolved configuration.

    A stress replaces the dataset, and the method may be empty.
    """

    id: str
    overrides: list[str]
    task: str
    renderer: str
    dataset: str
    seed: int
    config: dict[str, Any]
    method: str = ""

    @property
    def folder(self) -> Path:
        """The folder of the run."""
        return Path(self.config["results_dir"]) / "runs" / self.id


@dataclass(frozen=True)
class Plan:
    """All cells of a sweep, in order."""

    name: str
    results_dir: Path
    cells: list[PlannedRun]
    asked: str = field(default_factory=now)

    @property
    def folder(self) -> Path:
        """The folder of the plan; the same sweep has the same folder."""
        return self.results_dir / "sweeps" / self.name

    @cached_property
    def common(self) -> set[str]:
        """The overrides that all cells share."""
        return set.intersection(*(set(cell.overrides) for cell in self.cells))

    def distinct_overrides(self, cell: PlannedRun) -> list[str]:
        """The overrides of a cell that not all cells share."""
        return [override for override in cell.overrides if override not in self.common]

    def write(self) -> None:
        """Writes `plan.json`."""
        check_links(self.results_dir)
        self.folder.mkdir(parents=True, exist_ok=True)
        head = to_json({"schema": SCHEMA, "name": self.name, "asked": self.asked, "cells": []}).rstrip(" \n]}")
        cells = ",\n".join(to_json(vars(cell)).rstrip() for cell in self.cells)  # encoded one by one to save memory
        write_text(self.folder / PLAN_FILE, f"{head}\n{cells}\n]}}\n")

    def record(self, cell: PlannedRun) -> dict[str, Any] | None:
        """The record of a cell, if it was requested after the plan was made and has ended, else None."""
        return ended_record(self.results_dir / "runs" / cell.id, self.asked)


def ended_record(folder: Path, since: str) -> dict[str, Any] | None:
    """The record of a run that was requested at the time `since` or later, and has ended, else None."""
    try:
        record = read_record(folder)
    except (OSError, ValueError, RecursionError):
        return None
    return record if record.get("ended") and record.get("asked", "") >= since else None


def read_plans(results_dir: Path) -> tuple[list[Plan], list[str]]:
    """All plans of a results folder, and a message for each plan that cannot be read."""
    paths = sorted((results_dir / "sweeps").glob(f"*/{PLAN_FILE}"))
    pairs = [_read_plan(path, results_dir) for path in paths]
    return [plan for plan, _ in pairs if plan is not None], [fault for _, fault in pairs if fault]


def _read_plan(path: Path, results_dir: Path) -> tuple[Plan | None, str]:
    """The plan of a file, or None and the reason why it cannot be read."""
    try:
        if is_outside(path, results_dir):
            raise ValueError("it is a link out of the results folder")
        plan = json.loads(path.read_text(encoding="utf-8"))
        if plan["schema"] != SCHEMA:
            raise ValueError(f"schema must be {SCHEMA}, found {plan['schema']!r}")
        if plan["name"] != path.parent.name:
            raise ValueError(f"its name must be that of its folder, found {plan['name']!r}")
        datetime.fromisoformat(plan["asked"])
        names = [item.name for item in fields(PlannedRun)]
        cells = [PlannedRun(**{name: cell[name] for name in names if name in cell}) for cell in plan["cells"]]
        if not all(map(_is_valid_cell, cells)):
            raise ValueError("each cell's id must be the name of a folder, and its config an object")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        return None, f"sweeps/{path.parent.name}/{PLAN_FILE}: {error!r}"
    return Plan(plan["name"], results_dir, cells, plan["asked"]), ""


def read_records(results_dir: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """The records of `results_dir/runs/*/record.json`, newest first, and a message for each unreadable record.

    A message has the folder's name and the reason. Hidden folders are ignored. Planned cells without a folder are among
    the records, with the status `not_run` and no numbers.

    Raises:
        ValueError: if `results_dir` is not a folder, or one of its folders or files is a link that leads out of it.
    """
    check_results(results_dir)
    records, faults, shared_nodes = list[dict[str, Any]](), list[str](), dict[bytes, Any]()
    for folder in run_folders(results_dir):
        record, fault = read_run(folder, results_dir)
        if record is not None:
            records.append(_deduplicate(record, shared_nodes))
        if fault:
            faults.append(fault)
    folders = {record["folder"] for record in records}
    plans, plan_faults = read_plans(results_dir)
    missing = {cell.id: not_run_record(cell, plan) for plan in plans for cell in plan.cells if cell.id not in folders}
    records.extend(missing.values())
    records.sort(key=started, reverse=True)
    return records, faults + plan_faults


def _deduplicate(record: dict[str, Any], nodes: dict[bytes, Any]) -> dict[str, Any]:
    """The same record, which shares equal settings and strings with other records. Shared nodes must not be changed.

    10,000 records then take 53 MiB instead of 437 MiB.

    Args:
        nodes: the nodes of all records so far, by their content; it is extended.
    """

    def shared_value(value: Any) -> Any:
        if isinstance(value, str):
            return sys.intern(value)
        if not isinstance(value, dict | list):
            return value
        try:
            content = marshal.dumps(value, 2)  # the last version in which equal data have equal bytes
        except ValueError:  # nested too deeply
            return value
        if content not in nodes:
            nodes[content] = SharedSettings(value) if isinstance(value, dict) else value
        return nodes[content]

    for name, value in record.items():
        if isinstance(value, dict) and name != "definitions":
            record[name] = {sys.intern(key): shared_value(item) for key, item in value.items()}
        else:
            record[name] = shared_value(value)
    return {sys.intern(name): value for name, value in record.items()}


def check_results(results_dir: Path) -> None:
    """Checks that a results folder exists, and that no link leads writes out of it.

    Raises:
        ValueError: if `results_dir` is not a folder, or one of its folders or files is a link that leads out of it.
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
    """The folders of all runs in the order of their names, without hidden folders."""
    runs = results_dir / "runs"
    if not runs.is_dir():
        return []
    with os.scandir(runs) as entries:
        names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
    return [runs / name for name in sorted(names)]


def read_run(folder: Path, results_dir: Path) -> tuple[dict[str, Any] | None, str]:
    """The record of a run's folder, or None and a message with the folder's name and the reason."""
    if link := bad_link(folder, results_dir):
        return None, f"{folder.name}: not read, since {link} is a link out of the results folder"
    try:
        return read_record(folder), ""
    except FileNotFoundError:
        return None, f"{folder.name}: no record.json; the run has not finished, or its record was removed"
    except (OSError, ValueError, RecursionError) as error:
        return None, f"{folder.name}: {error}"


def check_links(results_dir: Path) -> None:
    """Checks that no link leads writes out of a results folder, which may come from somebody else.

    Raises:
        ValueError: if a folder or file that this project writes is a link that leads out.
    """
    for path in (path for pattern in WRITABLE_PATTERNS for path in results_dir.glob(pattern)):
        if path.is_symlink() and (path.name in SUBFOLDERS or not path.is_dir()) and is_outside(path, results_dir):
            raise ValueError(f"{path} is a link out of the results folder: remove it, or set results_dir to another")


def _is_valid_cell(cell: PlannedRun) -> bool:
    """Whether the fields of a planned cell have the right types, and its id is a plain file name."""
    has_types = isinstance(cell.overrides, list) and isinstance(cell.config, dict)
    texts = (cell.task, cell.renderer, cell.dataset, cell.method, *cell.overrides) if has_types else (None,)
    return all(isinstance(text, str) for text in texts) and is_plain_name(cell.id)


def curve_lines(folder: Path) -> list[dict[str, Any]] | None:
    """The lines of `curve.jsonl`, {} for an unreadable line; None if the file does not exist."""
    try:
        text = (folder / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    lines = text.splitlines()
    if not any(text_of_number in text for text_of_number in NON_FINITE_STRINGS):
        with suppress(ValueError, RecursionError):  # all lines at once, if all are valid
            objects = json.loads(f"[{','.join(lines)}]")
            if len(objects) == len(lines) and all(isinstance(line, dict) for line in objects):
                return objects
    return [_parse_line(line) for line in lines]


def _parse_line(text: str) -> dict[str, Any]:
    try:
        value = from_json_values(json.loads(text))
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def not_run_record(cell: PlannedRun, plan: Plan) -> dict[str, Any]:
    """A record for a planned cell that has not been run."""
    reason = f"planned by sweep {plan.name}; the same command runs it"
    record = Record(**vars(cell), started=plan.asked, asked=plan.asked, status=NOT_RUN, reason=reason)
    return asdict(record) | {"folder": cell.id}
