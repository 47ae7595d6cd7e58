"""Writes the tables and figures of all experiments from run folders, and reads them back for index.html."""

import html
import os
import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote

FOLDER = "paper"
SUFFIXES = (".html", ".pdf", ".csv", ".md", ".tex")
PAGES = Path(__file__).parents[1] / "pages"  # a module per table or figure; its name is that of the written files


@cache
def page_names() -> tuple[str, ...]:
    """The names of all pages, in the order of the numbers that their files assign to `PLACE`.

    The files are read as text, not imported: they load matplotlib, which is not needed to find their output.

    Raises:
        ValueError: where a file has no such number.
    """
    places = {path.stem: _place(path) for path in PAGES.glob("*.py") if path.stem != "__init__"}
    return tuple(sorted(places, key=lambda name: (places[name], name)))


def write_paper(records: list[dict[str, Any]], results_dir: Path) -> list[Path]:
    """Writes the files of every page that has runs to `results_dir/paper`; gives the path of each page's CSV."""
    from bench.report.data.experiments import choose  # only here: matplotlib and scipy are not needed to find files
    from bench.report.write.result import write

    written = []
    for name in page_names():
        page = import_module(f"bench.report.pages.{name}")
        found = [choose(records, selection, results_dir) for selection in page.READS]
        if any(experiment is not None for experiment in found):
            written.append(write(page.make(*found), results_dir / FOLDER / name)[0])
    return written


def find_paper(results_dir: Path) -> list[dict[str, Any]]:
    """The contents of `results_dir/paper` for `index.html`: known pages first, then all others by name.

    Each has a name, title, caption, notes, the table's header and rows, and links to the picture and the files.
    """
    folder = results_dir / FOLDER
    seen = {path.stem for path in folder.glob("*") if path.suffix in (*SUFFIXES, ".png") and path.is_file()}
    names = [*(name for name in page_names() if name in seen), *sorted(seen - set(page_names()))]
    return [_found(folder, name) for name in names if not name.startswith(".")]


def _place(page: Path) -> int:
    found = re.search(r"^PLACE = (\d+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise ValueError(f"{page.name} must have a line such as PLACE = 10, its place among the pages; found none")
    return int(found[1])


def _found(folder: Path, name: str) -> dict[str, Any]:
    files = {suffix: folder / (name + suffix) for suffix in (*SUFFIXES, ".png")}
    links = {suffix: _link(path) for suffix, path in files.items() if path.is_file()}
    text = files[".md"].read_text(encoding="utf-8", errors="replace") if ".md" in links else ""
    picture = links.get(".png")
    links.pop(".png", None)
    named = {suffix[1:].upper(): link for suffix, link in links.items()}
    return {"name": name, "picture": picture, "files": named, **_parsed(text)}


def _parsed(markdown: str) -> dict[str, Any]:
    """The parts of a text that `result.markdown` wrote."""
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
