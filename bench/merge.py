"""`python -m bench.merge A B C --into D`: joins the results folders of several machines.

The order does not matter, and merging again changes nothing: of several runs of one cell, `runs` gets the one that
ranks highest, and `earlier` the others, named after a hash of their content. Priors are not copied: they can be
trained again.
"""

import argparse
import json
import os
import shutil
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from bench.records.files import file_lock, leads_out, link_out, write_text
from bench.records.folder import content_of, put_into, set_aside
from bench.records.read import check_links
from bench.records.record import read_record
from bench.report.write.html import write_index

UNFINISHED = ("killed", "crashed", "refused")  # these rank below every other status, and ok above


@dataclass(frozen=True)
class Attempt:
    """A run folder of a results folder, in `runs` or set aside in `earlier`."""

    folder: Path
    cell: str

    @cached_property
    def content(self) -> str:
        return content_of(self.folder)

    @cached_property
    def record(self) -> dict[str, Any]:
        """Its record; empty where it cannot be read."""
        try:
            return read_record(self.folder)
        except (OSError, ValueError, RecursionError):
            return {}

    @property
    def rank(self) -> tuple[Any, ...]:
        """Sort key: ok ranks above all others, killed and crashed below; then later above earlier, then by content."""
        status = self.record.get("status")
        finished = bool(status) and status not in UNFINISHED
        return (status == "ok", finished, bool(status), str(self.record.get("started")), self.content)

    @property
    def requested(self) -> str:
        return str(self.record.get("asked"))


def merge(sources: list[Path], into: Path) -> list[str]:
    """Copies all runs and plans of the sources to `into`; gives a line for each cell that has more than one run.

    A run with a link that leads out of its results folder is not copied, and has a line too.

    Raises:
        ValueError: for a source that is not a results folder, or that contains `into`.
    """
    for source in sources:
        if not (source / "runs").is_dir():
            raise ValueError(f"{source} is not a results folder: it has no folder runs")
    sources, into = [source.resolve() for source in sources], into.resolve()
    for source in sources:
        if source in into.parents:
            raise ValueError(f"{into} lies within {source}: give --into a folder outside of all sources")
    check_links(into)
    (into / "runs").mkdir(parents=True, exist_ok=True)
    lines: list[str] = []
    cells: dict[str, dict[str, Attempt]] = {}
    for results in dict.fromkeys([*sources, into]):
        for attempt in _attempts(results):
            if link := link_out(attempt.folder, results):
                lines.append(f"{attempt.folder}: not copied, since {link} is a link out of its results folder")
                continue
            same = cells.setdefault(attempt.cell, {})
            known = same.get(attempt.content)
            if known is None or attempt.requested > known.requested:  # the same run, requested again
                same[attempt.content] = attempt
    for source in sources:
        _copy_plans(source, into)
    return lines + [line for cell in sorted(cells) if (line := _place(cell, list(cells[cell].values()), into))]


def _attempts(results: Path) -> list[Attempt]:
    found = [Attempt(path, path.name) for path in _folders(results / "runs")]
    return found + [Attempt(path, path.name.rpartition("-")[0]) for path in _folders(results / "earlier")]


def _folders(parent: Path) -> list[Path]:
    return [path for path in sorted(parent.glob("*")) if path.is_dir() and not path.name.startswith(".")]


def _place(cell: str, attempts: list[Attempt], into: Path) -> str:
    """Copies the attempts of a cell to `runs` and `earlier`; gives a line where there is more than one."""
    attempts.sort(key=lambda attempt: attempt.rank, reverse=True)
    best, *others = attempts
    with file_lock(into, cell):
        for attempt in others:
            put_into(into / "earlier" / f"{cell}-{attempt.content}", attempt.folder)
        place = into / "runs" / cell
        if best.folder != place:
            kept = content_of(place) if place.exists() else ""
            if kept == best.content:  # the same run, but this one was requested later
                write_text(place / "record.json", (best.folder / "record.json").read_text(encoding="utf-8"))
            else:
                set_aside(place, into / "earlier")
                put_into(place, best.folder)
        shutil.rmtree(into / "earlier" / f"{cell}-{best.content}", ignore_errors=True)  # it is in `runs` now
    if not others:
        return ""
    names = [f"{attempt.record.get('status', 'unreadable')} of {attempt.record.get('started')}" for attempt in attempts]
    return f"{cell}: {len(attempts)} runs; kept {names[0]}, set aside in earlier: {', '.join(names[1:])}"


def _copy_plans(source: Path, into: Path) -> None:
    """Copies all plans; of two with the same name, which have the same cells, the one requested last is kept."""
    for path in sorted((source / "sweeps").glob("*/plan.json")):
        if leads_out(path, source):
            continue
        place = into / "sweeps" / path.parent.name / "plan.json"
        mine, theirs = ((str(_json(p).get("asked", "")), p.read_bytes() if p.exists() else b"") for p in (place, path))
        if theirs > mine:
            place.parent.mkdir(parents=True, exist_ok=True)
            scratch = place.with_name(f".plan.{os.getpid()}")
            scratch.write_bytes(theirs[1])
            scratch.replace(place)


def _json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def main(arguments: list[str]) -> int:
    """Merges, prints a line for each cell with more than one run, and the report's path last."""
    parser = argparse.ArgumentParser(prog="python -m bench.merge", description="Joins results folders.")
    parser.add_argument("sources", nargs="+", type=Path, metavar="FOLDER", help="results folders to join")
    parser.add_argument("--into", required=True, type=Path, metavar="FOLDER", help="where all of them go; may exist")
    options = parser.parse_args(arguments)
    try:
        for line in merge(options.sources, options.into):
            print(line)
        print(write_index(options.into))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
