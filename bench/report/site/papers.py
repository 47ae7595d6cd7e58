"""The tables and figures as the page shows them: those of the results folder, of sweeps, and those that are shipped."""

import hashlib
from pathlib import Path
from typing import Any

from bench.report.write import paper
from bench.report.write.paper import Found, find_paper, find_sweeps, found_at

BESIDE = "shipped: "  # in front of the name of a row that is shipped, beside rows of the user's own


def papers(results_dir: Path) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """The entry of each table and figure, those of sweeps last, and by its key all that its own view shows."""
    entries, wholes = [], {}
    for found in [*find_paper(results_dir), *find_sweeps(results_dir)]:
        key = hashlib.sha256(found.name.encode("utf-8", "surrogatepass")).hexdigest()[:16]
        shown = found.shown
        texts = {"question": shown.question, "verdict": shown.verdict, "shipped": found.shipped}
        entries.append({"name": found.name, "key": key, "title": (shown.title or found.name).rstrip("."), **texts})
        wholes[key] = {
            **{"caption": shown.caption, "notes": shown.notes, "header": shown.columns},
            **{"rows": shown.rows + beside(found, results_dir), "files": found.files, "picture": found.picture},
            **{"chart": shown.chart, "atlas": shown.atlas},
        }
    return entries, wholes


def beside(found: Found, results_dir: Path) -> list[list[str]]:
    """The shipped rows of a table of the user's, marked; none where its columns are others, or it is shipped itself."""
    if found.shipped or found.base.parents[1] != results_dir or results_dir.resolve() == paper.SHIPPED:
        return []
    shipped = found_at(paper.SHIPPED / paper.FOLDER, found.name, (paper.FOLDER,)).shown
    same = shipped.columns and shipped.columns == found.shown.columns
    return [[BESIDE + row[0], *row[1:]] for row in shipped.rows] if same else []
