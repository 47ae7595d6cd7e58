"""`python -m bench.merge A B C --into D`: joins the results folders of several machines.

The order does not matter, and merging again changes nothing. Of two runs of one cell, `runs` keeps the run with the
higher rank, and `earlier` gets the other, with a hash of its content in its name. Priors are not copied.
"""

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from bench.records.folder import archive_run, content_hash
from bench.records.read import read_plans
from bench.records.record import bad_link, file_lock, is_outside, read_record, write_text
from bench.records.results import check_links, read_run, run_folders
from bench.report.suite.attempts import attempts_folder, read_attempts, write_attempts
from bench.report.write.html import write_index

UNFINISHED = ("killed", "crashed", "refused")  # they rank below all other statuses, and ok above


def merge(sources: list[Path], into: Path) -> tuple[list[str], list[str]]:
    """Copies all runs and plans of the sources to `into`, without runs that have a link out of their results folder.

    Returns a line for each replaced run, and a message for each run that is not copied or cannot be read. Raises
    ValueError for a source or an `into` that is wrong.
    """
    for source in sources:
        if not (source / "runs").is_dir() and not attempts_folder(source).is_dir():
            raise ValueError(f"{source} is not a results folder: it has no folder runs")
        if not is_outside(into, source):
            raise ValueError(f"{into} is {source} or lies within it: --into must be another folder, outside of it")
    if into.is_file():
        raise ValueError(f"{into} is a file: --into must be a folder, or a new name")
    check_links(into)
    (into / "runs").mkdir(parents=True, exist_ok=True)
    lines, faults = list[str](), list[str]()
    for source in sources:
        attempts, faults_of_attempts = read_attempts(source)
        faults += [f"{source}: not copied: {fault}" for fault in faults_of_attempts]
        if attempts:
            write_attempts(attempts, into)
        for folder in [*run_folders(source), *sorted((source / "earlier").glob("[!.]*/"))]:
            if link := bad_link(folder, source):
                faults.append(f"{folder}: not copied, since {link} is a link out of its results folder")
            elif folder.parent.name == "earlier":
                _copy_atomically(into / "earlier" / folder.name, folder)
            else:
                lines += _copy_run(folder, into)
                if fault := read_run(folder, source)[1]:
                    faults.append(f"{source}: not read: {fault} (the run is copied)")
        faults += [f"{source}: this plan cannot be read: {fault}" for fault in read_plans(source)[1]]
        for plan in sorted((source / "sweeps").glob("*/plan.json")):  # plans of the same name have the same cells
            if not is_outside(plan, source):
                (into / "sweeps" / plan.parent.name).mkdir(parents=True, exist_ok=True)
                _keep_later(into / "sweeps" / plan.parent.name / plan.name, plan)
    return lines, faults


def _copy_atomically(target: Path, folder: Path) -> None:
    """Copies a folder to `target` atomically; does nothing if `target` exists."""
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{target.name}.{os.getpid()}")
    shutil.copytree(folder, scratch)
    scratch.rename(target)


def _keep_later(target: Path, path: Path) -> None:
    """Replaces a record or a plan by that of another request of the same run or sweep, if this was later."""
    if not target.exists() or _request_time(path) > _request_time(target):
        write_text(target, path.read_text("utf-8", "replace"))


def _request_time(path: Path) -> str:
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))["asked"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""


def _copy_run(folder: Path, into: Path) -> list[str]:
    """Copies a run; if `into` has another run of its cell, returns a line on which is kept and which archived."""
    target, earlier = into / "runs" / folder.name, into / "earlier"
    with file_lock(into, folder.name):
        if not target.exists():
            _copy_atomically(target, folder)
            return []
        (target_rank, kept), (folder_rank, archived) = _rank(target), _rank(folder)
        if target_rank[-1] == folder_rank[-1]:  # the same run
            _keep_later(target / "record.json", folder / "record.json")
            return []
        if folder_rank > target_rank:
            kept, archived = archived, kept
            archive_run(target, earlier)
            _copy_atomically(target, folder)
        else:
            _copy_atomically(earlier / f"{folder.name}-{folder_rank[-1]}", folder)
    return [f"{folder.name}: kept {kept}, set aside in earlier: {archived}"]


def _rank(folder: Path) -> tuple[tuple[Any, ...], str]:
    """The rank of a run (ok first, unfinished last, then by time and content), and its status and time as text."""
    try:
        record = read_record(folder)
    except (OSError, ValueError, RecursionError):
        record = {}
    status, started = record.get("status", "unreadable"), str(record.get("started"))
    finished = bool(record) and status not in UNFINISHED
    return (status == "ok", finished, bool(record), started, content_hash(folder)), f"{status} of {started}"


def main(arguments: list[str]) -> int:
    """Merges; prints a line for each replaced run, warnings, and the report's path last; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m bench.merge", description="Joins results folders.")
    parser.add_argument("sources", nargs="+", type=Path, metavar="FOLDER", help="results folders to join")
    parser.add_argument("--into", required=True, type=Path, metavar="FOLDER", help="where all of them go; may exist")
    options = parser.parse_args(arguments)
    try:
        lines, faults = merge(options.sources, options.into)
        for fault in faults:
            print(f"warning: {fault}", file=sys.stderr)
        print(*lines, write_index(options.into), sep="\n")
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
