"""The result of a page, and its output as CSV, Markdown, LaTeX, PNG and PDF."""

import html
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.pictures.style import RC
from bench.report.data.experiments import Experiment
from bench.report.data.statistics import Interval
from bench.report.write import caption

# Special characters of LaTeX, and characters that its standard fonts lack.
_LATEX = {
    "\\": r"\textbackslash{}",
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
    "—": "---",
    "…": r"\ldots{}",
    "∞": r"$\infty$",
    "×": r"$\times$",
    "±": r"$\pm$",
    "²": "$^2$",
    "→": r"$\rightarrow$",
    "°": r"$^\circ$",
    "ρ": r"$\rho$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "µ": r"$\mu$",
}
_MARKDOWN = {character: f"&#{ord(character)};" for character in "|*_`[]\\"}
_SPARED = "_"  # within words, where it has no meaning in Markdown


@dataclass(frozen=True)
class Result:
    """A table, a figure or both, made from the records of an experiment.

    Args:
        experiment: the experiment that it shows.
        title: its title, as a sentence.
        plotted: what is plotted, as a sentence.
        n: the sample as text; by default the numbers of runs, shapes and seeds.
        interval: the kind of interval; empty for none.
        estimates: those that are shown with it, if there are shapes enough; empty for intervals that always are there.
        remarks: notes of its own; empty ones are left out.
        data: the raw numbers, including those that the figure plots.
        table: the numbers as text for readers.
        figure: the figure.
    """

    experiment: Experiment
    title: str
    plotted: str
    data: pd.DataFrame
    n: str = ""
    interval: str = ""
    estimates: Iterable[Interval] = ()
    remarks: Iterable[str] = ()
    table: pd.DataFrame | None = None
    figure: Figure | None = None

    @cached_property
    def caption(self) -> str:
        """What is plotted, n, the interval, what failed, and the machine."""
        interval = caption.kind(self.interval, self.estimates, drawn=self.figure is not None)
        return caption.caption(self.experiment, self.plotted, n=self.n, interval=interval)

    @cached_property
    def notes(self) -> list[str]:
        """Warnings, then the notes of its own."""
        own = [caption.said(self.experiment, remark) for remark in self.remarks if remark]
        return [*caption.warnings(self.experiment), *own]


def write(result: Result, base: Path, *, name: str = "") -> list[Path]:
    """Writes `base.csv` and `.md`, and where there is content `.tex`, `.png`, `.pdf`; gives the paths.

    LaTeX has the label `tab:NAME`, by default that of the files.
    """
    base.parent.mkdir(parents=True, exist_ok=True)
    texts = {".csv": result.data.to_csv(index=False), ".md": markdown(result, base.name)}
    if result.table is not None:
        texts[".tex"] = latex(result, name or base.name)
    for suffix, text in texts.items():
        base.with_suffix(suffix).write_bytes(text.encode("utf-8", "backslashreplace"))
    drawn = [base.with_suffix(suffix) for suffix in (".png", ".pdf")] if result.figure is not None else []
    with rc_context(RC):
        for path in drawn:
            # Without a date, so that the same records give the same file.
            result.figure.savefig(path, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)
    return [base.with_suffix(suffix) for suffix in texts] + drawn


def markdown(result: Result, name: str) -> str:
    """The Markdown text of a result: title, caption, table, picture and notes."""
    parts = [f"**{_md(result.title)}** {_md(result.caption)}"]
    if result.table is not None:
        head, *rows = ([_md(cell) for cell in row] for row in (result.table.columns, *result.table.to_numpy()))
        rule = ["---" if of_words else "---:" for of_words in _of_words(result.table)]
        parts.append("\n".join(f"| {' | '.join(row)} |" for row in (head, rule, *rows)))
    if result.figure is not None:
        parts.append(f"![{_md(result.title)}]({name}.png)")
    if result.notes:
        parts.append("\n".join(f"- {_md(note)}" for note in result.notes))
    return "\n\n".join(parts) + "\n"


def latex(result: Result, name: str) -> str:
    """A LaTeX table environment with the notes below the table; it needs only the package booktabs."""
    table = result.table
    lines = [
        r"\begin{table*}",
        r"\centering",
        rf"\caption{{{_tex(result.title)} {_tex(result.caption)}}}",
        rf"\label{{tab:{name}}}",
        r"\scriptsize",
        r"\setlength{\tabcolsep}{2pt}",
        rf"\begin{{tabular}}{{@{{}}{''.join('l' if of_words else 'r' for of_words in _of_words(table))}@{{}}}}",
        r"\toprule",
        *_latex_rows(list(zip(*map(_two_lines, table.columns), strict=True))),
        r"\midrule",
        *_latex_rows(table.to_numpy()),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    if result.notes:
        lines += [r"\par\smallskip", r"\begin{flushleft}"]
        lines += [rf"{_tex(note)}\par" for note in result.notes] + [r"\end{flushleft}"]
    return "\n".join([*lines, r"\end{table*}"]) + "\n"


def _of_words(table: pd.DataFrame) -> list[bool]:
    """Of each column, whether it is aligned to the left: the first one, and others without a digit but with a word."""
    texts = [" ".join(map(str, table.iloc[:, place])) for place in range(table.shape[1])]
    return [
        place == 0 or (any(map(str.isalpha, text)) and not any(map(str.isdigit, text)))
        for place, text in enumerate(texts)
    ]


def _two_lines(heading: str) -> tuple[str, str]:
    """A heading in two lines: a long one is split at the space closest to its middle, a short one is the second."""
    spaces = [place for place, character in enumerate(heading) if character == " "]
    if len(heading) < 9 or not spaces:
        return "", heading
    middle = min(spaces, key=lambda place: abs(place - len(heading) / 2))
    return heading[:middle], heading[middle + 1 :]


def _latex_rows(rows) -> list[str]:
    # A bracket that starts a row would be read as the argument of the line break before it.
    return [
        " & ".join("{" + t + "}" if (t := _tex(cell)).startswith("[") else t for cell in row) + r" \\" for row in rows
    ]


def _tex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in _flat(text))


def _md(text: str) -> str:
    escaped = html.escape(_flat(text), quote=False)
    return "".join(c if c in _SPARED else _MARKDOWN.get(c, c) for c in escaped)


def _flat(text: str) -> str:
    """One line without control characters."""
    return "".join(c if c.isprintable() else " " for c in " ".join(str(text).split()))
