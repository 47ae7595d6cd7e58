"""The tables and figures of a paper's experiments: made from run folders, and found again for the page."""

import html
import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote

FOLDER = "paper"
SUFFIXES = (".html", ".pdf", ".csv", ".md", ".tex")
MAKERS = {  # each file's name, its experiment and what makes it, in the order of the page
    "table1": ("table1", "table1.make"),
    "table2": ("table2", "table2.make"),
    "table2_intervals": ("table2", "table2_intervals.make"),
    "table3": ("table3", "table3.make"),
    "fig10": ("fig10", "fig10.make"),
    "fig6": ("fig6", "fig6.make"),
    "priors": ("priors", "priors.make"),
    "speed_front": ("speed_accuracy", "speed_front.make"),
    "speed_curves": ("speed_accuracy", "speed_curves.make"),
    "speed_volume": ("speed_accuracy", "speed_front.volume"),
    "loss_chamfer": ("speed_accuracy", "speed_curves.correlation"),
    "stability": ("stability", "stability.make"),
    "stability_cost": ("stability", "stability.cost"),
    "stability_curves": ("stability", "stability_curves.make"),
    "stability_failures": ("stability", "stability_failures.make"),
    "parsimony": ("parsimony", "parsimony.make"),
    "parsimony_flops": ("parsimony", "parsimony.flops"),
    "parsimony_needs": ("parsimony", "parsimony_needs.make"),
    "parsimony_auto": ("parsimony", "parsimony_auto.make"),
    "gradients": ("gradients", "gradients.make"),
    "fig4": ("fig4", "fig4.make"),
    "fig5": ("fig5", "fig5.make"),
    "fig7": ("fig7", "fig7.make"),
}
ORDER = tuple(MAKERS)


def write_paper(records: list[dict[str, Any]], results_dir: Path) -> list[Path]:
    """Writes the files of every experiment that has records, to `results_dir/paper`; gives a CSV's path for each."""
    from bench.report.experiments import choose  # matplotlib and scipy: not needed to find the files
    from bench.report.tables import write

    written = []
    for experiment_name, maker in MAKERS.values():
        experiment = choose(records, experiment_name, results_dir)
        if experiment is not None:
            module, function = maker.split(".")
            make = getattr(import_module(f"bench.report.{module}"), function)
            written.append(write(make(experiment), results_dir / FOLDER)[0])
    return written


def find_paper(results_dir: Path) -> list[dict[str, Any]]:
    """What `results_dir/paper` holds, for the page: known experiments first, then all else by name.

    Each is its name, title, caption, notes, the table's header and rows, and links to the picture and the files.
    """
    folder = results_dir / FOLDER
    seen = {path.stem for path in folder.glob("*") if path.suffix in (*SUFFIXES, ".png") and path.is_file()}
    names = sorted((name for name in seen if not name.startswith(".")), key=lambda name: (_place(name), name))
    return [_found(folder, name) for name in names]


def _place(name: str) -> int:
    return ORDER.index(name) if name in ORDER else len(ORDER)


def _found(folder: Path, name: str) -> dict[str, Any]:
    files = {suffix: folder / (name + suffix) for suffix in (*SUFFIXES, ".png")}
    links = {suffix: _link(path) for suffix, path in files.items() if path.is_file()}
    text = files[".md"].read_text(encoding="utf-8", errors="replace") if ".md" in links else ""
    picture = links.get(".png")
    links.pop(".png", None)
    named = {suffix[1:].upper(): link for suffix, link in links.items()}
    return {"name": name, "picture": picture, "files": named, **_parsed(text)}


def _parsed(markdown: str) -> dict[str, Any]:
    """The parts of a page that `tables.markdown` wrote."""
    parts: dict[str, Any] = {"title": "", "caption": "", "header": [], "rows": [], "notes": []}
    for block in markdown.strip().split("\n\n"):
        if block.startswith("|"):
            header, *rows = [_cells(line) for line in block.splitlines()]
            parts |= {"header": header, "rows": rows[1:]}
        elif block.startswith("- "):
            parts["notes"] = [html.unescape(line.removeprefix("- ")) for line in block.splitlines()]
        elif not block.startswith("!["):
            title, caption = re.fullmatch(r"(?:\*\*(.*?)\*\*)?\s*(.*)", block, re.DOTALL).groups()
            parts |= {"title": html.unescape(title or ""), "caption": html.unescape(caption)}
    return parts


def _cells(line: str) -> list[str]:
    return [html.unescape(cell.strip()) for cell in line.strip().strip("|").split("|")]


def _link(path: Path) -> str:
    return "/".join(quote(os.fsencode(part), safe="") for part in (FOLDER, path.name))
