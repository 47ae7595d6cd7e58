"""`python -m tests.readme`, a part of `make lint`: whether README.md is short, has few numbers and short sentences."""

import csv
import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"
PAPER = README.parent / "results" / "paper"
HEAD = "| renderer | targets reached | at the cost of DIST's run | field values, times DIST's |\n|---|---|---|---|\n"
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


def table() -> str:
    """README's table, from the committed CSV of the suite."""
    with (PAPER / "suite.csv").open(encoding="utf-8") as file:
        rows = [*csv.DictReader(file)]
    return HEAD + "\n".join(
        f"| {row['row']} | {_percent(row['share'])} | {_percent(row['at_dist'])} | {_ratio(row['ratio'])} |"
        for row in rows
        if not row.get("gain")  # of tuned rows, which have other sets
    )


def _percent(text: str) -> str:
    return f"{100 * float(text):.0f} %"


def _ratio(text: str) -> str:
    """A ratio to two digits; 1 of DIST itself, which has none."""
    return f"{float(text):.2g}" if text else "1"


if __name__ == "__main__":
    said = wrongs(README.read_text(encoding="utf-8"))
    sys.exit("\n".join(f"README.md has {each}" for each in said) or None)
