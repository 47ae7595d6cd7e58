"""The result of a study, and its output as CSV, JSON, Markdown, LaTeX, PNG and PDF."""

import json
import re
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.pictures.figure_style import RC
from bench.records.format import seconds
from bench.records.record import to_json_values
from bench.report.data import page_version
from bench.report.data.runs import Runs
from bench.report.data.statistics import Interval
from bench.report.write import caption
from bench.report.write.table import Column, best, to_data, to_table

# Special characters of LaTeX, and characters that its standard fonts lack. A row that begins with a bracket would be
# read as the argument of the preceding line break.
_LATEX = {
    "\\": r"\textbackslash{}",
    "[": "{[}",
    **{character: "\\" + character for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "“": "``",
    "”": "''",
    "–": "--",
    "★": r"$\star$",
    "—": "---",
    "…": r"\ldots{}",
    "∞": r"$\infty$",
    "×": r"$\times$",
    "±": r"$\pm$",
    **{raised: f"$^{sign}$" for raised, sign in zip("²³⁻", "23-", strict=True)},
    "`": "'",
    "→": r"$\rightarrow$",
    "↓": r"$\downarrow$",
    "↑": r"$\uparrow$",
    "°": r"$^\circ$",
    "ρ": r"$\rho$",
    "σ": r"$\sigma$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "µ": r"$\mu$",
}
_POWER = re.compile(r"(?<![\w.-])(-?\d+(?:\.\d+)?)e\+?(-?\d+)(?!\w)")  # such as 2.2e-5
JSON_KEYS = {"order": "place"}  # fields of Shown with another name in the shipped files
# Characters that Markdown or HTML would read as signs. Brackets are, where they could form a link or a check box.
_MARKDOWN_SIGN = r"[\\`*|<]|&(?=#?\w+;)"
_MARKDOWN_CODE = r"`[\w.=/+-]+(?: [\w.=/+-]+)*`"  # such as `not_reached`
_MARKDOWN_LINK = re.compile(r"\][(:]|\]\s*\[|^\[[ xX]\]")


@dataclass(frozen=True)
class Result:
    """A table, a figure or both, with the question that it answers."""

    runs: Runs
    title: str  # as a sentence
    plotted: str  # what is plotted, as a sentence
    question: str = ""  # as a reader would ask it; empty for a page of pictures
    verdict: str = ""  # the answer, one sentence with its numbers between asterisks; empty if the runs do not give it
    command: str = ""  # that makes the runs; empty: that of the experiment
    folders: dict[str, list[str]] = field(default_factory=dict)  # of runs, by the text of a first cell
    n: str = ""  # the sample; empty: the numbers of runs, shapes and seeds
    interval: str = ""  # its kind; empty for none
    estimates: Iterable[Interval] = ()  # that may lack an interval; empty if every interval exists
    remarks: Iterable[str] = ()  # further notes; empty ones are left out
    columns: Sequence[Column] = ()
    lines: Sequence[Any] = ()  # as the columns read them
    run_columns: Sequence[Column] = ()  # of the raw numbers if these have a line per run
    data: pd.DataFrame | None = None  # the raw numbers, including those of the figure; None: by the columns
    figure: Figure | None = None
    chart: dict[str, Any] | None = None  # panels of series for the page, see `chart.panel_data`
    atlas: dict[str, Any] | None = None  # a grid of cells for the page, see the study `stability`

    def __post_init__(self) -> None:
        for column in self.columns:
            if column.is_metric and column.heading:
                self.runs.check_metric(column.key)
        if self.data is None:
            listed = (self.run_columns, self.runs.records) if self.run_columns else (self.columns, self.lines)
            object.__setattr__(self, "data", to_data(*listed))

    @cached_property
    def shown_columns(self) -> list[Column]:
        """The columns for readers. If most runs were on a busy machine, runtimes are left out; the CSV has them."""
        hide = bool(self.runs.records) and not self.runs.timed
        return [column for column in self.columns if not (hide and column.show is seconds)]

    @cached_property
    def table(self) -> pd.DataFrame:
        return to_table(self.shown_columns, self.lines)

    @cached_property
    def caption(self) -> str:
        interval = caption.interval_text(self.interval, self.estimates, drawn=self.figure is not None)
        return caption.caption(self.runs, self.plotted, n=self.n, interval=interval)

    @cached_property
    def notes(self) -> list[str]:
        remarks = [caption.fill_varying(self.runs, remark) for remark in self.remarks if remark]
        with_times = self.runs.timed or any(column.show is seconds for column in self.columns)
        return [*caption.warnings(self.runs, with_times=with_times), *remarks]

    def shown(self, order: int = 0, experiments: Iterable[str] = ()) -> "Shown":
        """The content of the page as text. Pages are sorted by `order`; `experiments` are those that it reads."""
        return Shown(
            order=order,
            experiments=[*experiments],
            title=self.title,
            question=self.question,
            verdict=caption.SMOKE_WARNING if self.verdict and caption.has_smoke_runs(self.runs) else self.verdict,
            caption=self.caption,
            command=self.command,
            folders=self.folders,
            columns=list(self.table),
            rows=self.table.to_numpy().tolist(),
            best=best(self.shown_columns, self.lines),
            notes=self.notes,
            drawn=self.figure is not None,
            chart=self.chart,
            atlas=self.atlas,
        )


@dataclass(frozen=True)
class Shown:
    """The content of a page and of `NAME.json`, from which Markdown, LaTeX and the HTML page are made."""

    order: int = 0
    experiments: list[str] = field(default_factory=list)
    title: str = ""
    question: str = ""
    verdict: str = ""
    caption: str = ""
    command: str = ""
    folders: dict[str, list[str]] = field(default_factory=dict)
    columns: list[str] = field(default_factory=list)
    rows: list[list[str]] = field(default_factory=list)
    best: list[list[int]] = field(default_factory=list)  # the row and the column of each bold cell
    notes: list[str] = field(default_factory=list)
    drawn: bool = False
    chart: dict[str, Any] | None = None
    atlas: dict[str, Any] | None = None
    drawn_by: str = ""  # the version that drew it, if not this one

    @property
    def head(self) -> str:
        """A sentence on the version that drew the page, if this one cannot draw it."""
        return page_version.head(self.drawn_by)

    @property
    def answer(self) -> str:
        return self.verdict.replace("*", "")

    def narrowed(self, headings: Sequence[str]) -> "Shown":
        """The page with only these columns, in this order."""
        indices = [self.columns.index(heading) for heading in headings]
        rows = [[row[index] for index in indices] for row in self.rows]
        best = [[line, indices.index(index)] for line, index in self.best if index in indices]
        return replace(self, columns=[*headings], rows=rows, best=best)

    def to_json(self) -> str:
        """The content as JSON, a line per part; infinite numbers of a chart become null."""
        parts = {key: value for key, value in asdict(self).items() if value not in ("", [], {}, None, False)}
        encoded = {key: json.dumps(to_json_values(value), ensure_ascii=False) for key, value in parts.items()}
        lines = [f"{json.dumps(JSON_KEYS.get(key, key))}: {text}" for key, text in encoded.items()]
        return "{\n" + ",\n".join(lines) + "\n}\n"


def read_shown(path: Path) -> Shown:
    """Reads `NAME.json`; missing or invalid parts are empty."""
    try:
        content = json.loads(path.read_text(encoding="utf-8", errors="replace"))
    except (OSError, ValueError, RecursionError):
        content = {}
    parts = content if isinstance(content, dict) else {}
    keys = {f.name: JSON_KEYS.get(f.name, f.name) for f in fields(Shown)}
    return Shown(**{name: parts[key] for name, key in keys.items() if key in parts and _is_valid(name, parts[key])})


def _is_valid(name: str, value: Any) -> bool:
    if name in ("chart", "atlas"):
        return isinstance(value, dict)
    if name == "folders":
        return isinstance(value, dict) and all(_is_valid("columns", folders) for folders in value.values())
    if name == "rows":
        return isinstance(value, list) and all(_is_valid("columns", row) for row in value)
    if name == "best":
        return isinstance(value, list) and all(isinstance(v, list) and [*map(type, v)] == [int, int] for v in value)
    if name in ("columns", "notes", "experiments"):
        return isinstance(value, list) and all(isinstance(text, str) for text in value)
    return isinstance(value, {"order": int, "drawn": bool}.get(name, str))


def write(result: Result, shown: Shown, base: Path, *, name: str = "") -> list[Path]:
    """Writes `base.csv` and all of `write_shown`, `.png` and `.pdf` if there is a figure; returns the paths."""
    base.parent.mkdir(parents=True, exist_ok=True)
    table = base.with_suffix(".csv")
    _write_text(table, result.data.to_csv(index=False))
    drawn = [base.with_suffix(suffix) for suffix in (".png", ".pdf")] if result.figure is not None else []
    with rc_context(RC):
        for path in drawn:
            # Without a date, so that the same records give the same file.
            result.figure.savefig(path, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)
    return [table, *write_shown(shown, base, name=name), *drawn]


def write_shown(shown: Shown, base: Path, *, name: str = "") -> list[Path]:
    """Writes `base.json`, `.md`, and `.tex`, with the label `tab:NAME`, if there is a table; returns the paths."""
    texts = {".json": shown.to_json(), ".md": markdown(shown, base.name)}
    if shown.columns:
        texts[".tex"] = latex(shown, name or base.name)
    for suffix, text in texts.items():
        _write_text(base.with_suffix(suffix), text)
    return [base.with_suffix(suffix) for suffix in texts]


def _write_text(path: Path, text: str) -> None:
    path.write_bytes(text.encode("utf-8", "backslashreplace"))


def markdown(shown: Shown, name: str) -> str:
    head = [as_markdown(shown.head)] if shown.head else []
    question_part = [f"{as_markdown(shown.question)} **{as_markdown(shown.answer)}**"] if shown.verdict else []
    parts = [*head, *question_part, f"**{as_markdown(shown.title)}** {as_markdown(shown.caption)}"]
    if shown.columns:
        head, rows = map(as_markdown, shown.columns), _emphasised(shown, as_markdown, "**{}**")
        rule = ["---" if is_text else "---:" for is_text in _text_columns(shown)]
        parts.append("\n".join(f"| {' | '.join(row)} |" for row in (head, rule, *rows)))
    if shown.drawn:
        parts.append(f"![{as_markdown(shown.title)}]({name}.png)")
    if shown.command:
        parts.append(f"    {_flat(shown.command)}")
    if shown.notes:
        parts.append("\n".join(f"- {as_markdown(note)}" for note in shown.notes))
    return "\n\n".join(parts) + "\n"


def latex(shown: Shown, name: str) -> str:
    """A LaTeX table environment with the title, no larger than the page; lines with equal first cells are a group."""
    cells = _emphasised(shown, _tex, r"\textbf{{\boldmath {}}}")
    columns = [[row[index] for row in shown.rows] for index in range(len(shown.columns))]
    for index, texts in enumerate(columns[:2]):
        starts = [line for line, text in enumerate(texts) if line == 0 or text != texts[line - 1]]
        if 1 < len(starts) <= len(texts) / 2 and (index == 0 or len(starts) == len({*texts})):
            for line, row in enumerate(cells):
                row[0] = ("\\midrule\n" if line in starts[1:] else "") + (row[0] if index or line in starts else "")
            break
    head, *rows = (rf"{' & '.join(row)} \\" for row in (map(_tex_heading, shown.columns, columns), *cells))
    lines = [
        rf"% Page {name} of bench.report; the .md has its notes. Needs the packages array, booktabs and graphicx.",
        rf"% {_tex(f'{shown.head} {shown.caption}')}",
        r"\begin{table*}",
        r"\centering",
        rf"\caption{{{_tex(shown.title)}}}",
        rf"\label{{tab:{name}}}\smallskip",
        r"\resizebox*{!}{\ifdim\totalheight>0.9\textheight0.9\textheight\else\totalheight\fi}{%",
        r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{''.join(map(_aligned, columns))}}}",
        *(r"\toprule", head, r"\midrule", *rows, r"\bottomrule"),
        r"\end{tabular}}}",
        r"\end{table*}",
    ]
    return "\n".join(lines) + "\n"


def _aligned(cells: list[str]) -> str:
    """The LaTeX alignment of a column: left if most cells begin with a letter; a paragraph if a cell is long."""
    if any(len(cell) > 60 for cell in cells):
        return r">{\raggedright\arraybackslash}p{0.4\textwidth}"
    return "l" if 2 * sum(bool(re.match(r"\W*[^\W\d]", cell)) for cell in cells) > len(cells) else "r"


def _emphasised(shown: Shown, escape: Callable[[str], str], bold: str) -> list[list[str]]:
    """The cells of all rows as Markdown or LaTeX, the best in bold."""
    return [
        [bold.format(escape(cell)) if [line, column] in shown.best else escape(cell) for column, cell in enumerate(row)]
        for line, row in enumerate(shown.rows)
    ]


def _text_columns(shown: Shown) -> list[bool]:
    """Whether each column is aligned left: the first, and those with words but no digits."""
    texts = [" ".join(row[column] for row in shown.rows) for column in range(len(shown.columns))]
    return [
        column == 0 or (any(map(str.isalpha, text)) and not any(map(str.isdigit, text)))
        for column, text in enumerate(texts)
    ]


def _tex(text: str) -> str:
    """A text as LaTeX; a dash if it is empty."""
    escaped = _flat(text).translate(str.maketrans(_LATEX))
    return "--" if text in ("", "N/A") else _POWER.sub(r"$\1\\times10^{\2}$", escaped)


def _tex_heading(heading: str, cells: list[str]) -> str:
    """A heading as LaTeX, broken into lines if it is longer than the cells below."""
    lines = textwrap.wrap(_flat(heading), max([12, *map(len, cells)]), break_long_words=False)
    text, side = r" \\ ".join(map(_tex, lines)), "lr"[_aligned(cells) == "r"]
    return rf"\begin{{tabular}}[b]{{@{{}}{side}@{{}}}}{text}\end{{tabular}}" if lines[1:] else text


def as_markdown(text: str) -> str:
    """A text on one line as Markdown (CommonMark) that shows it unchanged, without links, images and HTML.

    A word between backquotes is code. Brackets of intervals stay as they are.
    """
    text = _flat(text)
    links = _MARKDOWN_LINK.search(text) or text.count("[") != text.count("]")
    signs = [_MARKDOWN_CODE, _MARKDOWN_SIGN, *([r"[\[\]]"] if links else [])]
    return re.sub("|".join(signs), lambda match: match[0] if len(match[0]) > 1 else rf"\{match[0]}", text)


def _flat(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in " ".join(str(text).split()))
