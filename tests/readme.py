"""`python -m tests.readme`, a part of `make lint`: whether README.md is short, has few numbers and short sentences."""

import csv
import json
import re
import sys
from functools import partial
from pathlib import Path

from bench.report.suite.standing import units

README = Path(__file__).resolve().parents[1] / "README.md"
PAPER = README.parent / "results" / "paper"
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
    """README's first answer: the row with the most progress among those that none beats significantly at any cost."""
    lines = _lines("suite")
    leaders = {
        budget: sorted(filter(partial(_leads, budget), lines), key=lambda line: -float(line[budget]))
        for budget in _decided_budgets()
    }
    always = [line for line in lines if all(line in rows for rows in leaders.values())]
    if not always:
        raise ValueError("no row is among the best at all costs: README needs another sentence")
    first = max(always, key=lambda line: float(line[_decided_budgets()[-1]]))
    sentences = [
        f"At {units(float(budget))} of cost{_sets(budget)}, {_listed(rows)} {'lead' if rows[1:] else 'leads'}."
        for budget, rows in leaders.items()
    ]
    is_hardest, best = first["row"] in _hardest(), _hardest()[0].partition(",")[0]
    hard = "cannot be distinguished from the best" if is_hardest else f"is significantly worse than that of {best}"
    return (
        f"**Start with `{first['preset']}`.** All renderers spend the same number of field evaluations. "
        f"{' '.join(sentences)} A renderer leads if none makes significantly more progress. "
        f"The first name has the most.\n"
        f"On [hard scenes](results/paper/stability_cost.md), the mean rank of `{first['preset']}` {hard}."
    )


def _budgets() -> list[str]:
    """The budgets with results, as they are named in the CSV file of the suite."""
    lines = _lines("suite")
    return [name for name in lines[0] if name.isdigit() and any(line[name] for line in lines)]


def _decided_budgets() -> list[str]:
    """The budgets at which some renderers are significantly worse than others."""
    lines = _lines("suite")
    return [budget for budget in _budgets() if not all(_leads(budget, line) for line in lines if line[budget])]


def _sets(budget: str) -> str:
    """The sets of a budget in brackets, if they are not all sets; from the heading of its column."""
    headings = json.loads((PAPER / "suite.json").read_text(encoding="utf-8"))["columns"]
    when = f"At {units(float(budget))}"
    return next(heading for heading in headings if re.fullmatch(rf"{when}( \(.*)?", heading)).removeprefix(when)


def _leads(budget: str, line: dict[str, str]) -> bool:
    """Whether no row makes significantly more progress."""
    return re.split(r"\D", line[f"{budget}_rank"])[0] == "1"


def _listed(lines: list[dict[str, str]]) -> str:
    names = [f"`{line['preset']}`" for line in lines]
    return " and ".join([", ".join(names[:-1]), names[-1]]) if names[1:] else names[0]


def table() -> str:
    """README's table of renderers, from the committed CSV files of the suite."""
    seconds = {line["row"]: line["seconds"] for line in _lines("suite_sets") if line["set"] == "complete"}
    costs = [f"progress at {units(float(budget))}" for budget in _budgets()]
    head = ["`renderer=`", *costs, "runtime of 1 unit of a completion (s)"]
    rows = []
    for line in _lines("suite"):
        progress = [_progress(line, budget) for budget in _budgets()]
        runtime = f"{float(text):.2g}" if (text := seconds.get(line["row"])) else "–"
        rows.append(f"| `{line['preset']}` | {' | '.join([*progress, runtime])} |")
    return f"| {' | '.join(head)} |\n|---|{'---:|' * (len(head) - 1)}\n" + "\n".join(rows)


def _progress(line: dict[str, str], budget: str) -> str:
    """Bold if it leads."""
    if not line[budget]:
        return line[f"{budget}_rank"] or "not run"
    is_leader = budget in _decided_budgets() and _leads(budget, line)
    return f"**{_percent(line[budget])}**" if is_leader else _percent(line[budget])


def hard_scenes() -> str:
    """README's line on hard scenes, from the verdict on the mean ranks of the atlas."""
    best, *tied = _hardest()
    axes = _lines("stability_cost")[0]["axes"]
    hard = f"{best} has the best mean rank over {axes} kinds of stress. Not significantly worse: {'; '.join(tied)}"
    return f"- Hard scenes: [{hard}](results/paper/stability_cost.md)."


def _hardest() -> list[str]:
    """The rows with the best mean rank on hard scenes: the first, and those that cannot be distinguished from it."""
    verdict = json.loads((PAPER / "stability_cost.json").read_text(encoding="utf-8"))["verdict"]
    tied = re.search(r"of the \d+ others \((.*)\) cannot be distinguished from (.*)\.$", verdict)
    if tied is None:
        raise ValueError("the words of stability_cost have changed: README needs another sentence")
    return [tied[2], *tied[1].split("; ")]


def _lines(page: str) -> list[dict[str, str]]:
    with (PAPER / f"{page}.csv").open(encoding="utf-8") as file:
        return [*csv.DictReader(file)]


def _percent(text: str) -> str:
    return f"{100 * float(text):.0f} %" if text else "–"


if __name__ == "__main__":
    faults = wrongs(README.read_text(encoding="utf-8"))
    sys.exit("\n".join(f"README.md has {each}" for each in faults) or None)
