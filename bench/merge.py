"""`python -m bench.merge A B C --into D`: joins the results folders of several machines.

The order does not matter, and merging again changes nothing: of two runs of one cell, `runs` keeps the one that ranks
highest, and `earlier` gets the other, named after a hash of its content. Priors are not copied: they can be trained
again.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from bench.records.folder import archive_run, content_hash, copy_atomically
from bench.records.read import check_links, read_plans, read_run, run_folders
from bench.records.record import escaping_link, file_lock, is_outside, read_record, write_text
from bench.report.suite.attempts import place, read_attempts, write_attempts
from bench.report.write.html import write_index

UNREADABLE = "copied, but it cannot be read and no table shows it: "
UNFINISHED = ("killed", "crashed", "refused")  # these rank below every other status, and ok above


def merge(sources: list[Path], into: Path) -> tuple[list[str], list[str]]:
    """Copies all runs and plans of the sources to `into`.

    A run with a link that leads out of its results folder is not copied. A run whose record cannot be read is copied.

    Returns:
        a line for each run that another one replaced, and a message for each that is not copied or cannot be read.

    Raises:
        ValueError: for a source that is not a results folder, or that is or contains `into`; where `into` is a file.
    """
    for source in sources:
        if not (source / "runs").is_dir() and not place(source).is_dir():
            raise ValueError(f"{source} is not a results folder: it has no folder runs")
        if not is_outside(into, source):
            raise ValueError(f"{into} is {source} or lies within it: --into must be another folder, outside of it")
    if into.is_file():
        raise ValueError(f"{into} is a file: --into must be a folder, or a new name")
    check_links(into)
    (into / "runs").mkdir(parents=True, exist_ok=True)
    lines, problems = list[str](), list[str]()
    for source in sources:
        kept, unread = read_attempts(source)
        problems += [f"{source}: not copied: {problem}" for problem in unread]
        if kept:
            write_attempts(kept, into)
        for folder in [*run_folders(source), *sorted((source / "earlier").glob("[!.]*/"))]:
            if link := escaping_link(folder, source):
                problems.append(f"{folder}: not copied, since {link} is a link out of its results folder")
            elif folder.parent.name == "earlier":
                copy_atomically(into / "earlier" / folder.name, folder)
            else:
                lines += _join(folder, into)
                if problem := read_run(folder, source)[1]:
                    problems.append(f"{source}: {UNREADABLE}{problem}")
        problems += [f"{source}: this plan cannot be read: {problem}" for problem in read_plans(source)[1]]
        for plan in sorted((source / "sweeps").glob("*/plan.json")):  # of one name: of the same cells
            if not is_outside(plan, source):
                (into / "sweeps" / plan.parent.name).mkdir(parents=True, exist_ok=True)
                _keep_later(into / "sweeps" / plan.parent.name / plan.name, plan)
    return lines, problems


def _keep_later(place: Path, path: Path) -> None:
    """Writes a record or a plan to where another request of the same run or sweep is, if it was requested later."""
    if not place.exists() or _asked(path) > _asked(place):
        write_text(place, path.read_text("utf-8", "replace"))


def _asked(path: Path) -> str:
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))["asked"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""


def _join(folder: Path, into: Path) -> list[str]:
    """Copies a run; gives a line where there is another run of its cell, which one is kept and which set aside."""
    place, earlier = into / "runs" / folder.name, into / "earlier"
    with file_lock(into, folder.name):
        if not place.exists():
            copy_atomically(place, folder)
            return []
        (mine, kept), (theirs, other) = _ranked(place), _ranked(folder)
        if mine[-1] == theirs[-1]:  # the same run
            _keep_later(place / "record.json", folder / "record.json")
            return []
        if theirs > mine:
            kept, other = other, kept
            archive_run(place, earlier)
            copy_atomically(place, folder)
        else:
            copy_atomically(earlier / f"{folder.name}-{theirs[-1]}", folder)
    return [f"{folder.name}: kept {kept}, set aside in earlier: {other}"]


def _ranked(folder: Path) -> tuple[tuple[Any, ...], str]:
    """The rank of a run, and what it is in words: ok above all others, unfinished below, then by time and content."""
    try:
        record = read_record(folder)
    except (OSError, ValueError, RecursionError):
        record = {}
    status, started = record.get("status", "unreadable"), str(record.get("started"))
    finished = bool(record) and status not in UNFINISHED
    return (status == "ok", finished, bool(record), started, content_hash(folder)), f"{status} of {started}"


def main(arguments: list[str]) -> int:
    """Merges; prints a line for each run that another one replaced, what is wrong, and the report's path last.

    Returns:
        the exit status: 1 where a run is not copied or cannot be read, 2 where nothing can be merged.
    """
    parser = argparse.ArgumentParser(prog="python -m bench.merge", description="Joins results folders.")
    parser.add_argument("sources", nargs="+", type=Path, metavar="FOLDER", help="results folders to join")
    parser.add_argument("--into", required=True, type=Path, metavar="FOLDER", help="where all of them go; may exist")
    options = parser.parse_args(arguments)
    try:
        lines, problems = merge(options.sources, options.into)
        for problem in problems:
            print(f"warning: {problem}", file=sys.stderr)
        print(*lines, write_index(options.into), sep="\n")
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
