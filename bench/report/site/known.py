"""What the page has of runs already, so that a run that ends writes what is new and reads no other run again.

`page/known.jsonl` has a line for each run: its entry in the list, and the stamps of its files and of the scripts that
were made of them. A stamp has the time of the last change of a file's status, which no archive and nobody can set: what
was edited, copied, unpacked or put there by somebody else has another one, and is read and written anew. The file
itself must be this user's. So scripts of somebody else's page are never taken for ours.
"""

import json
import os
import stat
from functools import cache
from pathlib import Path
from typing import Any

from bench.records.files import digest, write_text

FILE = "known.jsonl"
CODE = ("records", "report/data", "report/site", "report/write")  # of this package: what scripts of a page depend on
FIELDS = {  # of each kind of line, beside its kind and name
    "run": {"stamp", "script", "settings", "entry"},
    "mesh": {"script", "made", "of"},
    "plan": {"stamp", "cells"},
    "settings": {"settings"},
}
ENTRY = {"key", "folder", "started", "mesh"}  # of an entry, at least
SPARE, FEW = 2, 100  # a file with more lines than that many times those in use, and some, is written anew
Stamp = list[int] | None


def file_stamp(path: Path | str) -> Stamp:
    """What differs when a file has changed; None for what is no file, such as a link."""
    try:
        found = os.lstat(path)
    except OSError:
        return None
    return [found.st_ino, found.st_ctime_ns, found.st_size] if stat.S_ISREG(found.st_mode) else None


def run_stamp(folder: Path) -> Stamp:
    """What differs when a run's folder has other files, or what the page shows of them has changed.

    None where the folder or one of these files is a link.
    """
    record = file_stamp(f"{folder}/record.json")
    try:
        found = os.lstat(folder)
    except OSError:
        return None
    others = [f"{folder}/{name}" for name in ("curve.jsonl", "mesh.ply")]
    if record is None or not stat.S_ISDIR(found.st_mode) or any(map(os.path.islink, others)):
        return None
    return [found.st_ino, found.st_ctime_ns, *record, *(number for one in others for number in file_stamp(one) or [0])]


class Known:
    """The runs that a page has, with their stamps. What is asked for is None, or False, where it has changed."""

    def __init__(self, results_dir: Path, data: Path, *, anew: bool) -> None:
        self.path, self.data = data.parent / FILE, data
        self.head = {"code": _code(), "results_dir": results_dir.as_posix()}
        self.lines: list[dict[str, Any]] = []  # that are not in the file yet
        self.parts: dict[str, dict[str, Any]] = {"run": {}, "mesh": {}, "plan": {}, "settings": {}}
        self.read = 0  # lines that the file has; 0 where it is written anew
        if not anew:
            self._load()

    def entry(self, name: str, stamp: Stamp) -> dict[str, Any] | None:
        """The entry of a run."""
        line = self.parts["run"].get(name)
        if line is None or stamp is None or line["stamp"] != stamp:
            return None
        found = line["entry"]
        if line["script"] is None or file_stamp(f"{self.data}/run/{found['key']}.js") != line["script"]:
            return None
        return found | {"settings": self.parts["settings"][line["settings"]]["settings"]}

    def keep(self, entry: dict[str, Any], stamp: Stamp) -> None:
        """Keeps the entry of a run whose script was written just now."""
        key = digest(entry["settings"])
        if key not in self.parts["settings"]:
            self._add("settings", key, {"settings": entry["settings"]})
        script = file_stamp(self.data / "run" / f"{entry['key']}.js")
        rest = {name: value for name, value in entry.items() if name != "settings"}
        self._add("run", entry["folder"], {"stamp": stamp, "script": script, "settings": key, "entry": rest})

    def cells(self, plan: str, stamp: Stamp) -> list[str] | None:
        """The names of the run folders of a plan."""
        line = self.parts["plan"].get(plan)
        return line["cells"] if line and stamp is not None and line["stamp"] == stamp else None

    def keep_cells(self, plan: str, stamp: Stamp, cells: list[str]) -> None:
        """Keeps the names of the run folders of a plan."""
        self._add("plan", plan, {"stamp": stamp, "cells": cells})

    def has_mesh(self, entry: dict[str, Any], *, wanted: bool) -> bool:
        """Whether the script of a run's mesh is there, with the mesh if it is wanted."""
        line = self.parts["mesh"].get(entry["folder"])
        if line is None or (wanted and not line["made"]) or None in (line["script"], line["of"]):
            return False
        return line["of"] == self._of(entry) and file_stamp(self.data / "mesh" / f"{entry['key']}.js") == line["script"]

    def keep_mesh(self, entry: dict[str, Any], *, made: bool) -> None:
        """Keeps that the script of a run's mesh was written; `made` where it holds more than why there is no mesh."""
        script = file_stamp(self.data / "mesh" / f"{entry['key']}.js")
        self._add("mesh", entry["folder"], {"script": script, "made": made, "of": self._of(entry)})

    def write(self) -> None:
        """Writes what was kept: behind what the file has, or all of it where the file is not of use."""
        known = {(kind, name): line for kind, lines in self.parts.items() for name, line in lines.items()}
        if self.read and self.read + len(self.lines) <= SPARE * len(known) + FEW:
            with self.path.open("a", encoding="ascii") as file:
                file.write("".join(map(_line, self.lines)))
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_text(self.path, "".join(map(_line, [self.head, *known.values()])))

    def _of(self, entry: dict[str, Any]) -> Stamp:
        """The stamp of the run that a mesh is of."""
        line = self.parts["run"].get(entry["folder"])
        return line["stamp"] if line else None

    def _add(self, kind: str, name: str, content: dict[str, Any]) -> None:
        line = {"kind": kind, "name": name, **content}
        self.parts[kind][name] = line
        self.lines.append(line)

    def _load(self) -> None:
        """Reads the file; leaves all unknown where it is another's, of other code or another folder, or torn."""
        if file_stamp(self.path) is None or self.path.stat().st_uid != os.geteuid():
            return
        try:
            head, *lines = self.path.read_text(encoding="ascii").split("\n")
            if lines[-1:] != [""] or json.loads(head) != self.head:
                return
            found = json.loads(f"[{','.join(lines[:-1])}]")
            parts: dict[str, dict[str, Any]] = {kind: {} for kind in self.parts}
            for line in found:
                if FIELDS[line["kind"]] - {*line} or ENTRY - {*line.get("entry", ENTRY)}:
                    return
                parts[line["kind"]][line["name"]] = line
            if any(line["settings"] not in parts["settings"] for line in parts["run"].values()):
                return
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return
        self.parts, self.read = parts, len(lines)


def _line(content: dict[str, Any]) -> str:
    return json.dumps(content, separators=(",", ":")) + "\n"


@cache
def _code() -> str:
    """A hash of the code that the scripts of a page depend on."""
    package = Path(__file__).parents[2]
    return digest([path.read_text(encoding="utf-8") for part in CODE for path in sorted((package / part).glob("*.py"))])
