"""`python -m tests.readme`, a part of `make lint`: whether README.md is short, has few numbers and short sentences."""

import csv
import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"
PAPER = README.parent / "results" / "paper"
ROWS = {  # of README's table: the methods of one_loss and the renderers of the atlas
    **{"Newton": ("newton_mask", "newton"), "DIST": ("dist_mask", "dist"), "IDR": ("idr_mask", "idr")},
    **{"DVR": ("dvr_mask", "dvr"), "NeuS": ("neus_mask", "neus"), "VolSDF": ("volsdf_mask", "volsdf_budget")},
    **{"UNISURF": ("unisurf_mask", "unisurf"), "Naive": ("naive_mask", "naive_parallel")},
    **{"Range analysis": ("range_analysis_mask", "range_analysis"), "Mesh proxy": ("mesh_mask", "mesh_proxy")},
    "Relaxed boundary": ("relaxed_boundary_mask", "relaxed_boundary"),
}
HEAD = "| renderer | error, times DIST's | seconds of the loop | mean rank on hard scenes |\n|---|---|---|---|\n"
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
    """README's table, from the committed CSVs of one_loss and of the atlas, the quickest row first."""
    errors, ranks = ({row["preset"]: row for row in reversed(_rows(name))} for name in ("one_loss", "stability_cost"))
    lines = [(float(errors[method]["seconds"]), name, method, preset) for name, (method, preset) in ROWS.items()]
    error = {method: float(row["error"]) for method, row in errors.items()}
    return HEAD + "\n".join(
        f"| {name} | {_ratio(error[method], error['dist_mask'])} | {seconds:.0f} | {float(ranks[preset]['rank']):.1f} |"
        for seconds, name, method, preset in sorted(lines)
    )


def _ratio(error: float, reference: float) -> str:
    """The ratio of two errors, rounded once; 1 of DIST itself."""
    return "1" if error == reference else f"{error / reference:.2f}"


def _rows(name: str) -> list[dict[str, str]]:
    with (PAPER / f"{name}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


if __name__ == "__main__":
    said = wrongs(README.read_text(encoding="utf-8"))
    sys.exit("\n".join(f"README.md has {each}" for each in said) or None)
