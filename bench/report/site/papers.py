"""The tables and figures as the page shows them, and their charts from the CSV that their pages wrote."""

import hashlib
import json
from pathlib import Path
from typing import Any

from bench.report.write.paper import FOLDER, SMOKE, find_paper, find_sweeps

SHOWN = ("question", "verdict", "chart", "atlas")  # what `bench.report` adds to a page's files


def papers(results_dir: Path) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """The entry of each table and figure, those of sweeps last, and by its key all that its own view shows."""
    entries, wholes = [], {}
    pages = [(found, read_shown(results_dir / FOLDER / f"{found['name']}.json")) for found in find_paper(results_dir)]
    sweeps: list[tuple[dict[str, Any], dict[str, Any]]] = [(found, {}) for found in find_sweeps(results_dir)]
    for found, added in [*pages, *sweeps]:
        key = hashlib.sha256(found["name"].encode("utf-8", "surrogatepass")).hexdigest()[:16]
        texts = {name: added.get(name) or "" for name in ("question", "verdict")}
        if texts["verdict"] and found["caption"].startswith(SMOKE):
            texts["verdict"] = SMOKE
        entries.append(
            {"name": found["name"], "key": key, "title": (found["title"] or found["name"]).rstrip("."), **texts}
        )
        parts = {name: found[name] for name in ("caption", "notes", "header", "rows", "files", "picture")}
        wholes[key] = parts | {name: added.get(name) for name in ("chart", "atlas")}
    return entries, wholes


def read_shown(path: Path) -> dict[str, Any]:
    """What was added to a page; nothing where there is no such file, or it holds something else."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    kinds = {"question": str, "verdict": str, "chart": dict, "atlas": dict}
    sound = isinstance(found, dict)
    return {name: found[name] for name in SHOWN if isinstance(found.get(name), kinds[name])} if sound else {}
