"""Writes the tables and figures of all studies and their index; finds the pages of a results folder."""

import csv
import hashlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any
from urllib.parse import quote

from bench.records.record import is_outside, write_text
from bench.records.results import PLAN_FILE
from bench.records.shipped import SHIPPED
from bench.report.data import page_version
from bench.report.data.kept import FROM_RUNS_CSV, join, read_rows, write_rows
from bench.report.data.runs import NoFolder, Runs, Selection, choose
from bench.report.write.caption import SMOKE_WARNING
from bench.report.write.result import Result, Shown, as_markdown, latex, read_shown, write, write_shown
from bench.tables import CONF, nearest, read_yaml

FOLDER = "paper"
PAGE_FOLDER = "page"
COPIES = (PAGE_FOLDER, "shipped")  # folder of the pictures of shipped pages
SWEEPS, TABLE = "sweeps", "table"  # the table of a sweep is next to its plan
SUFFIXES = (".pdf", ".csv", ".md", ".tex")
ROOT = Path(__file__).resolve().parents[3]
STUDIES = ROOT / "bench" / "studies"
SUITE_PAGE = "suite"  # its rows include the shipped ones
SHIPPED_ROW_PREFIX = "shipped: "
MAX_ANSWER_WORDS = 25  # as in tests.words

HEAD = """# Results

`make results` writes this page and [paper]({folder}): do not edit. Each question links to its page with the table, the
figure and the notes. The same folder has the table as CSV (raw numbers, in scene units), JSON and LaTeX, and the figure
as PNG and PDF. `python -m bench -m +experiment=NAME` makes the runs of an experiment again. [conf](../conf/README.md)
lists the experiments and how long they take. A page that cannot be drawn from rows names the version that drew it.

`suite` has the runs of the suite. `paper/NAME.runs.csv.gz` has the runs of the experiment NAME: one line per run, one
column per field. A cell is empty if the run has no such field.
`pandas.read_csv("results/paper/table3.runs.csv.gz")` reads it, in the checkout's folder.

| question | answer | experiment |
|---|---|---|
"""


RECORD_ERRORS = (KeyError, ValueError, TypeError, IndexError, AttributeError, ArithmeticError)


@dataclass(frozen=True)
class Study:
    """A file of `bench/studies`: its `PLACE` among all files, a `Selection` for each argument in `READS`, and `PAGES`.

    It may have `KEEPS`, which returns the folder of its rows in a results folder: then its pages are made without runs.
    """

    order: int
    reads: tuple[Selection, ...]
    pages: dict[str, Callable[..., Result]]
    problem: str = ""  # why the file cannot be read
    keeps: Callable[[Path], Path] | None = None

    def results(self, records: list[dict[str, Any]], results_dir: Path) -> dict[str, Result]:
        """The result of each page; empty without runs and kept rows. Raises ValueError for an unknown experiment.

        A page that needs run folders uses the runs that have them; it is left out if these are the minority. A page
        that shows none of the runs is left out too.
        """
        experiments = {record["config"].get("experiment") for record in records} | _experiments()
        for name in (selection.experiment for selection in self.reads if selection.experiment not in experiments):
            options = sorted(filter(None, experiments))
            raise ValueError(f"no run and no file of conf/experiment has experiment: {name}{nearest(name, options)}")
        chosen: list[Runs | None] = [choose(records, selection, results_dir) for selection in self.reads]
        if not any(runs is not None for runs in chosen):
            if self.keeps is None or not self.keeps(results_dir).is_dir():
                return {}
            chosen = [Runs(selection, results_dir, []) for selection in self.reads]
        results = {}
        for name, make in self.pages.items():
            try:
                result = make(*chosen)
                results |= {name: result} if result.runs.records or self.keeps is not None else {}
            except NoFolder:
                with_folder = [record for record in records if FROM_RUNS_CSV not in record]
                if 2 * self._count(with_folder, results_dir) >= self._count(records, results_dir):
                    results |= replace(self, pages={name: make}).results(with_folder, results_dir)
        return results

    def _count(self, records: list[dict[str, Any]], results_dir: Path) -> int:
        return sum(len(runs.records) for selection in self.reads if (runs := choose(records, selection, results_dir)))


@cache
def _experiments() -> frozenset[str]:
    return frozenset(read_yaml(file).get("experiment") for file in (CONF / "experiment").glob("*.yaml"))


@cache
def studies() -> tuple[Study, ...]:
    """All files of `bench/studies` by `order`; a file that cannot be read has only a problem."""
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
    """Writes the files of every page that has runs, or of one, to the folder `paper`; returns the pages' CSVs.

    Another `output_dir` than the results folder gets no pages of scale=smoke. `problems` gets a line for each study
    that fails; without it, the error is raised.
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
        except Exception as error:
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
    """A table or figure: its picture and files by kind, as percent-encoded paths relative to the results folder.

    A shipped page has no files. Its picture is the copy in `page/shipped`, if it has no chart.
    """

    name: str
    shown: Shown
    picture: str | None
    files: dict[str, str]
    base: Path
    shipped: bool = False


def find_paper(results_dir: Path) -> list[Page]:
    """The pages of `results_dir/paper` in their order, then shipped pages of other names."""
    own_pages = _pages_of(results_dir)
    own_names = {page.name for page in own_pages}
    others = [] if results_dir.resolve() == SHIPPED else _pages_of(SHIPPED)
    for page in (page for page in others if page.name not in own_names):
        is_copied = page.picture is not None and not (page.shown.chart or page.shown.atlas)
        picture = link(*COPIES, f"{page.name}.png") if is_copied else None
        own_pages.append(replace(page, picture=picture, files={}, shipped=True))
    return own_pages


def _pages_of(results_dir: Path) -> list[Page]:
    """The pages of a results folder in their order; pages without a study come last."""
    pages = [page_at(path.with_suffix(""), results_dir) for path in (results_dir / FOLDER).glob("[!.]*.json")]
    return sorted((page for page in pages if page.shown.title), key=lambda page: (page.shown.order or 10**6, page.name))


def find_sweeps(results_dir: Path) -> list[Page]:
    """The tables of sweeps by name of the sweep, the last requested first."""
    tables = (results_dir / SWEEPS).glob(f"*/{TABLE}.json")
    folders = sorted((path.parent for path in tables), key=lambda folder: (-_plan_time(folder), folder.name))
    return [replace(page_at(folder / TABLE, results_dir), name=folder.name) for folder in folders]


def papers(results_dir: Path) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]], list[Path]]:
    """The list entry of each page, sweeps last; the full content of each page by key; the pictures to be copied."""
    entries, content_by_key, copied = [], {}, []
    for page in [*find_paper(results_dir), *find_sweeps(results_dir)]:
        key = key_of(page.name)
        shown = page.shown
        copied += [page.base.with_suffix(".png")] if page.shipped and page.picture else []
        texts = {"question": shown.question, "verdict": shown.verdict, "shipped": page.shipped}
        sweeps = [] if page.shipped else _sweep_folders(page, results_dir)
        texts["asked"] = max(map(_plan_time, sweeps), default=0.0)
        entries.append({"name": page.name, "key": key, "title": (shown.title or page.name).rstrip("."), **texts})
        content_by_key[key] = {
            **{"caption": f"{shown.head} {shown.caption}".strip(), "notes": shown.notes, "header": shown.columns},
            **{"rows": shown.rows + _shipped_rows(page, results_dir), "files": page.files, "picture": page.picture},
            **{"command": shown.command, "folders": shown.folders, "best": shown.best},
            **{"chart": shown.chart, "atlas": shown.atlas},
        }
    return entries, content_by_key, copied


def _sweep_folders(page: Page, results_dir: Path) -> list[Path]:
    """The folders of the sweeps that a page of the user shows: its own, or those of its experiments."""
    if page.base.name == TABLE and page.base.parents[1].name == SWEEPS:
        return [page.base.parent]
    names = (f"{name}-*" for name in page.shown.experiments)
    folders = [folder for pattern in names for folder in (results_dir / SWEEPS).glob(pattern)]
    return [folder for folder in folders if not (folder / f"{TABLE}.json").is_file()]  # of a task without experiment


def _shipped_rows(page: Page, results_dir: Path) -> list[list[str]]:
    """The marked shipped rows for a table of the user; empty if its columns differ or it has these rows already."""
    is_of_user = not page.shipped and page.base.parents[1] == results_dir and results_dir.resolve() != SHIPPED
    if page.name == SUITE_PAGE or not is_of_user:
        return []
    shipped = page_at(SHIPPED / FOLDER / page.name, SHIPPED).shown
    has_same_columns = shipped.columns and shipped.columns == page.shown.columns
    return [[SHIPPED_ROW_PREFIX + row[0], *row[1:]] for row in shipped.rows] if has_same_columns else []


def ship(records: list[dict[str, Any]], results_dir: Path, output_dir: Path) -> list[Path]:
    """Adds the runs to the shipped files of runs, and redraws the shipped pages, also without run folders.

    A page that cannot be redrawn keeps its content, and its head names the version that drew it. Raises ValueError for
    damaged files.
    """
    all_records = join(records, read_rows(output_dir / FOLDER))
    experiments = [selection.experiment for study in studies() if study.keeps is None for selection in study.reads]
    rows = write_rows(all_records, experiments, output_dir / FOLDER)
    drawn = write_paper(all_records, results_dir, output_dir)
    own_rows = {name for study in studies() if study.keeps is not None for name in study.pages}
    for page in _pages_of(output_dir):
        table = page.base.with_suffix(".csv")
        if table not in drawn:
            stamp = "" if page.name in own_rows else page_version.drawn_by(table)
            write_shown(replace(page.shown, drawn_by=page.shown.drawn_by or stamp), page.base)
    return [*rows, *drawn]


def write_columns(results_dir: Path, options: dict[str, str]) -> None:
    """Writes the LaTeX table of each page or sweep with a key `columns.NAME` again, with only these headings."""
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
    """Writes `results_dir/README.md`, the index of all pages; returns its path, or None without pages."""
    if not (pages := _pages_of(results_dir)):
        return None
    path = results_dir / "README.md"
    write_text(path, HEAD.format(folder=FOLDER) + "".join(map(_line, pages)))
    return path


def _plan_time(folder: Path) -> float:
    """The time of the last request for a sweep, in seconds: that of its plan file; 0 without a plan."""
    plan = folder / PLAN_FILE
    return plan.stat().st_mtime if plan.is_file() else 0.0


def page_at(base: Path, root: Path) -> Page:
    """The page whose files have the path `base` before their suffix; links out of the folder are ignored."""
    files = {suffix: base.with_name(base.name + suffix) for suffix in (*SUFFIXES, ".png", ".json")}
    within = {suffix: path for suffix, path in files.items() if path.is_file() and not is_outside(path, root)}
    links = {suffix: link(*path.relative_to(root).parts) for suffix, path in within.items()}
    named = {suffix[1:].upper(): links[suffix] for suffix in SUFFIXES if suffix in links}
    shown = read_shown(within[".json"]) if ".json" in within else Shown()
    return Page(base.name, shown, links.get(".png"), named, base)


def link(*names: str) -> str:
    """The address of a file relative to the results folder, percent-encoded byte by byte."""
    return "/".join(quote(os.fsencode(name), safe="") for name in names)


def key_of(name: str) -> str:
    """The name of a data script: letters and digits, whatever the name of its run or table."""
    return hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:16]


def _short(answer: str) -> str:
    """The first sentence of an answer; a longer one ends after a clause with a number, or else after so many words."""
    sentence = re.split(r"(?<=[.!?]) (?=[A-Z])", answer)[0]
    ends = [word.end() for word in re.finditer(r"\w(\S*\w)?", sentence)]
    if len(ends) <= MAX_ANSWER_WORDS:
        return sentence
    start = sentence[: ends[MAX_ANSWER_WORDS - 1]]
    outside = re.sub(r"\([^()]*\)?", lambda inner: " " * len(inner[0]), start)  # commas in parentheses end no clause
    clauses = [start[: outside.rfind(mark)] for mark in ("; ", ": ", ", ") if mark in outside]
    return next((f"{clause}." for clause in clauses if re.search(r"\d", clause)), f"{start} ...")


def _line(page: Page) -> str:
    """A page's line of the index: its question with a link, its short answer and its experiments."""
    question = as_markdown(page.shown.question or page.shown.title.rstrip("."))
    answer = _short(page.shown.answer) + (f" (drawn by {page.shown.drawn_by})" if page.shown.drawn_by else "")
    experiments = ", ".join(f"`{name}`" for name in page.shown.experiments)
    return f"| [{question}]({FOLDER}/{page.name}.md) | {as_markdown(answer)} | {experiments} |\n"
