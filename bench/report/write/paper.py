"""Writes the tables and figures of all studies and their index; finds those of a results folder for index.html."""

import csv
import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any
from urllib.parse import quote

from bench.records.read import PLAN_FILE
from bench.records.record import is_outside, write_text
from bench.report.data import age
from bench.report.data.kept import FROM_RUNS_CSV, join, read_rows, write_rows
from bench.report.data.runs import NoFolder, Runs, Selection, choose
from bench.report.write.caption import SMOKE_WARNING
from bench.report.write.result import Result, Shown, as_markdown, latex, read_shown, write, write_shown

FOLDER = "paper"
SWEEPS, TABLE = "sweeps", "table"  # tables of sweeps lie beside their plans
SUFFIXES = (".pdf", ".csv", ".md", ".tex")
ROOT = Path(__file__).resolve().parents[3]
SHIPPED = ROOT / "results"  # what a checkout has; nothing where the package is installed without it
STUDIES = ROOT / "bench" / "studies"
SUITE_PAGE = "suite"  # the page whose own rows are among the shipped ones already
SHIPPED_ROW_PREFIX = "shipped: "  # in front of the name of a row that is shipped, beside rows of the user's own

HEAD = """# Results

`make results` writes this page and [paper]({folder}): do not edit. Each question links to its page with the table, the
figure and the notes. Beside the page are its table as CSV (raw numbers, in scene units), JSON and LaTeX, and its figure
as PNG and PDF. `python -m bench -m +experiment=NAME` makes the runs of an experiment again. [conf](../conf/README.md)
lists the experiments and how long they take. A page that cannot be drawn from rows names the version that drew it.

`paper/NAME.runs.csv.gz` has the runs of the experiment NAME: one line per run, one column per field, and an empty cell
where a run has no such field. `pandas.read_csv("results/paper/table3.runs.csv.gz")` reads it, in the checkout's folder.

| question | answer | experiment |
|---|---|---|
"""


RECORD_ERRORS = (
    KeyError,
    ValueError,
    TypeError,
    IndexError,
    AttributeError,
    ArithmeticError,
)  # of an odd or foreign record


@dataclass(frozen=True)
class Study:
    """A file of `bench/studies`: the runs that it reads, and its pages, each made of them by a function.

    A file has `PLACE`, its place among all, `READS`, a `Selection` for each argument of its functions, and `PAGES`,
    these functions by the names of their pages. It may have `KEEPS`, which gives the folder of rows that a results
    folder keeps of it: with that, its pages are made without runs too.
    """

    order: int
    reads: tuple[Selection, ...]
    pages: dict[str, Callable[..., Result]]
    problem: str = ""  # of a file that cannot be read
    keeps: Callable[[Path], Path] | None = None

    def results(self, records: list[dict[str, Any]], results_dir: Path) -> dict[str, Result]:
        """The result of each page; none where there is no run of it, and no row is kept.

        A page that needs run folders is made of the runs that have theirs; it is left out where these are the fewer.
        """
        chosen: list[Runs | None] = [choose(records, selection, results_dir) for selection in self.reads]
        if not any(runs is not None for runs in chosen):
            if self.keeps is None or not self.keeps(results_dir).is_dir():
                return {}
            chosen = [Runs(selection, results_dir, []) for selection in self.reads]
        results = {}
        for name, make in self.pages.items():
            try:
                results[name] = make(*chosen)
            except NoFolder:
                with_folder = [record for record in records if FROM_RUNS_CSV not in record]
                if 2 * self._count(with_folder, results_dir) >= self._count(records, results_dir):
                    results |= replace(self, pages={name: make}).results(with_folder, results_dir)
        return results

    def _count(self, records: list[dict[str, Any]], results_dir: Path) -> int:
        return sum(len(runs.records) for selection in self.reads if (runs := choose(records, selection, results_dir)))


@cache
def studies() -> tuple[Study, ...]:
    """All files of `bench/studies`, in the order of their places; a file that cannot be read has a problem alone."""
    studies_read: list[Study] = []
    for file in iter_modules([str(STUDIES)]):
        try:
            module = import_module(f"bench.studies.{file.name}")
            if repeated := {name for study in studies_read for name in study.pages} & {*module.PAGES}:
                raise ValueError(f"another study has a page {min(repeated)}: give it another name")
            studies_read.append(Study(module.PLACE, module.READS, module.PAGES, keeps=getattr(module, "KEEPS", None)))
        except (*RECORD_ERRORS, ImportError, NameError, SyntaxError) as error:
            studies_read.append(Study(0, (), {}, f"bench/studies/{file.name}.py ({type(error).__name__}: {error})"))
    return tuple(sorted(studies_read, key=lambda study: study.order))


def write_paper(
    records: list[dict[str, Any]],
    results_dir: Path,
    output_dir: Path | None = None,
    problems: list[str] | None = None,
    only: str | None = None,
) -> list[Path]:
    """Writes the files of every page that has runs to the folder `paper`; gives the path of each page's CSV.

    Args:
        into: the folder that gets `paper`; by default the results folder. Where it is another, it is what is shipped:
            pages of runs of scale=smoke are left out.
        problems: gets a line for each study that cannot be made of these runs; without it, its error is raised.
        only: the name of a page, where no other is written.
    """
    written = []
    for study in studies() if only is None else [study for study in studies() if only in study.pages]:
        experiments = [selection.experiment for selection in study.reads]
        try:
            if study.problem:
                raise ValueError(study.problem)
            results = study.results(records, results_dir)
            pages = [
                (name, result, result.shown(100 * study.order + number, experiments))
                for number, (name, result) in enumerate(results.items())
            ]
        except RECORD_ERRORS as error:
            if problems is None:
                raise
            description = f"{', '.join(study.pages)} ({type(error).__name__}: {error})"
            problems.append(f"not made: {study.problem or description}")
            continue
        for name, result, shown in pages:
            if output_dir is None or not shown.caption.startswith(SMOKE_WARNING):
                written.append(write(result, shown, (output_dir or results_dir) / FOLDER / name)[0])
    return written


@dataclass(frozen=True)
class Page:
    """A table or figure of a results folder: its name, what it says, its picture and its files by their kind.

    Paths of files are seen from the results folder, percent-encoded; `shipped` ones have none.
    """

    name: str
    shown: Shown
    picture: str | None
    files: dict[str, str]
    base: Path
    shipped: bool = False


def find_paper(results_dir: Path) -> list[Page]:
    """The tables and figures of `results_dir/paper` in their order, then shipped ones of other names."""
    own_pages = _pages_of(results_dir)
    own_names = {page.name for page in own_pages}
    others = [] if results_dir.resolve() == SHIPPED else _pages_of(SHIPPED)
    shipped = [page for page in others if page.name not in own_names]
    return own_pages + [replace(page, picture=None, files={}, shipped=True) for page in shipped]


def _pages_of(results_dir: Path) -> list[Page]:
    """The tables and figures of a results folder in their order; those that no study made stand last."""
    pages = [page_at(path.with_suffix(""), results_dir) for path in (results_dir / FOLDER).glob("[!.]*.json")]
    return sorted((page for page in pages if page.shown.title), key=lambda page: (page.shown.order or 10**6, page.name))


def find_sweeps(results_dir: Path) -> list[Page]:
    """The tables of sweeps, the sweep that was asked for last first, each by the name of its sweep."""
    tables = (results_dir / SWEEPS).glob(f"*/{TABLE}.json")
    folders = sorted((path.parent for path in tables), key=lambda folder: (-_plan_time(folder), folder.name))
    return [replace(page_at(folder / TABLE, results_dir), name=folder.name) for folder in folders]


def papers(results_dir: Path) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """The entry of each table and figure, those of sweeps last, and by its key all that its own view shows."""
    entries, content_by_key = [], {}
    for page in [*find_paper(results_dir), *find_sweeps(results_dir)]:
        key = key_of(page.name)
        shown = page.shown
        texts = {"question": shown.question, "verdict": shown.verdict, "shipped": page.shipped}
        texts["sweep"] = page.base.name == TABLE and page.base.parents[1].name == SWEEPS
        entries.append({"name": page.name, "key": key, "title": (shown.title or page.name).rstrip("."), **texts})
        content_by_key[key] = {
            **{"caption": f"{shown.head} {shown.caption}".strip(), "notes": shown.notes, "header": shown.columns},
            **{"rows": shown.rows + _shipped_rows(page, results_dir), "files": page.files, "picture": page.picture},
            **{"chart": shown.chart, "atlas": shown.atlas, "best": shown.best},
        }
    return entries, content_by_key


def _shipped_rows(page: Page, results_dir: Path) -> list[list[str]]:
    """The shipped rows of a table of the user's, marked; none where it has them, has other columns, or is shipped."""
    is_of_user = not page.shipped and page.base.parents[1] == results_dir and results_dir.resolve() != SHIPPED
    if page.name == SUITE_PAGE or not is_of_user:
        return []
    shipped = page_at(SHIPPED / FOLDER / page.name, SHIPPED).shown
    has_same_columns = shipped.columns and shipped.columns == page.shown.columns
    return [[SHIPPED_ROW_PREFIX + row[0], *row[1:]] for row in shipped.rows] if has_same_columns else []


def ship(records: list[dict[str, Any]], results_dir: Path, output_dir: Path) -> list[Path]:
    """Adds the rows of runs to those of shipped tables, and draws these anew, with or without the runs' folders.

    A page that cannot be drawn keeps what it says, in this version's form, and its head says which version drew it.

    Raises:
        ValueError: where rows that are there cannot be read, and would be lost.
    """
    all_records = join(records, read_rows(output_dir / FOLDER))
    experiments = [selection.experiment for study in studies() if study.keeps is None for selection in study.reads]
    rows = write_rows(all_records, experiments, output_dir / FOLDER)
    drawn = write_paper(all_records, results_dir, output_dir)
    own_rows = {name for study in studies() if study.keeps is not None for name in study.pages}
    for page in _pages_of(output_dir):
        table = page.base.with_suffix(".csv")
        if table not in drawn:
            stamp = "" if page.name in own_rows else age.drawn_by(table)
            write_shown(replace(page.shown, drawn_by=page.shown.drawn_by or stamp), page.base)
    return [*rows, *drawn]


def write_columns(results_dir: Path, options: dict[str, str]) -> None:
    """Writes the LaTeX table of each page or sweep of a key `columns.NAME` again, with these headings alone.

    Raises:
        ValueError: where there is no such table, or it has no such column.
    """
    tables = {page.name: page for page in [*_pages_of(results_dir), *find_sweeps(results_dir)] if page.shown.columns}
    for key in (key for key in options if key.startswith("columns.")):
        if (page := tables.get(key.removeprefix("columns."))) is None:
            raise ValueError(f"{key}: no table of that name; there are {', '.join(tables) or 'none'}")
        headings = next(csv.reader([options[key]], skipinitialspace=True))
        if unknown := [heading for heading in headings if heading not in page.shown.columns]:
            choices = ",".join(f'"{heading}"' if "," in heading else heading for heading in page.shown.columns)
            raise ValueError(f"{key}: no column {unknown[0]!r}; choose from {choices}")
        write_text(page.base.with_suffix(".tex"), latex(page.shown.narrowed(headings), page.name))


def write_readme(results_dir: Path) -> Path | None:
    """Writes `results_dir/README.md`, the index of all pages; gives its path, or None where there is no page."""
    if not (pages := _pages_of(results_dir)):
        return None
    path = results_dir / "README.md"
    write_text(path, HEAD.format(folder=FOLDER) + "".join(map(_line, pages)))
    return path


def _plan_time(folder: Path) -> float:
    """When the sweep of a folder was last asked for, as its plan was written then; 0 where there is no plan."""
    plan = folder / PLAN_FILE
    return plan.stat().st_mtime if plan.is_file() else 0.0


def page_at(base: Path, root: Path) -> Page:
    """The table or figure whose files in a results folder have that path before their suffix, but for links out."""
    files = {suffix: base.with_name(base.name + suffix) for suffix in (*SUFFIXES, ".png", ".json")}
    within = {suffix: path for suffix, path in files.items() if path.is_file() and not is_outside(path, root)}
    links = {suffix: link(*path.relative_to(root).parts) for suffix, path in within.items()}
    named = {suffix[1:].upper(): links[suffix] for suffix in SUFFIXES if suffix in links}
    shown = read_shown(within[".json"]) if ".json" in within else Shown()
    return Page(base.name, shown, links.get(".png"), named, base)


def link(*parts: str) -> str:
    """The address of a file as seen from the results folder, percent-encoded byte for byte."""
    return "/".join(quote(os.fsencode(part), safe="") for part in parts)


def key_of(name: str) -> str:
    """The name of a script of data: letters and digits, whatever its run or table is called."""
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:16]


def _line(page: Page) -> str:
    """A page's line of the index: its question with a link, its answer and its experiments."""
    question = as_markdown(page.shown.question or page.shown.title.rstrip("."))
    answer = page.shown.answer + (f" (drawn by {page.shown.drawn_by})" if page.shown.drawn_by else "")
    experiments = ", ".join(f"`{name}`" for name in page.shown.experiments)
    return f"| [{question}]({FOLDER}/{page.name}.md) | {as_markdown(answer)} | {experiments} |\n"
