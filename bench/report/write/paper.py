"""Writes the tables and figures of all experiments and their README; reads these and sweeps' tables for index.html."""

import html
import os
import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import quote

from bench.records.files import leads_out, write_text
from bench.records.read import PLAN

FOLDER = "paper"
SWEEPS, TABLE = "sweeps", "table"  # tables of sweeps lie beside their plans
SMOKE = "Made at scale=smoke, to try things out: nothing follows from these numbers."  # at the beginning of a caption
SUFFIXES = (".pdf", ".csv", ".md", ".tex")
PAGES = Path(__file__).parents[1] / "pages"
PLACE = re.compile(r"^PLACE(_[A-Z_]+)? = (\d+)$", re.MULTILINE)

HEAD = """# Results

Written by `python -m bench.report` from [{folder}]({folder}): do not edit. Each table is there as CSV (raw numbers, in
scene units), Markdown and LaTeX, each figure as PNG and PDF. `python -m bench -m +experiment=NAME` makes the runs of
the experiment that a page names; the README of `conf` lists the experiments and how long they take.

"""


@cache
def page_names() -> dict[str, tuple[str, str]]:
    """The names of all pages in their order, each with the module and the function that make it.

    A file of `PAGES`, in any of its rooms, makes the page of its name with `make`; its place among all pages is the
    number `PLACE`. Further pages of the file have a suffix: `PLACE_COST` and `make_cost` are those of FILE_cost. The
    files are read as text, not imported: they load matplotlib, which is not needed to find their output.

    Raises:
        ValueError: where a file has no such number.
    """
    places: list[tuple[int, str, str, str]] = []
    for path in PAGES.rglob("[!_]*.py"):
        module = ".".join(path.relative_to(PAGES).with_suffix("").parts)
        own = [(suffix.lower(), int(place)) for suffix, place in PLACE.findall(path.read_text(encoding="utf-8"))]
        if not own:
            raise ValueError(f"{path.name} must have a line such as PLACE = 10, its place among the pages; found none")
        places += [(place, path.stem + suffix, module, f"make{suffix}") for suffix, place in own]
    return {name: (module, function) for _, name, module, function in sorted(places)}


def write_paper(records: list[dict[str, Any]], results_dir: Path) -> list[Path]:
    """Writes the files of every page that has runs to `results_dir/paper`; gives the path of each page's CSV."""
    from bench.report.data.experiments import choose  # only here: matplotlib and scipy are not needed to find files
    from bench.report.write.result import write

    written = []
    for name, (module, function) in page_names().items():
        page = import_module(f"bench.report.pages.{module}")
        chosen = [choose(records, selection, results_dir) for selection in page.READS]
        if any(experiment is not None for experiment in chosen):
            written.append(write(getattr(page, function)(*chosen), results_dir / FOLDER / name)[0])
    return written


def find_paper(results_dir: Path) -> list[dict[str, Any]]:
    """The contents of `results_dir/paper` for `index.html`: known pages first, then all others by name.

    Each has a name, title, caption, notes, the table's header and rows, and links to the picture and the files.
    """
    folder = results_dir / FOLDER
    kinds = (*SUFFIXES, ".png")
    seen = {
        path.stem
        for path in folder.glob("*")
        if path.suffix in kinds and path.is_file() and not leads_out(path, results_dir)
    }
    names = [*(name for name in page_names() if name in seen), *sorted(seen - {*page_names()})]
    return [found(folder, name, (FOLDER,)) for name in names if not name.startswith(".")]


def find_sweeps(results_dir: Path) -> list[dict[str, Any]]:
    """The tables of sweeps for `index.html`, the sweep that was asked for last first.

    Each has what `find_paper` gives: a name, title, caption, notes, the table's header and rows, links to the files.
    """
    tables = (results_dir / SWEEPS).glob(f"*/{TABLE}.md")
    folders = sorted((path.parent for path in tables), key=lambda folder: (-_asked(folder), folder.name))
    return [found(folder, TABLE, (SWEEPS, folder.name)) | {"name": folder.name} for folder in folders]


def write_readme(results_dir: Path) -> Path | None:
    """Writes `results_dir/README.md` with all tables and figures, so that no number is copied by hand.

    Gives its path; None where `results_dir/paper` has no table or figure.
    """
    pages = [page for page in find_paper(results_dir) if page["title"]]
    if not pages:
        return None
    contents = [f"- [{page['title'].rstrip('.')}](#{page['name']})" for page in pages]
    parts = [_section(results_dir / FOLDER / f"{page['name']}.md", page["name"]) for page in pages]
    path = results_dir / "README.md"
    write_text(path, HEAD.format(folder=FOLDER) + "\n".join(contents) + "\n\n" + "\n".join(parts))
    return path


def _asked(folder: Path) -> float:
    """When the sweep of a folder was last asked for, as its plan was written then; 0 where there is no plan."""
    plan = folder / PLAN
    return plan.stat().st_mtime if plan.is_file() else 0.0


def found(folder: Path, name: str, place: tuple[str, ...]) -> dict[str, Any]:
    """The contents of the table or figure of that name, whose folder is at a place in the results folder."""
    files = {suffix: folder / (name + suffix) for suffix in (*SUFFIXES, ".png")}
    root = folder.parents[len(place) - 1]
    within = {suffix: path for suffix, path in files.items() if path.is_file() and not leads_out(path, root)}
    links = {suffix: link(*place, path.name) for suffix, path in within.items()}
    picture = links.get(".png")
    links.pop(".png", None)
    named = {suffix[1:].upper(): link for suffix, link in links.items()}
    return {"name": name, "picture": picture, "files": named, **read_page(folder / name)}


def read_page(base: Path) -> dict[str, Any]:
    """The title, caption, table and notes of `base.md`; empty ones where there is no such file."""
    path = base.with_name(base.name + ".md")
    sound = path.is_file() and not leads_out(path, base.parents[1])
    return _parsed(path.read_text(encoding="utf-8", errors="replace") if sound else "")


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


def link(*parts: str) -> str:
    """The address of a file as seen from the results folder, percent-encoded byte for byte."""
    return "/".join(quote(os.fsencode(part), safe="") for part in parts)


def _section(path: Path, name: str) -> str:
    """A page's Markdown under a heading, with its experiment, folded notes and links relative to the folder above."""
    text = path.read_text(encoding="utf-8", errors="replace").replace(f"]({name}.png)", f"]({FOLDER}/{name}.png)")
    module, _ = page_names().get(name, ("", ""))
    selections = import_module(f"bench.report.pages.{module}").READS if module else ()
    read = ", ".join(f"`{one}`" for one in dict.fromkeys(each.experiment for each in selections))
    text = re.sub(r"((?:^- .*\n)+)", r"<details><summary>Notes</summary>\n\n\1\n</details>\n", text, flags=re.MULTILINE)
    title, rest = re.fullmatch(r"\*\*(.*?)\*\*\s*(.*)", text, re.DOTALL).groups()
    return f'## <a id="{name}"></a>{title}\n\n' + (f"Experiment: {read}.\n\n" if read else "") + rest
