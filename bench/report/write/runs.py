"""Writes the scripts with the details and meshes of runs; those of runs that have not changed stay as they are."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.records.read import not_run, plan_paths, read_plan, read_run, run_folders
from bench.records.record import started
from bench.report.site.columns import entry
from bench.report.site.detail import detail
from bench.report.site.files import Folder
from bench.report.site.known import Known, file_stamp, run_stamp
from bench.report.site.script import remove_others, to_script, write_script

MOST_MESHES = 500  # of the newest runs; `bench.report meshes=all` makes all


@dataclass(frozen=True)
class Written:
    """The entries of all runs in the list, newest first, and a message for each run or plan that cannot be read."""

    entries: list[dict[str, Any]]
    problems: list[str]


def write_runs(results_dir: Path, data: Path, *, meshes: int | None, anew: bool) -> Written:
    """Writes `data/run` and `data/mesh`.

    Args:
        results_dir: the results folder.
        data: the folder of the page's data.
        meshes: of how many runs, the newest first, the mesh is made; None for all.
        anew: whether all runs are read, also those that have not changed.
    """
    known = Known(results_dir, data, anew=anew)
    entries, problems = _finished(results_dir, data, known)
    planned, unread = _planned(results_dir, data, known, {one["folder"] for one in entries})
    entries = sorted([*entries, *planned], key=lambda one: one["started"], reverse=True)
    remove_others(data / "run", (one["key"] for one in entries))
    _write_meshes(results_dir, data / "mesh", [one for one in entries if one["mesh"]], known, meshes)
    known.write()
    return Written(entries, problems + unread)


def _finished(results_dir: Path, data: Path, known: Known) -> tuple[list[dict[str, Any]], list[str]]:
    """The entries of the runs that have a folder, and why some cannot be read."""
    entries, problems = [], []
    for folder in run_folders(results_dir):
        stamp = run_stamp(folder)  # before it is read: what changes later is seen the next time
        found = known.entry(folder.name, stamp)
        if found is None:
            record, problem = read_run(folder, results_dir)
            if record is None:
                problems.append(problem)
                continue
            found = _written(record, results_dir, data, known, stamp)
        entries.append(found)
    return entries, problems


def _planned(results_dir: Path, data: Path, known: Known, there: set[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """The entries of planned cells without a folder, and why some plans cannot be read."""
    entries, problems = {}, []
    for path in plan_paths(results_dir):
        stamp = file_stamp(path)
        names = known.cells(path.parent.name, stamp)
        there |= entries.keys()  # a cell that an earlier plan has as well
        missing = [name for name in names or () if name not in there]
        found = {name: known.entry(name, stamp) for name in missing}
        if names is None or None in found.values():
            plan, problem = read_plan(path, results_dir)
            if plan is None:
                problems.append(problem)
                continue
            known.keep_cells(plan["name"], stamp, [cell["id"] for cell in plan["cells"]])
            cells = {cell["id"]: cell for cell in plan["cells"] if cell["id"] not in there}
            found = {
                name: _written(not_run(cell, plan), results_dir, data, known, stamp) for name, cell in cells.items()
            }
        entries |= found
    return list(entries.values()), problems


def _written(record: dict[str, Any], results_dir: Path, data: Path, known: Known, stamp: Any) -> dict[str, Any]:
    """The entry of a record, whose details are written."""
    folder = Folder(results_dir, record["folder"])
    write_script(data / "run" / f"{folder.key}.js", to_script("run", folder.key, detail(record, folder, results_dir)))
    found = entry(record, folder) | {"started": started(record).timestamp(), "mesh": folder.has("mesh.ply")}
    known.keep(found, stamp)
    return found


def _write_meshes(
    results_dir: Path, folder: Path, entries: list[dict[str, Any]], known: Known, most: int | None
) -> None:
    """Writes the meshes of the newest runs; one that is there and newer than its mesh is kept."""
    for number, one in enumerate(entries):
        wanted = most is None or number < most
        if known.has_mesh(one, wanted=wanted):
            continue
        path, source = folder / f"{one['key']}.js", results_dir / "runs" / one["folder"] / "mesh.ply"
        there = _is_newer(path, source, one["key"])
        if not there:
            write_script(path, to_script("mesh", one["key"], _mesh(source) if wanted else _left_out(most)))
        known.keep_mesh(one, made=there or wanted)
    remove_others(folder, (one["key"] for one in entries))


def _mesh(source: Path) -> dict[str, Any]:
    """The mesh as the page takes it, or why it cannot be shown."""
    from bench.report.site.meshes import mesh_data

    try:
        return mesh_data(source)
    except (OSError, ValueError) as error:
        return {"none": f"The mesh cannot be shown: {error}."}


def _left_out(most: int | None) -> dict[str, str]:
    return {"none": f"Made for the newest {most} runs: `python -m bench.report meshes=all` makes all."}


def _is_newer(path: Path, source: Path, key: str) -> bool:
    """Whether a mesh was made after its source, and the script holds a mesh and nothing else."""
    try:
        if path.is_symlink() or path.stat().st_mtime_ns <= source.stat().st_mtime_ns:
            return False
        head, tail = to_script("mesh", key, 0).split("0);")
        text = path.read_text(encoding="ascii")
        data = json.loads(text.removeprefix(head).removesuffix(f");{tail}"))
        return isinstance(data, dict) and "vertices" in data and text == to_script("mesh", key, data)
    except (OSError, ValueError, RecursionError):
        return False
