"""A results folder: the runs to be made in it and their plan, its run folders, their curves, and its links."""

import errno
import json
import os
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from bench.records.record import SCHEMA, bad_link, from_json_values, is_outside, now, read_record, to_json, write_text

RESULTS = "results/local"  # the default results folder; conf/config.yaml has the same
PLAN_FILE = "plan.json"
NON_FINITE_STRINGS = ('"inf"', '"-inf"', '"nan"')
NOT_LOSS_TERMS = (
    *("iteration", "seconds", "value_evaluations", "gradient_evaluations", "cost"),
    *("chamfer_l1", "chamfer_l2", "psnr", "seen_chamfer_l1", "rotation_error_deg", "translation_error", "success"),
)
PAGE_FOLDERS = ("page", "base", "parts", "views", "data", "list", "run", "mesh", "shipped")
SUBFOLDERS = ("runs", "sweeps", "earlier", "paper", "suite", ".locks", *PAGE_FOLDERS)
# The files and folders of a results folder that this project writes.
WRITABLE_PATTERNS = ("*", "paper/*", "suite/*", "suite/*/*", "sweeps/*/*", "page/*", "page/data/*", "page/shipped/*")


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
        return set.intersection(*(set(cell.overrides) for cell in self.cells))

    def distinct_overrides(self, cell: PlannedRun) -> list[str]:
        return [override for override in cell.overrides if override not in self.common]

    def write(self) -> None:
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


def write_error_message(error: OSError, results_dir: str | None = None) -> str:
    """A message on a file that cannot be written, and what to do; names `results_dir` if the error names no file."""
    path = Path(named) if (named := error.filename or results_dir) else None
    file = next((parent for parent in path.parents if parent.is_file()), path) if path else None
    suffix = f" ({file})" if file else ""
    remedy = "on a local disk, which has locks" if error.errno == errno.ENOLCK else "you can write, or free space"
    return f"{error.strerror or error}{suffix}: set results_dir to a folder {remedy}"
