"""`python -m tests.readme`, a part of `make lint`: whether README.md is short, has few numbers and short sentences."""

import csv
import json
import re
import sys
from pathlib import Path

from bench.report.data.statistics import Interval, Verdict, differ

README = Path(__file__).resolve().parents[1] / "README.md"
PAPER = README.parent / "results" / "paper"
COLUMNS = (
    "`renderer=`",
    "progress at 1 ×",
    "at the end",
    "field evaluations of a run",
    "seconds of a run",
    "failed runs",
)
HEAD = f"| {' | '.join(COLUMNS)} |\n|---|{'---:|' * (len(COLUMNS) - 1)}\n"
LINES, NUMBERS, WORDS = 120, 60, 25  # at most, the last of a sentence
BLOCK = re.compile(r"^```[\s\S]*?^```$|^ {4}.*$|<[^>]*>", re.MULTILINE)  # what is typed, and HTML
ADDRESS = re.compile(r"!?\[([^]]*)\]\([^)]*\)")  # the text of a link stays
CODE = re.compile(r"`[^`]*`")
NUMBER = re.compile(r"(?<![\w.])[-−]?\d[\d,.]*")
ENDS = re.compile(r"(?<=[.!?])\s+|\n\s*\n|\n(?=#|\s*[-*] |\s*\d+\. )|\||^#.*$", re.MULTILINE)  # of sentences


def wrongs(text: str) -> list[str]:
    """What is too long in a README, a line for each; code and addresses have no numbers and are a word."""
    prose = CODE.sub("code", ADDRESS.sub(r"\1", BLOCK.sub("", text)))
    lines, numbers = len(text.splitlines()), len(NUMBER.findall(prose))
    found = [f"{lines} lines, at most {LINES}: move some to results/README.md"] if lines > LINES else []
    found += [f"{numbers} numbers, at most {NUMBERS}: leave them to results/README.md"] if numbers > NUMBERS else []
    for sentence in (" ".join(part.split()) for part in ENDS.split(prose)):
        words = sum(any(map(str.isalnum, word)) for word in sentence.split(" "))
        found += [f"a sentence of {words} words, at most {WORDS}: {sentence}"] if words > WORDS else []
    return found


def recommendation() -> str:
    """README's first answer: the renderers that lead at the cost of one run of DIST, from the CSV file of the suite.

    Raises:
        ValueError: where the sentence does not hold; another one must be written.
    """
    ranks = {line["preset"]: [int(x) for x in line["at_1_rank"].split("–")] for line in _lines("suite")}
    first = [preset for preset, rank in ranks.items() if rank[0] == 1]
    others = [preset for preset in ranks if preset not in first]
    if len(first) != 2 or any(ranks[preset][0] <= len(first) for preset in others):
        raise ValueError(f"the ranks at the cost of one run are {ranks}")
    ends = {line["end_rank"] for line in _lines("suite")}
    if ends != {f"1–{len(ranks)}"}:
        raise ValueError(f"the ranks at the end are {ends}")
    costs = [float(line["cost"]) for line in _lines("suite")]
    return (
        f"**Start with `{first[0]}` or `{first[1]}`.** At the cost of one DIST run (1 ×), both make\n"
        "significantly more progress than all other renderers. These two cannot be distinguished.\n"
        "At the end of their runs, no two renderers can be distinguished, at costs that differ "
        f"{max(costs) / min(costs):.0f}-fold."
    )


def table() -> str:
    """README's table of renderers, from the committed CSV files of the suite."""
    sets = {(line["set"], line["row"]): line for line in _lines("suite_sets")}
    rows = []
    for line in _lines("suite"):
        cost = sets["complete", line["row"]]
        failed = sum(map(int, re.findall(r"(\d+) of \d+", line["failed"]))) or ""
        cells = [*(_percent(line[name]) for name in ("at_1", "end")), cost["evaluations"], cost["seconds"]]
        numbers = [cell if cell.endswith(("%", "–")) else f"{float(cell):.2g}" for cell in cells]
        rows.append(f"| `{line['preset']}` | {' | '.join(numbers)} | {failed} |")
    return HEAD + "\n".join(rows)


def answers() -> str:
    """README's table of questions: each answer is a test of committed numbers, by the statistics of this version."""
    error, ranks = _lowest_error(), json.loads((PAPER / "stability_cost.json").read_text(encoding="utf-8"))
    tied = re.search(
        r"n = (\d+) axes\. .* of the \d+ others \((.*)\) cannot be distinguished from (.*)\.", ranks["verdict"]
    )
    if tied is None:
        raise ValueError(f"the verdict of stability_cost has changed: {ranks['verdict']}")
    hard = f"{tied[3]} has the best mean rank over {tied[1]} kinds of stress. {tied[2]} cannot be distinguished from it"
    return (
        "| question | answer |\n|---|---|\n"
        f"| lowest error under one loss and setting? | [{error}](results/README.md#one_loss). |\n"
        f"| hard scenes? | [{hard}](results/README.md#stability_cost). |"
    )


def _lowest_error() -> str:
    """Which ratios of errors to DIST's differ from 1: the sign test over shapes, with Holm's correction."""
    lines = [line for line in _lines("one_loss") if line["family"] == "all families" and line["ratio"]]
    counts = [re.search(r"; (\d+) of (\d+)$", line["ratio"]) for line in lines]
    if None in counts:
        raise ValueError("a ratio of one_loss.csv does not say on how many shapes it is below 1")
    below = [(int(count[1]), int(count[2])) for count in counts if count]
    ratios = [Interval(1.0, 0.5, 2.0, (0.5,) * k + (2.0,) * (n - k)) for k, n in below]
    verdicts = {*differ(ratios)}
    if verdicts != {Verdict.NOT_DISTINGUISHED}:
        raise ValueError(f"the verdicts on one_loss are {verdicts}: write another answer")
    return f"None of {len(ratios)} renderers can be distinguished from DIST (sign test over {below[0][1]} shapes)"


def _lines(page: str) -> list[dict[str, str]]:
    with (PAPER / f"{page}.csv").open(encoding="utf-8") as file:
        return [*csv.DictReader(file)]


def _percent(text: str) -> str:
    return f"{100 * float(text):.0f} %" if text else "–"


if __name__ == "__main__":
    said = wrongs(README.read_text(encoding="utf-8"))
    sys.exit("\n".join(f"README.md has {each}" for each in said) or None)
