"""`python -m tests.readme`, a part of `make lint`: whether README.md is short, has few numbers and short sentences."""

import csv
import json
import re
import sys
from pathlib import Path
from typing import Any

README = Path(__file__).resolve().parents[1] / "README.md"
PAPER = README.parent / "results" / "paper"
COLUMNS = (
    *("`renderer=`", "progress at 1 ×", "at the end", "failed runs"),
    *("completion: field evaluations over DIST's", "completion: time over DIST's"),
)
HEAD = f"| {' | '.join(COLUMNS)} |\n|---|{'---:|' * (len(COLUMNS) - 1)}\n"
MAX_LINES, MAX_NUMBERS, MAX_WORDS = 120, 60, 25  # the last is per sentence
BLOCK = re.compile(r"^```[\s\S]*?^```$|^ {4}.*$|<[^>]*>", re.MULTILINE)  # what is typed, and HTML
ADDRESS = re.compile(r"!?\[([^]]*)\]\([^)]*\)")  # the text of a link stays
CODE = re.compile(r"`[^`]*`")
NUMBER = re.compile(r"(?<![\w.])[-−]?\d[\d,.]*")
SENTENCE_ENDS = re.compile(r"(?<=[.!?])\s+|\n\s*\n|\n(?=#|\s*[-*] |\s*\d+\. )|\||^#.*$", re.MULTILINE)


def wrongs(text: str) -> list[str]:
    """A line for each fault of a README; code and addresses count as one word without a number."""
    prose = CODE.sub("code", ADDRESS.sub(r"\1", BLOCK.sub("", text)))
    lines, numbers = len(text.splitlines()), len(NUMBER.findall(prose))
    messages = [f"{lines} lines, at most {MAX_LINES}: move some to the README of a folder"] if lines > MAX_LINES else []
    if numbers > MAX_NUMBERS:
        messages.append(f"{numbers} numbers, at most {MAX_NUMBERS}: leave them to results/paper")
    for sentence in SENTENCE_ENDS.split(prose):
        words = sum(any(map(str.isalnum, word)) for word in sentence.split())
        if words > MAX_WORDS:
            messages.append(f"a sentence of {words} words, at most {MAX_WORDS}: {' '.join(sentence.split())}")
    return messages


def recommendation() -> str:
    """README's first answer: of the renderers that lead at 1 ×, the one among the best on hard scenes.

    Raises:
        ValueError: a sentence does not hold any more; another one must be written.
    """
    lines, presets = _lines("suite"), {line["row"]: line["preset"] for line in _lines("suite")}
    page = json.loads((PAPER / "suite.json").read_text(encoding="utf-8"))
    rows = r"(.*) \(\*.*\*\) and (.*) \(\*.*\*\) make significantly more progress than the \d+ others"
    rest = "These 2 cannot be distinguished. At the end of the runs, none of"
    leaders = re.search(rf"^At the cost of one DIST run, {rows}. {rest}", page["verdict"])
    _check(leaders, "the leaders at the cost of one run, or the pairs at the end")
    both = leaders.groups() if leaders else ()
    hard = [presets[row] for row in both if row in _hardest()]
    others = [presets[row] for row in both if row not in _hardest()]
    _check(len(hard) == len(others) == 1 and presets[both[0]] == hard[0], "the leaders on hard scenes")
    without = [note for note in page["notes"] if note.startswith("Without ")]
    _check(without and all(f", at 1 ×, {both[0]} (" in note for note in without), "the first with a set left out")
    other = others[0]
    worst = max(_lines("stability_cost"), key=lambda line: float(line["rank"]))
    _check(presets[worst["row"]] == other, "the last rank on hard scenes")
    verdict = json.loads((PAPER / "suite_sets.json").read_text(encoding="utf-8"))["verdict"]
    slower = re.search(
        r"run, (.*) \(\*.*\*\) makes the most progress, significantly more than \d+ others?: (.*?)\. Run", verdict
    )
    _check(slower and presets[slower[1]] == hard[0], "the first in the time of one run")
    behind = slower[2].split("; ") if slower else []
    near = [f"`{preset}`" for row, preset in presets.items() if row not in behind and preset != hard[0]]
    costs = {line["preset"]: float(line["cost"]) for line in lines}
    least, most = min(costs, key=costs.__getitem__), max(costs, key=costs.__getitem__)
    return (
        f"**Start with `{hard[0]}`.** With as many field evaluations as one whole DIST run (1 ×), `{hard[0]}` and "
        f"`{other}` make significantly more progress than all other renderers.\nThe difference between these two is "
        f"not significant. If one of the four problem sets is left out, `{hard[0]}` is still first. On "
        f"[hard scenes](results/paper/stability_cost.md), `{other}` has the worst mean rank.\nIn the time of one DIST "
        "run, in depth completion, "
        f"`{hard[0]}` is first. {', '.join(near[:-1])} and {near[-1]} do not differ significantly from it; "
        "all other renderers do. At the end of their runs, no two renderers can be distinguished. "
        f"Over all sets, a run needs {costs[least]:.2g} (`{least}`) to {costs[most]:.2g} (`{most}`) times the "
        "field evaluations of a DIST run. The table has these ratios for completion alone."
    )


def _check(holds: Any, what: str) -> None:
    if not holds:
        raise ValueError(f"{what} have changed: README needs another sentence")


def table() -> str:
    """README's table of renderers, from the committed CSV files of the suite."""
    sets = {(line["set"], line["row"]): line for line in _lines("suite_sets")}
    rows = []
    for line in _lines("suite"):
        cost = sets["complete", line["row"]]
        failed = sum(map(int, re.findall(r"(\d+) of \d+", line["failed"]))) or "none"
        progress = [_percent(line[name]) for name in ("at_1", "end")]
        costs = [f"{float(cost[name]):.2g}" for name in ("evaluations", "seconds")]
        rows.append(f"| `{line['preset']}` | {' | '.join([*progress, str(failed), *costs])} |")
    return HEAD + "\n".join(rows)


def hard_scenes() -> str:
    """README's line on hard scenes, from the verdict on the mean ranks of the atlas."""
    best, *tied = _hardest()
    axes = _lines("stability_cost")[0]["axes"]
    hard = f"{best} has the best mean rank over {axes} kinds of stress. Not distinguished from it: {'; '.join(tied)}"
    return f"- Hard scenes: [{hard}](results/paper/stability_cost.md)."


def _hardest() -> list[str]:
    """The rows with the best mean rank on hard scenes: the first, and those that cannot be distinguished from it."""
    verdict = json.loads((PAPER / "stability_cost.json").read_text(encoding="utf-8"))["verdict"]
    tied = re.search(r"of the \d+ others \((.*)\) cannot be distinguished from (.*)\.$", verdict)
    _check(tied, "the words of stability_cost")
    return [tied[2], *tied[1].split("; ")] if tied else []


def _lines(page: str) -> list[dict[str, str]]:
    with (PAPER / f"{page}.csv").open(encoding="utf-8") as file:
        return [*csv.DictReader(file)]


def _percent(text: str) -> str:
    return f"{100 * float(text):.0f} %" if text else "–"


if __name__ == "__main__":
    faults = wrongs(README.read_text(encoding="utf-8"))
    sys.exit("\n".join(f"README.md has {each}" for each in faults) or None)
